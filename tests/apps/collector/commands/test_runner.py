"""Commands to a real device: written once, confirmed, refused, expired, recorded; what every origin gets."""

import asyncio
import json
import socket
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from commanded_plant import RecordedDevice, commanded_plant
from waiting import set_forward, until

import busway
from busway.apps.collector.commands.command import CommandResult, CommandState
from busway.apps.collector.commands.rights import WriterRights
from busway.apps.collector.commands.runner import MOST_OPEN, NoSuchCommand, NoSuchPoint
from busway.errors import InvalidRequest
from busway.points import WriteRule

DONE, FAILED, UNKNOWN, EXPIRED, REFUSED = (
    CommandState.DONE,
    CommandState.FAILED,
    CommandState.UNKNOWN,
    CommandState.EXPIRED,
    CommandState.REFUSED,
)


@dataclass
class Plant:
    """A collector that polls one recorded device."""

    collector: busway.Collector
    boiler: RecordedDevice
    folder: Path

    async def write(self, point: str, value: Any, **more: Any) -> CommandResult:
        return await self.collector.write("boiler", point, value, by="anna", **more)

    async def hold(self) -> asyncio.Event:
        """Hold the turn of the device until the event is set."""
        held, release = asyncio.Event(), asyncio.Event()

        async def hold() -> None:
            held.set()
            await release.wait()

        assert self.collector._poller_of("boiler").write("boiler", hold)
        await held.wait()
        return release

    def audit(self) -> list[dict[str, Any]]:
        assert self.collector._audit is not None
        self.collector._audit.flush()
        return [json.loads(line) for line in (self.folder / "data" / "audit.log").read_text().splitlines()]


@asynccontextmanager
async def plant(folder: Path, *, link: str = "timeout = 5.0", more: str = "") -> AsyncIterator[Plant]:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(folder, server.endpoints[0], link=link, more=more)
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled")
            await until(lambda: collector.values.last("boiler", "setpoint") is not None)
            yield Plant(collector, boiler, folder)


