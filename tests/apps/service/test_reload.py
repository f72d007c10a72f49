"""A configuration that is read again: all of it is applied, or nothing."""

import asyncio
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from control_sockets import exchange, short_directory

import busway
from busway.apps.service.configuration import Configuration, parse_configuration
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service
from busway.server.listener import Listener

POST = b"POST /reload HTTP/1.1\r\nHost: busway\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
CONFIGURATION = 'listen = ["tcp://127.0.0.1:0"]\n[policy]\ndefault = "{}"\n[[unit]]\nunit = 1\nholding_registers = 10\n'


async def test_nothing_is_applied_where_the_audit_log_cannot_be_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    applied: list[Configuration] = []

    async def apply_to(
        new: Configuration,
        running: object,
        listen: Sequence[Listener],
        *,
        policy: busway.Policy | None,
        when_applied: Callable[[Sequence[str]], None],
    ) -> list[str]:
        applied.append(new)
        when_applied(["a route of the test"])
        return ["a route of the test"]

    monkeypatch.setattr(Configuration, "apply_to", apply_to)
    path, default = tmp_path / "audit.jsonl", ["allow"]
    overrides = Overrides(audit=str(path), control="off", can_reload=True)
    async with (
        Service(lambda: parse_configuration(CONFIGURATION.format(default[0]), "x.toml"), overrides) as service,
        busway.open(service.server.endpoints[0], shared=False) as link,
    ):
        default[0] = "read-only"
        path.unlink()
        path.mkdir()
        with pytest.raises(busway.ConfigError, match=r"audit\.jsonl"):
            await service.reload()
        assert not applied
        await link.unit(1).write_single_register(0, 1)
        path.rmdir()
        assert await service.reload() == [
            "the audit log was opened anew",
            "a route of the test",
            "the policy was replaced",
        ]
        assert len(applied) == 1
        with pytest.raises(busway.ExceptionReply, match="exception 01"):
            await link.unit(1).write_single_register(0, 1)


RULE = '[policy]\ndefault = "allow"\n[[policy.rule]]\naction = "deny"\n'
LISTENER = '[policy]\ndefault = "allow"\n[[listener]]\nurl = "tcp://127.0.0.1:0"\n'


@pytest.mark.clause("M6")
@pytest.mark.parametrize(
    "text",
    ['[policy]\ndefault = "allow"\nallow = []\n', LISTENER + "allow = []\n"]
    + [
        RULE + f"{key} = []\n"
        for key in ("peers", "roles", "listeners", "units", "functions", "table", "addresses", "files")
    ],
)
async def test_a_file_with_an_empty_list_is_refused_at_a_reload_too_and_the_policy_before_holds(text: str) -> None:
    unit = "[[unit]]\nunit = 1\nholding_registers = 10\n"
    texts = ['listen = ["tcp://127.0.0.1:0"]\n[policy]\ndefault = "read-only"\ndeny = ["127.0.0.3"]\n' + unit]
    with short_directory() as directory:
        socket = f"{directory}/reload.sock"
        overrides = Overrides(control=socket, can_reload=True)
        async with Service(lambda: parse_configuration(texts[-1], "x.toml"), overrides) as service:
            texts.append(text + unit)
            with pytest.raises(busway.ConfigError, match=r"is empty|at least one"):
                await service.reload()
            (answer,) = [
                each for each in (await asyncio.to_thread(exchange, socket, POST)).split(b"\r\n") if b"error" in each
            ]
            assert re.search("is empty|at least one", json.loads(answer)["error"])
            async with busway.open(service.server.endpoints[0], shared=False) as link:
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await link.unit(1).write_single_register(0, 1)
            async with busway.open(
                service.server.endpoints[0], shared=False, retries=0, local_address="127.0.0.3"
            ) as denied:
                with pytest.raises((busway.LinkDown, busway.NoReply)):
                    await denied.unit(1).read_holding_registers(0, count=1)
