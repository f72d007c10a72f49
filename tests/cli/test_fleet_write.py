"""``busway fleet write``: a value reaches the point once, by the collector that owns its link; else it is said why."""

import asyncio
import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fleet_devices import METER, devices_of, plant
from foreign_servers import nats_server
from program import Busway

from busway.apps.fleet.fleet_commands import send_command
from busway.cli.fleet_write import link_of, print_answer, value_of
from busway.errors import ConfigError, LinkDown, WriteOutcomeUnknown

DEVICES = '[[device]]\nname = "a"\nlink = "hall"\n[[device]]\nname = "b"\nlink = "yard"\n'
SETPOINT = (
    METER
    + """
[[unit.point]]
name = "setpoint"
address = "4x11"
type = "uint16"
maximum = 1000
write = {}
"""
)


@pytest.mark.parametrize(
    ("text", "value"),
    [("20", 20), ("-3.5", -3.5), ("on", True), ("off", False), ("true", True), ("auto", "auto"), ('"on"', "on")],
)
def test_a_value_is_a_number_a_state_or_a_text(text: str, value: Any) -> None:
    found = value_of(text)
    assert (type(found), found) == (type(value), value)


def test_a_value_that_is_nested_too_deeply_is_a_text() -> None:
    text = "[" * 100_000
    assert value_of(text) == text


def test_the_link_of_a_device_is_that_of_the_configuration() -> None:
    assert link_of(DEVICES, "b") == "yard"
    with pytest.raises(ConfigError, match="no device c; there are a, b"):
        link_of(DEVICES, "c")


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ({"state": "done"}, 0),
        ({"state": "refused", "reason": "must be 0…100"}, 2),
        ({"state": "unknown", "reason": "no answer"}, 3),
        ({"state": "expired", "reason": "too late"}, 3),
        ({"state": "failed", "reason": "exception 02"}, 4),
        ({"state": "failed", "reason": "shows 3", "read_back": 3}, 7),
    ],
)
def test_the_exit_code_says_what_became_of_it(
    answer: dict[str, Any], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    command = {"key": "k", "device": "m", "point": "p", "value": True}
    assert print_answer({**command, **answer}, as_json=False) == code
    told = capsys.readouterr()
    assert told.out == f"m/p  on  {answer['state']}\n"
    assert answer.get("reason", "") in told.err
    assert print_answer({**command, **answer}, as_json=True) == code
    assert json.loads(capsys.readouterr().out)["state"] == answer["state"]


class Client:
    """A connection to NATS that answers as it is told."""

    def __init__(self, answer: bytes | Exception, cause: str = "") -> None:
        self.is_connected, self.cause, self._answer, self._told = True, "", answer, cause

    async def request(self, *_: object, **__: object) -> Any:
        self.cause = self._told
        if isinstance(self._answer, Exception):
            raise self._answer
        return type("Message", (), {"data": self._answer})()


async def test_no_owner_is_no_connection_and_no_answer_is_an_outcome_that_is_not_known() -> None:
    errors = pytest.importorskip("nats.errors")
    asked = {"key": "k1"}
    with pytest.raises(LinkDown, match="no collector of zone hall owns link a now; nothing was sent"):
        await send_command(Client(errors.NoRespondersError()), "hall", "a", asked, 1.0)
    for answer in (errors.TimeoutError(), errors.ConnectionClosedError(), b"{", b"[]", b'{"state": "new"}'):
        with pytest.raises(WriteOutcomeUnknown, match="k1"):
            await send_command(Client(answer), "hall", "a", asked, 1.0)
    denied = 'Permissions Violation for Publish to "busway.hall.command.a"'
    with pytest.raises(ConfigError, match="do not permit"):
        await send_command(Client(errors.TimeoutError(), denied), "hall", "a", asked, 1.0)
    lost = Client(b"{}")
    lost.is_connected = False
    with pytest.raises(LinkDown, match="nothing was sent"):
        await send_command(lost, "hall", "a", asked, 1.0)
    assert await send_command(Client(b'{"state": "done"}'), "hall", "a", asked, 1.0) == {"state": "done"}


def test_a_coordinator_without_commands_refuses_in_a_sentence(run: Callable[..., Any], tmp_path: Path) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    refused = run("fleet", "write", "meter-7", "setpoint", "20", *at)
    assert (refused.code, "commands go over NATS" in refused.err) == (2, True)
    for words, said in (
        (("write", "meter-7", "setpoint"), "write: wants DEVICE POINT VALUE"),
        (("status", "--key", "k"), "--key: is for write"),
    ):
        wrong = run("fleet", *words, *at)
        assert (wrong.code, said in wrong.err) == (2, True)


@pytest.mark.real_time
async def test_a_value_is_written_once_for_each_key(run: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("nats")
    with nats_server(tmp_path) as server:
        async with devices_of(1) as devices, contextlib.AsyncExitStack() as stack:
            at = ("--coordinator", f"nats://127.0.0.1:{server.port}", "--zone", "hall")
            file = tmp_path / "plant.toml"
            text = plant(tmp_path / "none", devices, "timeout = 5\nconnect_timeout = 3")
            file.write_text(text.replace("[poll_class]", 'page = "off"\n[poll_class]'))
            (tmp_path / "meter.toml").write_text(SETPOINT)

            async def ask(*words: str) -> Any:
                return await asyncio.to_thread(run, "fleet", *words, *at)

            assert (await ask("apply", str(file))).code == 0
            unowned = await ask("write", "link-0", "setpoint", "7", "--key", "k1")
            assert (unowned.code, "owns link link-0 now; nothing was sent" in unowned.err) == (5, True)
            west = stack.enter_context(Busway("fleet", "run", "--name", "west", "--store", str(tmp_path / "west"), *at))
            await asyncio.to_thread(west.wait_for, "west collects into")
            done = unowned
            while done.code == 5:  # until it owns the link
                done = await ask("write", "link-0", "setpoint", "7", "--key", "k1", "--by", "shift 2")
            assert (done.code, done.out) == (0, "link-0/setpoint  7  done\n")
            again = await ask("write", "link-0", "setpoint", "7", "--key", "k1", "--json", "--quiet")
            found = json.loads(again.out)
            assert (again.code, found["state"], found["by"], again.err) == (0, "done", "shift 2", "")
            high = await ask("write", "link-0", "setpoint", "5000")
            assert (high.code, "refused" in high.out) == (2, True)
            assert devices[0].written == [(10, 7)]
            west.stop()
