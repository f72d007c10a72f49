"""Attacks on commands, one by one: what a device gets on its wire, and the result of a command that was sent before.

The device is a plain socket (`wire_recorder`) that answers a write when the test says so.
"""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from waiting import until
from wire_recorder import RecordedUnit, WireRecorder

import busway
from busway.apps.collector.commands.command import CommandResult, CommandState
from busway.apps.collector.commands.runner import MOST_OPEN, CommandRunner, NoSuchPoint
from busway.errors import InvalidRequest

DONE, EXPIRED, REFUSED = CommandState.DONE, CommandState.EXPIRED, CommandState.REFUSED
VALVE = """\
[[unit]]
READ
[[unit.point]]
name = "a"
address = "4x1"
write = { verify = "read-back" }
[[unit.point]]
name = "b"
address = "4x2"
[[unit.point]]
name = "door"
address = "4x3.3"
"""


@dataclass
class Wired:
    """A collector over one device."""

    collector: busway.Collector
    wire: WireRecorder
    file: Path

    @property
    def unit(self) -> RecordedUnit:
        return self.wire.units["hall", 1]

    @property
    def commands(self) -> CommandRunner:
        return self.collector.commands

    async def write(self, point: str, value: Any, **more: Any) -> CommandResult:
        return await self.collector.write("valve", point, value, **{"by": "anna", **more})

    def written(self) -> list[tuple[int, ...]]:
        return [each.items for each in self.wire.writes()]

    async def held(self, point: str = "b", value: int = 1, **more: Any) -> "asyncio.Task[CommandResult]":
        """A command whose write has arrived, and is answered when `WireRecorder.release` is called."""
        self.unit.next.append("wait")
        count = len(self.written())
        task = asyncio.create_task(self.write(point, value, **more))
        await until(lambda: len(self.written()) > count)
        return task


@asynccontextmanager
async def wired(folder: Path, *, read: str = "", more: str = "", period: float = 0.1) -> AsyncIterator[Wired]:
    with WireRecorder() as wire:
        url = wire.open("hall", [1])
        (folder / "valve.toml").write_text(VALVE.replace("READ", read))
        file = folder / "plant.toml"
        file.write_text(
            f'[collector]\nstore = "data"\npage = "off"\n[poll_class]\nall.period = {period}\n{more}'
            f'[[link]]\nname = "hall"\nurl = "{url}"\ntimeout = 30\n'
            '[[device]]\nname = "valve"\nlink = "hall"\nunit = 1\nprofile = "valve.toml"\n'
        )
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled", 20)
            yield Wired(collector, wire, file)


# A key that was used: its result is that of the first command, and never that nothing was sent.


