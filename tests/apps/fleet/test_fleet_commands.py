"""Commands over a fleet with a real NATS server: a key is sent at most once, also when owners of the link die."""

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from fleet_devices import METER, TIMES, FleetDevice, devices_of, plant
from foreign_servers import ForeignServer, nats_server
from told_program import Program
from waiting import until

from busway.apps.collector.configuration import load_collector
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import NatsCoordinator, open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, until_up
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_commands import FleetCommands, command_subject
from busway.apps.fleet.live_subjects import LiveSubjects

pytest.importorskip("nats")
pytestmark = pytest.mark.real_time

WORKER = Path(__file__).parent / "programs" / "commanded.py"
SUPPORT = Path(__file__).parents[2] / "support"
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


class Fleet:
    """One served zone: its server, its devices, and collectors that take commands."""

    def __init__(self, folder: Path, server: ForeignServer, devices: list[FleetDevice]) -> None:
        self.folder, self.devices = folder, devices
        self.url = f"nats://127.0.0.1:{server.port}"
        self.client: Any = None

    def file(self, name: str) -> str:
        text = plant(self.folder / name, self.devices)
        (self.folder / "meter.toml").write_text(SETPOINT)
        path = self.folder / f"{name}.toml"
        path.write_text(text)
        return str(path)

    @contextlib.asynccontextmanager
    async def table(self, zone: str) -> AsyncIterator[NatsCoordinator]:
        opened = await until_up(
            lambda: open_nats(self.url, zone, CoordinatorOptions(answer=TIMES.answer)), CoordinatorDown, 30
        )
        try:
            yield opened
        finally:
            await opened.close()

    @contextlib.asynccontextmanager
    async def collector(self, name: str) -> AsyncIterator[tuple[FleetCollector, FleetCommands]]:
        async with self.table("hall") as coordinator:
            made = load_collector(self.file(name))
            fleet = FleetCollector(made, coordinator, name, host=name, shards=8, times=TIMES)
            async with fleet, FleetCommands(fleet, coordinator.client, "hall") as commands:
                yield fleet, commands

    async def ask(self, link: str, **command: Any) -> dict[str, Any]:
        """The answer to a command; asked again while the link has no owner, or one that dies."""
        from nats.errors import NoRespondersError

        data = json.dumps({"device": link, "point": "setpoint", **command}).encode()
        async with asyncio.timeout(60):
            while True:
                try:
                    reply = await self.client.request(command_subject("hall", link), data, timeout=60)
                    answer: dict[str, Any] = json.loads(reply.data)
                    return answer
                except NoRespondersError:
                    await asyncio.sleep(0.1)


@pytest.fixture
def fleet(tmp_path: Path) -> Callable[[], contextlib.AbstractAsyncContextManager[Fleet]]:
    @contextlib.asynccontextmanager
    async def made() -> AsyncIterator[Fleet]:
        with nats_server(tmp_path) as server:
            async with devices_of(1) as devices:
                found = Fleet(tmp_path, server, devices)
                async with found.table("other") as table:
                    found.client = table.client
                    yield found

    return made


Made = Callable[[], contextlib.AbstractAsyncContextManager[Fleet]]


async def test_a_command_is_done_once_answered_the_same_again_and_kept_as_a_line_of_the_audit(fleet: Made) -> None:
    async with fleet() as zone, zone.collector("one") as (_, _):
        (device,) = zone.devices
        first = await zone.ask("link-0", key="a.b:1", value=7, by="operator")
        again = await zone.ask("link-0", key="a.b:1", value=7)
        assert (first["state"], first["by"], first["origin"]) == ("done", "operator", "fleet")
        assert again == first
        assert device.written == [(10, 7)]
        other = await zone.ask("link-0", key="a.b:1", value=8)
        assert (other["state"], other["reason"].startswith("this key was used for another")) == ("refused", True)
        both = await asyncio.gather(*(zone.ask("link-0", key="twice", value=9) for _ in range(2)))
        assert [each["state"] for each in both] == ["done", "done"]
        assert (await zone.ask("link-0", key="high", value=5000))["state"] == "refused"
        assert device.written == [(10, 7), (10, 9)]
        for data in (b"{", b"[]", b'{"key": "x"}', b"[" * 100_000):
            reply = await zone.client.request(command_subject("hall", "link-0"), data, timeout=60)
            assert json.loads(reply.data)["state"] == "refused"
        lines = await zone.client.jetstream().subscribe("busway.hall.audit", stream="busway-audit-hall")
        outcomes = [json.loads((await lines.next_msg(60)).data)["outcome"] for _ in range(3)]
        assert sorted(outcomes) == ["done", "done", "refused"]


