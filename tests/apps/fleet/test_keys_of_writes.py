"""The key of a write, whatever way it came, in a zone whose links move: the value is written once."""

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fleet_devices import METER, FleetDevice, devices_of, plant
from waiting import until

from busway.apps.collector.commands.command_messages import CommandMessageHandler, InputMessage, InputRights
from busway.apps.collector.commands.mqtt import MqttCommands
from busway.apps.collector.configuration import parse_collector
from busway.apps.fleet.coordinator import CoordinatorDown, OutcomeUnknown
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.web.collector_page import CollectorPage
from busway.apps.web.request_guard import AccessToken, PageAccessRules, Role

pytestmark = pytest.mark.real_time

TIMES = LeaseTimes(ttl=100.0, renew=0.4, guard=1.0, answer=20.0)
"""Links move because they are handed on: no lease lapses here, however busy the machine is."""
TOKEN = "the-token-of-the-operator"
SETPOINT = """
[[unit.point]]
name = "setpoint"
address = "4x11"
type = "uint16"
maximum = 1000
write = {}
"""


class Zone:
    """A zone on this machine with one link, and its collectors."""

    def __init__(self, folder: Path, devices: list[FleetDevice]) -> None:
        self.folder, self.device, self._devices = folder, devices[0], devices

    @contextlib.asynccontextmanager
    async def collector(self, name: str) -> AsyncIterator[FleetCollector]:
        text = plant(self.folder / name, self._devices, "timeout = 10\nconnect_timeout = 10")
        (self.folder / "meter.toml").write_text(METER + SETPOINT)
        coordinator = await open_coordinator(f"local:{self.folder}/zone", "hall")
        try:
            made = parse_collector(text, f"{name}.toml")
            async with FleetCollector(made, coordinator, name, host=name, shards=1, times=TIMES) as fleet:
                yield fleet
        finally:
            await coordinator.close()


class TableWithout:
    """A table of keys that confirms nothing."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    async def create(self, *_: object) -> int:
        raise self._error

    async def replace(self, *_: object) -> int:
        raise self._error


@contextlib.asynccontextmanager
async def zone(folder: Path) -> AsyncIterator[Zone]:
    async with devices_of(1) as devices:
        yield Zone(folder, devices)


async def polls(fleet: FleetCollector) -> None:
    """Wait until a collector polls the link, so that it can write there."""
    await until(lambda: fleet.collector.values.last("link-0", "count") is not None)


async def moved(giver: FleetCollector, taker: FleetCollector) -> None:
    """Wait until the link has moved to another collector."""
    giver.member.drain(draining=True)
    giver._driver.wake()
    await polls(taker)


async def over_http(fleet: FleetCollector, key: str, value: int) -> dict[str, Any]:
    """What the HTTP API of a collector answers to a write with this key."""
    page = CollectorPage(fleet.collector, "127.0.0.1:0")
    rules = PageAccessRules(lambda: (AccessToken.of(TOKEN, "anna", Role.OPERATE),), {}, None, is_loopback=True)
    transport = httpx.ASGITransport(page.application(rules))
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1", timeout=60) as client:
        asked = {"device": "link-0", "point": "setpoint", "value": value, "key": key, "expires": time.time() + 60}
        answer = await client.post("/api/commands", json=asked, headers={"Authorization": f"Bearer {TOKEN}"})
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found


async def over_mqtt(fleet: FleetCollector, key: str, value: int) -> dict[str, Any]:
    """What a collector answers to a message with this key, as its MQTT input hands it on."""
    made = MqttCommands("127.0.0.1", 1, InputRights("plant/{device}/{point}/set", ("*/*",)))
    receiver = CommandMessageHandler(
        "broker",
        made,
        fleet.collector.commands,
        lambda: fleet.collector.configuration,
        plant=lambda: fleet._configuration,
    )
    payload = json.dumps({"value": value, "key": key}).encode()
    answer = await receiver.handle(InputMessage("plant/link-0/setpoint/set", payload))
    return {"state": "silent"} if answer is None else dict(json.loads(answer))


async def test_a_key_that_is_repeated_after_its_link_has_moved_is_not_written_again(tmp_path: Path) -> None:
    async with zone(tmp_path) as hall, hall.collector("one") as one:
        await polls(one)
        assert (await over_http(one, "order-1", 7))["state"] == "done"
        assert (await over_mqtt(one, "order-2", 8))["state"] == "done"
        async with hall.collector("two") as two:
            await moved(one, two)
            again = [await over_http(two, "order-1", 7), await over_mqtt(two, "order-2", 8)]
            crossed = [await over_mqtt(two, "order-1", 7), await over_http(two, "order-2", 8)]
            assert [each["state"] for each in (*again, *crossed)] == ["done"] * 4, "the answer of the first time"
            other = await over_http(two, "order-1", 9)
            assert (other["state"], "used for another command" in other["reason"]) == ("refused", True)
            assert hall.device.written == [(10, 7), (10, 8)]
            assert (await over_http(two, "order-3", 9))["state"] == "done"
        assert hall.device.written == [(10, 7), (10, 8), (10, 9)]


async def test_of_one_message_to_all_collectors_the_owner_of_the_link_alone_writes_and_answers(tmp_path: Path) -> None:
    async with zone(tmp_path) as hall, hall.collector("one") as one, hall.collector("two") as two:
        await until(lambda: one.links or two.links)
        owner, other = (one, two) if one.links else (two, one)
        await polls(owner)
        answers = await asyncio.gather(over_mqtt(other, "order-1", 7), over_mqtt(owner, "order-1", 7))
        assert [each["state"] for each in answers] == ["silent", "done"]
        told = await over_http(other, "order-2", 8)
        assert told["state"] == "refused"
        assert "is not polled by this collector, but by another of the fleet; nothing was sent" in told["reason"]
        assert (await over_http(owner, "order-2", 8))["state"] == "done", "a refusal there takes no key"
        assert hall.device.written == [(10, 7), (10, 8)]


async def test_a_write_is_refused_before_any_byte_while_the_coordinator_is_down_and_its_key_may_be_used_again(
    tmp_path: Path,
) -> None:
    async with zone(tmp_path) as hall, hall.collector("one") as one:
        await polls(one)
        for error in (CoordinatorDown("it is away"), OutcomeUnknown("no answer")):
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(one._keys, "_table", TableWithout(error))
                for way in (over_http, over_mqtt):
                    answer = await way(one, "order-1", 7)
                    assert answer["state"] == "refused"
                    assert "nothing was sent: the fleet's table of keys does not" in answer["reason"]
                armed = one.collector.commands.arm("link-0", "setpoint", 7, by="anna", origin="page")
                assert (await one.collector.commands.confirm(armed.command.key, by="anna")).state == "refused"
        assert hall.device.written == []
        assert (await over_http(one, "order-1", 7))["state"] == "done"
        assert hall.device.written == [(10, 7)]