async def test_a_key_that_was_sent_is_not_refused_while_too_many_commands_are_open(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        first = await plant.write("a", 7, key="k")
        waiting = [await plant.held()]
        waiting += [asyncio.create_task(plant.write("b", 2)) for _ in range(MOST_OPEN - 1)]
        await asyncio.sleep(0)
        assert await plant.write("a", 7, key="k", by="ben", origin="mqtt") == first
        other = await plant.write("a", 8, key="k")
        assert (other.state, "used for another command" in other.reason) == (REFUSED, True)
        new = await plant.write("a", 7, key="new")
        assert (new.state, new.reason) == (REFUSED, "16 commands of valve are open; nothing was sent")
        plant.wire.release()
        await asyncio.gather(*waiting)
        assert plant.written().count((7,)) == 1


async def test_a_key_that_was_sent_is_not_refused_beside_one_that_uses_it_for_something_else(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        first = await plant.write("a", 7, key="k")
        others = [("a", 8), ("a", 7), ("b", 7), ("a", 7), ("a", 8)]
        results = await asyncio.gather(*(plant.write(point, value, key="k") for point, value in others))
        assert [each == first for each in results] == [False, True, False, True, False]
        assert all("for another command, valve/a = 7" in results[place].reason for place in (0, 2, 4))
        assert plant.written() == [(7,)]


async def test_a_key_for_two_things_at_once_is_that_of_the_first(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        results = await asyncio.gather(*(plant.write("a", value, key="k") for value in (7, 8, 7, 8)))
        assert [each.state for each in results] == [DONE, REFUSED, DONE, REFUSED]
        assert plant.written() == [(7,)]


async def test_a_key_that_was_sent_is_not_refused_while_the_audit_log_cannot_be_written(tmp_path: Path) -> None:
    async with wired(tmp_path, more='[audit]\non_failure = "refuse"\npath = "audit.log"\n') as plant:
        first = await plant.write("a", 7, key="k")
        assert plant.collector._audit is not None
        plant.collector._audit.is_failing = True
        assert await plant.write("a", 7, key="k") == first
        new = await plant.write("a", 7, key="new")
        assert (new.state, new.reason) == (REFUSED, "the audit log cannot be written; nothing was sent")
        plant.collector._audit.is_failing = False
        assert (await plant.write("a", 7, key="new")).is_done
        assert plant.written() == [(7,), (7,)]


async def test_a_key_whose_use_cannot_be_read_is_not_said_to_be_unsent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with wired(tmp_path, more='[audit]\non_failure = "refuse"\npath = "audit.log"\n') as plant:
        await plant.write("a", 7, key="k")

        def broken(result: CommandResult) -> None:
            raise OSError("the disk is broken")

        monkeypatch.setattr(plant.commands._journal, "known", broken)
        assert plant.collector._audit is not None
        plant.collector._audit.is_failing = True
        result = await plant.write("a", 7, key="k")
        assert (result.state, "nothing was sent" in result.reason) == (REFUSED, False)
        assert "whether its key was used before cannot be read: the disk is broken" in result.reason
        plant.collector._audit.is_failing = False


async def test_a_key_that_was_sent_gives_its_result_after_its_point_has_gone(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        first = await plant.write("a", 7, key="k")
        (tmp_path / "valve.toml").write_text(VALVE.replace("READ", "").replace('"a"', '"c"'))
        await plant.collector.read_again()
        assert await plant.write("a", 7, key="k") == first
        with pytest.raises(NoSuchPoint):
            await plant.write("a", 7, key="new")


async def test_a_key_whose_use_cannot_be_read_after_its_point_has_gone_is_answered_with_a_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with wired(tmp_path) as plant:
        await plant.write("a", 7, key="k")
        (tmp_path / "valve.toml").write_text(VALVE.replace("READ", "").replace('"a"', '"c"'))
        await plant.collector.read_again()

        def broken(result: CommandResult) -> None:
            raise OSError("the disk is broken")

        with monkeypatch.context() as disk:
            disk.setattr(plant.commands._journal, "known", broken)
            result = await plant.write("a", 7, key="k")
        assert (result.state, "nothing was sent" in result.reason) == (REFUSED, False)
        assert "there is no point 'a' of valve" in result.reason
        assert "whether its key was used before cannot be read: the disk is broken" in result.reason
        assert plant.written() == [(7,)]


async def test_a_command_while_its_link_is_begun_anew_keeps_its_key(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        first = await plant.held("b", 1, key="first")
        (tmp_path / "valve.toml").write_text(VALVE.replace("READ", "").replace("4x1", "4x51"))
        reading = asyncio.create_task(plant.collector.read_again())
        await until(lambda: plant.collector.configuration.devices["valve"].points[0].start == 50)
        result = await plant.write("a", 7, key="k")
        assert (result.state, result.reason) == (
            REFUSED,
            "the link of valve is not polled at this moment; nothing was sent",
        )
        with pytest.raises(InvalidRequest, match="not polled at this moment"):
            plant.commands.arm("valve", "a", 7, by="anna", origin="page")
        again = asyncio.create_task(plant.write("b", 1, key="first"))
        plant.wire.release()
        assert (await first).is_done
        assert (await again) == (await first)
        await reading
        assert (await plant.write("a", 7, key="k")).is_done
        assert [(each.address, each.items) for each in plant.wire.writes()] == [(1, (1,)), (50, (7,))]


async def test_a_result_that_could_not_be_recorded_is_recorded_without_another_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with wired(tmp_path) as plant:
        journal, finish = plant.commands._journal, plant.commands._journal.finish

        def full(result: CommandResult) -> None:
            raise OSError("the disk is full")

        monkeypatch.setattr(journal, "finish", full)
        result = await plant.write("a", 7, key="k")
        await plant.commands.record_again()
        monkeypatch.setattr(journal, "finish", finish)
        found = journal.find("k")
        assert found is not None
        assert found.state is CommandState.OPEN
        await plant.commands.record_again()
        assert journal.find("k") == result


# Time.


async def test_what_expires_in_the_pause_between_reading_and_writing_a_register_is_not_sent(tmp_path: Path) -> None:
    async with wired(tmp_path, read="read = { pause = 0.5 }", period=3600) as plant:
        await until(lambda: len(plant.wire.requests) == 2)  # its first contact and its first round
        await asyncio.sleep(0.55)
        result = await plant.write("door", True, expires=time.time() + 0.3)
        assert (result.state, plant.written()) == (EXPIRED, [])


@pytest.mark.parametrize("step", [3600.0, -3600.0])
async def test_a_clock_that_is_set_sends_nothing_whose_time_is_over(tmp_path: Path, step: float) -> None:
    async with wired(tmp_path) as plant:
        first = await plant.held(expires=time.time() + 3000)
        begun = time.time()
        late = asyncio.create_task(plant.write("a", 5, expires=begun + 0.05))
        set_over = asyncio.create_task(plant.write("a", 6, expires=begun + 1800))
        await asyncio.sleep(0.1)
        plant.commands._now = lambda: time.time() + step
        plant.wire.release()
        await first
        assert (await late).state is EXPIRED
        assert (await set_over).state is (EXPIRED if step > 0 else DONE)
        assert plant.written() == [(1,)] + [(6,)] * (step < 0)


@pytest.mark.parametrize("step", [3600.0, -3600.0, 0.0])
async def test_an_armed_command_is_not_sent_after_its_minute_whatever_the_clock_says(
    tmp_path: Path, step: float
) -> None:
    async with wired(tmp_path) as plant:
        moment, now = 100.0, 1_800_000_000.0
        plant.commands._moment, plant.commands._now = lambda: moment, lambda: now
        armed = plant.commands.arm("valve", "a", 7, by="anna", origin="page")
        moment, now = moment + 60.0, now + 60.0 + step
        assert (await plant.commands.confirm(armed.command.key, by="anna")).state is EXPIRED
        for _ in range(256):
            plant.commands.arm("valve", "a", 7, by="anna", origin="page")
        moment += 121
        plant.commands.arm("valve", "a", 7, by="anna", origin="page")
        assert plant.written() == []


# What a person saw is what is written.


async def test_a_command_that_was_armed_before_its_link_was_begun_anew_is_not_sent(tmp_path: Path) -> None:
    async with wired(tmp_path) as plant:
        armed = plant.commands.arm("valve", "a", 7, by="anna", origin="page")
        (tmp_path / "valve.toml").write_text(
            VALVE.replace("READ", "").replace('name = "a"', 'name = "x"').replace('"b"', '"a"').replace('"x"', '"b"')
        )
        await plant.collector.read_again()
        with pytest.raises(InvalidRequest, match="begun anew since this was armed; arm it anew"):
            await plant.commands.confirm(armed.command.key, by="anna")
        assert plant.written() == []


# Reading back.


@pytest.mark.parametrize(
    ("deed", "state", "read_back"),
    [
        ("done", "done", 6),
        ("other", "failed", 7),
        ("overwritten", "failed", 7),
        ("refuse", "failed", None),
        ("cut", "unknown", None),
        ("cut before", "unknown", None),
    ],
)
async def test_the_state_of_a_write_is_what_the_device_has_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deed: str, state: str, read_back: int | None
) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.SHOWN_AFTER", (0.0, 0.01))
    async with wired(tmp_path) as plant:
        plant.unit.registers[0] = 6  # it is there already: nothing but an answer says that it was written
        plant.unit.next.append(deed)
        result = await plant.write("a", 6, key="k")
        assert (result.state.value, result.read_back) == (state, read_back)
        assert await plant.write("a", 6, key="k") == result
        assert plant.written() == [(6,)]