@pytest.mark.parametrize(("step", "writes", "state"), [("claimed", 0, "unknown"), ("answered", 1, "unknown")])
async def test_a_key_whose_collector_is_killed_is_unknown_to_the_next_owner_and_never_sent_again(
    fleet: Made, step: str, writes: int, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    async with fleet() as zone:
        (device,) = zone.devices
        worker = Program([sys.executable, str(WORKER), zone.file("dies"), zone.url, "dies", step])
        try:
            await asyncio.to_thread(worker.ready, 60.0)
            asked = asyncio.create_task(zone.ask("link-0", key="k1", value=7))
            await until(lambda: worker._process.poll() is not None, 60)
            asked.cancel()
            await asyncio.wait([asked])
        finally:
            worker.kill()
        assert len(device.written) == writes
        async with zone.collector("next"):
            answer = await zone.ask("link-0", key="k1", value=7)
            assert answer["state"] == state
            assert answer["reason"].startswith("dies has begun it")
            assert "it is not sent again" in answer["reason"]
            assert (await zone.ask("link-0", key="k2", value=8))["state"] == "done"
        assert device.written == [(10, 7)] * writes + [(10, 8)]


async def test_last_values_are_on_a_subject_of_the_device(fleet: Made) -> None:
    async with fleet() as zone:
        came: asyncio.Queue[Any] = asyncio.Queue()
        await zone.client.subscribe("busway.hall.live.*", cb=came.put)
        async with (
            zone.collector("one") as (one, _),
            zone.table("hall") as table,
            LiveSubjects(one.collector, table.client, "hall"),
            asyncio.timeout(60),
        ):
            found: list[dict[str, Any]] = []
            while not found or found[0]["time"] == found[-1]["time"]:  # two reads may be in one millisecond
                message = await came.get()
                assert message.subject == "busway.hall.live.link-0"
                content = json.loads(message.data)
                found += [content] if "count" in content["points"] else []
        assert found[0]["time"] < found[-1]["time"]
        assert found[0]["points"]["count"]["value"] < found[-1]["points"]["count"]["value"]


class Faltering:
    """A client of which one function fails by a defect the first time, as one of TLS whose transport has ended."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name

    def __getattr__(self, name: str) -> Any:
        if name == self._name:
            self._name = ""
            raise AttributeError("the transport has no attribute 'write'")
        return getattr(self._client, name)


async def test_live_values_go_on_after_a_defect_of_the_client(
    fleet: Made, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("busway.apps.fleet.live_subjects.PAUSE", 0.01)
    async with fleet() as zone:
        came: asyncio.Queue[Any] = asyncio.Queue()
        await zone.client.subscribe("busway.hall.live.*", cb=came.put)
        async with (
            zone.collector("one") as (one, _),
            zone.table("hall") as table,
            LiveSubjects(one.collector, Faltering(table.client, "publish"), "hall"),
            asyncio.timeout(60),
        ):
            await came.get()
    assert "live values cannot be sent; it is tried again" in caplog.text


async def test_commands_are_taken_after_a_defect_of_the_client(
    fleet: Made, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_commands.LISTEN_AGAIN", 0.01)
    async with fleet() as zone, zone.table("hall") as table:
        made = FleetCollector(load_collector(zone.file("one")), table, "one", host="one", shards=8, times=TIMES)
        async with made, FleetCommands(made, Faltering(table.client, "subscribe"), "hall"):
            assert (await zone.ask("link-0", key="k1", value=7))["state"] == "done"
    assert "not all links of this collector take commands; it is tried again" in caplog.text