async def test_a_value_is_written_confirmed_and_told_with_who_old_and_new(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        result = await running.write("setpoint", 21.5)
        assert (result.state, result.read_back, result.reason) == (DONE, 21.5, "")
        assert result.old is not None
        assert (result.old.value, result.old.quality) == (0.0, "good")
        assert running.boiler.writes == [("holding_registers", 0, [215])]
        (line,) = running.audit()
        assert (line["event"], line["by"], line["origin"], line["outcome"]) == ("command", "anna", "program", "done")
        assert (line["old"], line["new"], line["read_back"]) == (0.0, 21.5, 21.5)
        assert [each.command.key for each in await running.collector.commands.newest(10)] == [result.command.key]


@pytest.mark.parametrize(
    ("point", "value", "written"),
    [
        ("mode", "hand", ("holding_registers", 1, [2])),
        ("mode", 1, ("holding_registers", 1, [1])),
        ("pump", True, ("holding_registers", 2, [170])),
        ("pump", False, ("holding_registers", 2, [85])),
        ("door", True, ("holding_registers", 3, [0b1000_0001_0000_1000])),
        ("text", "AbC", ("holding_registers", 9, [0x4162, 0x4300, 0, 0])),
    ],
)
async def test_a_point_is_written_as_its_rule_says(
    tmp_path: Path, point: str, value: Any, written: tuple[str, int, list[int]]
) -> None:
    async with plant(tmp_path) as running:
        running.boiler.device.holding_registers[3] = 0b1000_0001_0000_0000
        assert (await running.write(point, value)).is_done
        assert running.boiler.writes == [written]


@pytest.mark.parametrize(
    ("point", "value", "sentence"),
    [
        ("setpoint", 100.5, "must be 0…100"),
        ("setpoint", -0.5, "must be 0…100"),
        ("setpoint", 21.3, "steps of 0.5"),
        ("setpoint", "21,5", "a number is needed"),
        ("setpoint", True, "a number is needed"),
        ("mode", "manual", "there are off, auto, hand"),
        ("mode", 3, "must be off"),
        ("pump", 170, "is a switch"),
        ("door", 1, "true or false"),
        ("valve", "on", "true or false"),
        ("level", 1, "is only read"),
        ("text", "much too long", "at most 8 bytes"),
        ("heat", 1e39, "does not fit"),
    ],
)
async def test_what_is_against_the_rule_is_refused_and_nothing_is_sent(
    tmp_path: Path, point: str, value: Any, sentence: str
) -> None:
    async with plant(tmp_path) as running:
        result = await running.write(point, value)
        assert result.state is REFUSED
        assert sentence in result.reason
        with pytest.raises(InvalidRequest, match=sentence.replace("(", ".")):
            running.collector.commands.arm("boiler", point, value, by="anna", origin="page")
        assert running.boiler.writes == []
        assert {line["outcome"] for line in running.audit()} == {"refused"}


async def test_a_command_for_no_point_and_one_that_cannot_be_are_errors(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        for device, point in (("other", "setpoint"), ("boiler", "setpoints")):
            with pytest.raises(NoSuchPoint, match="there is no"):
                await running.collector.write(device, point, 1, by="anna")
        for more in ({"key": "with space"}, {"key": "busway-1"}, {"expires": float("nan")}, {"by": ""}):
            with pytest.raises(InvalidRequest):
                await running.collector.write("boiler", "setpoint", 1, **{"by": "anna", **more})
        for value in (float("inf"), {"a": 1}, None, 1 << 70, "x" * 10_000, [1] * 10_000):
            with pytest.raises(InvalidRequest):
                await running.write("setpoint", value)
        assert running.boiler.writes == []


async def test_the_same_key_gives_the_first_result_and_another_value_with_it_is_refused(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        first = await running.write("setpoint", 10, key="order-7")
        running.boiler.device.holding_registers[0] = 0
        again = await running.collector.write("boiler", "setpoint", 10.0, by="bernd", key="order-7", origin="api")
        assert again == first
        other = await running.write("setpoint", 20, key="order-7")
        assert other.state is REFUSED
        assert "this key was used for another command, boiler/setpoint = 10" in other.reason
        assert running.boiler.writes == [("holding_registers", 0, [100])]


async def test_equal_keys_from_two_origins_at_once_are_one_write(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        results = await asyncio.gather(
            *(running.write("setpoint", 30, key="both", origin=origin) for origin in ("api", "mqtt", "nats") * 5),
            running.write("setpoint", 31, key="both"),
        )
        assert running.boiler.writes == [("holding_registers", 0, [300])]
        assert [each.state for each in results[:-1]] == [DONE] * 15
        assert results[-1].state is REFUSED


async def test_a_command_whose_time_is_over_is_not_sent(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        late = await running.write("setpoint", 5, expires=time.time() - 1, key="late")
        assert (late.state, running.boiler.writes) == (EXPIRED, [])
        again = await running.write("setpoint", 5, expires=time.time() + 60, key="late")
        assert (again.state, running.boiler.writes) == (EXPIRED, [])
        far = await running.write("setpoint", 5, expires=time.time() + 100_000)
        assert far.state is REFUSED
        assert "further away" in far.reason


async def test_a_command_that_waits_for_its_turn_longer_than_its_time_is_not_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with plant(tmp_path) as running:
        release = await running.hold()
        poller = running.collector._poller_of("boiler")
        waiting = asyncio.create_task(running.write("setpoint", 5, expires=time.time() + 15))
        await until(lambda: len(poller.schedule._writes) == 1)
        set_forward(monkeypatch, 20.0)
        release.set()
        result = await waiting
        assert (result.state, running.boiler.writes) == (EXPIRED, [])


async def test_maintenance_and_silence_refuse_a_command(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        running.collector.maintenance("boiler", begins=True)
        result = await running.write("setpoint", 5)
        assert (result.state, result.reason) == (REFUSED, "boiler is in maintenance; nothing was sent")
        running.collector.maintenance("boiler", begins=False)
        assert (await running.write("setpoint", 5)).is_done


async def test_a_device_that_is_gone_refuses_with_the_reason(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as closed:
        gone = closed.endpoints[0]
    file = commanded_plant(tmp_path, gone)
    async with busway.collect(file) as collector:
        await until(lambda: collector.status()[0].state == "silent")
        result = await collector.write("boiler", "setpoint", 5, by="anna")
        assert result.state is REFUSED
        assert "boiler does not answer; nothing was sent" in result.reason


async def test_what_the_device_refuses_has_failed_with_its_reason(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:

        def refuse(change: Any) -> None:
            raise busway.Refusal(busway.ExceptionCode.SERVER_DEVICE_BUSY)

        running.boiler.before.append(refuse)
        result = await running.write("setpoint", 5)
        assert result.state is FAILED
        assert "exception 06" in result.reason
        assert len(running.boiler.writes) == 1  # not repeated


async def test_a_device_that_shows_another_value_has_not_done_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.SHOWN_AFTER", (0.0, 0.01))
    async with plant(tmp_path) as running:
        running.boiler.device.on_write(
            "holding_registers",
            lambda change: running.boiler.device.holding_registers.__setitem__(0, 55),
            when="after",
            address=0,
        )
        result = await running.write("setpoint", 21.5)
        assert (result.state, result.read_back) == (FAILED, 5.5)
        assert "shows 5.5, not 21.5" in result.reason
        assert len(running.boiler.writes) == 1


async def test_a_value_is_confirmed_at_another_address_and_the_device_may_need_time(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        loop = asyncio.get_running_loop()
        registers = running.boiler.device.holding_registers

        def follow(change: Any) -> None:
            loop.call_soon_threadsafe(loop.call_later, 0.2, registers.__setitem__, slice(21, 23), list(change.new))

        running.boiler.device.on_write("holding_registers", follow, when="after", address=19, count=2)
        result = await running.write("heat", 80.25)
        assert (result.state, result.read_back) == (DONE, 80.25)
        assert len(running.boiler.writes) == 1


async def test_what_is_read_to_confirm_a_value_is_a_sample(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        file = running.folder / "plant.toml"
        file.write_text(file.read_text().replace("all.period = 0.1", "all.period = 3600"))
        await running.collector.read_again()
        await until(lambda: running.collector.status()[0].state == "polled")
        assert (await running.write("setpoint", 33.5)).is_done
        await until(lambda: (running.collector.values.last("boiler", "setpoint") or (0,))[0] == 33.5)
        table = busway.Store(tmp_path / "data").read("boiler/setpoint", since="1m")
        assert (table.value[-1], table.reason[-1]) == (33.5, 0)


async def test_a_coil_is_confirmed_by_a_bit_elsewhere(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        profile = (tmp_path / "valve.toml").read_text().replace('verify = "4x5"', 'verify = "4x5.2"')
        (tmp_path / "valve.toml").write_text(profile)
        await running.collector.read_again()
        await until(lambda: running.collector.status()[0].state == "polled")
        running.boiler.device.on_write(
            "coils", lambda change: running.boiler.device.holding_registers.__setitem__(4, 4), when="after"
        )
        result = await running.write("valve", True)
        assert (result.state, result.read_back) == (DONE, True)
        assert running.boiler.writes == [("coils", 0, [1])]


async def test_a_write_without_an_answer_is_unknown_and_not_repeated_whatever_the_link_says(tmp_path: Path) -> None:
    boiler, release = RecordedDevice(), threading.Event()
    boiler.before.append(lambda change: release.wait(20))
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: boiler.device}) as server:
        link = "timeout = 0.3\nwrite_retries = 3\nretries = 3"
        file = commanded_plant(tmp_path, server.endpoints[0], link=link, period=3600.0)
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled")
            result = await collector.write("boiler", "mode", "auto", by="anna", key="slow")
            assert result.state is UNKNOWN
            assert "may have been executed" in result.reason
            release.set()
            assert await collector.write("boiler", "mode", "auto", by="anna", key="slow") == result
            later = await collector.write("boiler", "mode", "off", by="anna")
            assert later.is_done or "does not answer" in later.reason
        assert boiler.writes.count(("holding_registers", 1, [1])) == 1


async def test_an_armed_command_is_sent_when_its_own_person_confirms_it(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        commands = running.collector.commands
        armed = commands.arm("boiler", "setpoint", 42, by="anna", origin="page")
        assert armed.sentence == "Write 42 °C to boiler/setpoint, now 0.0 °C (good)?"
        assert running.boiler.writes == []
        with pytest.raises(InvalidRequest, match="anna has armed it"):
            await commands.confirm(armed.command.key, by="bernd")
        result = await commands.confirm(armed.command.key, by="anna")
        assert result.is_done
        assert await commands.confirm(armed.command.key, by="anna") == result
        assert len(running.boiler.writes) == 1
        with pytest.raises(NoSuchCommand):
            await commands.confirm("busway-unknown", by="anna")


async def test_too_many_open_commands_of_a_device_are_refused_without_taking_their_key(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        release = await running.hold()
        waiting = [asyncio.create_task(running.write("mode", number % 3)) for number in range(MOST_OPEN)]
        await asyncio.sleep(0)
        refused = await running.write("mode", 1, key="again")
        assert (refused.state, refused.reason) == (REFUSED, "16 commands of boiler are open; nothing was sent")
        release.set()
        assert all(each.is_done for each in await asyncio.gather(*waiting))
        assert [items for _, _, items in running.boiler.writes] == [[number % 3] for number in range(MOST_OPEN)]
        assert (await running.write("mode", 1, key="again")).is_done


async def test_too_many_open_commands_of_all_devices_together_are_refused_by_their_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.MOST_OPEN_IN_ALL", 2)
    async with plant(tmp_path) as running:
        release = await running.hold()
        waiting = [asyncio.create_task(running.write("mode", number)) for number in range(2)]
        await asyncio.sleep(0)
        refused = await running.write("mode", 1, key="again")
        assert (refused.state, refused.reason) == (REFUSED, "2 commands of all devices are open; nothing was sent")
        release.set()
        assert all(each.is_done for each in await asyncio.gather(*waiting))
        assert (await running.write("mode", 1, key="again")).is_done


async def test_a_collector_that_ends_gives_the_result_of_a_command_that_was_sent_and_refuses_others(
    tmp_path: Path,
) -> None:
    async with plant(tmp_path) as running:
        commands = running.collector.commands
        first = await running.write("setpoint", 5, key="k")
        release = await running.hold()
        waiting = asyncio.create_task(running.write("mode", 1))
        await asyncio.sleep(0)
        closing = asyncio.create_task(commands.close())
        await asyncio.sleep(0)
        assert await running.write("setpoint", 5, key="k") == first
        refused = await running.write("setpoint", 6, key="new")
        assert (refused.state, refused.reason) == (REFUSED, "the collector ends; nothing was sent")
        release.set()
        await closing
        assert (await waiting).is_done
        refused = await running.write("setpoint", 5, key="k")
        assert refused.state is REFUSED
        assert "whether its key was used before cannot be read: it is closed" in refused.reason
        with pytest.raises(OSError, match="it is closed"):
            await commands.confirm("k", by="anna")


async def test_an_error_of_a_subscriber_changes_no_result_and_others_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[CommandResult] = []

    def fail(result: CommandResult) -> None:
        raise KeyError(result.command.key)

    async with plant(tmp_path) as running:
        running.collector.commands.subscribe(fail)
        running.collector.commands.subscribe(told.append)
        results = [await running.write("setpoint", 5), await running.write("setpoint", 1000)]
        assert [each.state for each in results] == [DONE, REFUSED]
        assert told == results
    assert caplog.text.count("a subscriber of commands failed") == 2


async def test_a_link_that_ends_ends_its_commands(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        await running.hold()
        poller = running.collector._poller_of("boiler")
        waiting = asyncio.create_task(running.write("mode", 1))
        await until(lambda: len(poller.schedule._writes) == 1)
        await running.collector._stop_link("hall")
        result = await waiting
        assert (result.state, result.reason) == (FAILED, "the link was closed; nothing was sent")
        assert running.boiler.writes == []


async def test_a_command_goes_on_when_its_caller_does_not_wait(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        waiting = asyncio.create_task(running.write("mode", 1, key="left"))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        assert (await running.write("mode", 1, key="left")).is_done
        assert len(running.boiler.writes) == 1


async def test_a_unit_that_all_devices_of_a_line_obey_is_refused(tmp_path: Path) -> None:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        file = commanded_plant(tmp_path, f"rtu+tcp://127.0.0.1:{listening.getsockname()[1]}")
        file.write_text(file.read_text().replace("unit = 1", "unit = 0"))
        async with busway.collect(file) as collector:
            result = await collector.write("boiler", "setpoint", 5, by="anna")
            assert result.state is REFUSED
            assert "which all devices of a line obey" in result.reason


@pytest.mark.parametrize("is_elsewhere", [False, True])
async def test_unit_0_beside_other_units_of_one_gateway_is_refused_on_whatever_link_they_are(
    tmp_path: Path, is_elsewhere: bool
) -> None:
    async with RecordedDevice().server() as server, RecordedDevice().server() as other:
        url = other.endpoints[0] if is_elsewhere else server.endpoints[0]
        more = f'[[link]]\nname = "roof"\nurl = "{url}"\n'
        more += '[[device]]\nname = "fan"\nlink = "roof"\nunit = 1\nprofile = "valve.toml"\n'
        file = commanded_plant(tmp_path, server.endpoints[0], more=more)
        file.write_text(file.read_text().replace("unit = 1", "unit = 0", 1))
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled")
            result = await collector.write("boiler", "setpoint", 5, by="anna")
            assert (result.state is DONE) is is_elsewhere
            assert ("which all devices of a line obey" in result.reason) is not is_elsewhere


async def test_a_journal_that_cannot_be_written_sends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with plant(tmp_path) as running:
        journal = running.collector.commands._journal

        def full(result: CommandResult) -> None:
            raise OSError("the disk is full")

        monkeypatch.setattr(journal, "take", full)
        result = await running.write("setpoint", 5, key="k")
        assert (result.state, running.boiler.writes) == (REFUSED, [])
        assert "cannot be recorded; nothing was sent: the disk is full" in result.reason
        monkeypatch.undo()
        monkeypatch.setattr(journal, "finish", full)
        result = await running.write("setpoint", 5, key="k")
        assert result.is_done
        assert await running.write("setpoint", 5, key="k") == result
        monkeypatch.undo()
    async with plant(tmp_path) as again:  # it was recorded at the end
        assert (await again.write("setpoint", 5, key="k")).is_done
        assert again.boiler.writes == []


RULES = """
[[unit]]
[[unit.point]]
name = "setpoint"
address = "4x1"
write = { role = "configure" }
[[unit.point]]
name = "breaker"
address = "4x2"
write = { armed = true }
[[unit.point]]
name = "level"
address = "4x3"
"""
VIEW, OPERATE, CONFIGURE = WriterRights("view"), WriterRights("operate"), WriterRights("configure")
NEEDS_OPERATE = "needs the role operate, and the writer has view; nothing was sent"


@pytest.mark.parametrize(
    ("rule", "rights", "sentence"),
    [
        (WriteRule(), VIEW, NEEDS_OPERATE),
        (WriteRule(), OPERATE, ""),
        (None, OPERATE, ""),
        (None, VIEW, NEEDS_OPERATE),
        (
            WriteRule(role="configure"),
            OPERATE,
            "needs the role configure, and the writer has operate; nothing was sent",
        ),
        (WriteRule(role="configure"), CONFIGURE, ""),
        (WriteRule(armed=True), CONFIGURE, "must be armed and then confirmed; nothing was sent"),
        (WriteRule(armed=True), WriterRights("operate", has_armed=True), ""),
        (WriteRule(armed=True), WriterRights("view", has_armed=True), NEEDS_OPERATE),
    ],
)
def test_one_rule_decides_who_may_write_a_point(rule: WriteRule | None, rights: WriterRights, sentence: str) -> None:
    assert rights.refusal(rule) == sentence


async def test_a_point_may_need_the_role_configure_or_two_steps_for_every_writer(tmp_path: Path) -> None:
    async with plant(tmp_path) as running:
        (tmp_path / "valve.toml").write_text(RULES)
        await running.collector.read_again()
        await until(lambda: running.collector.values.last("boiler", "breaker") is not None)
        commands = running.collector.commands

        async def write(point: str, rights: WriterRights) -> CommandResult:
            return await commands.write("boiler", point, 1, by="anna", origin="api", rights=rights)

        refused = await write("setpoint", OPERATE)
        assert (refused.state, "needs the role configure" in refused.reason) == (REFUSED, True)
        assert (await write("setpoint", CONFIGURE)).is_done
        assert (await write("level", OPERATE)).is_done
        refused = await running.write("breaker", 1)
        assert (refused.state, "must be armed" in refused.reason) == (REFUSED, True)
        armed = commands.arm("boiler", "breaker", 1, by="anna", origin="page", rights=OPERATE)
        with pytest.raises(InvalidRequest, match="armed for boiler/breaker"):
            await commands.confirm(armed.command.key, by="anna", point=("boiler", "level"))
        assert (await commands.confirm(armed.command.key, by="anna", point=("boiler", "breaker"))).is_done
        with pytest.raises(InvalidRequest, match="needs the role configure"):
            commands.arm("boiler", "setpoint", 1, by="anna", origin="page", rights=OPERATE)
        assert [line["outcome"] for line in running.audit() if line["event"] == "command"].count("refused") == 3
