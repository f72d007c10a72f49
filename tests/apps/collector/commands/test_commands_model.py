"""No write twice, and no way round the rule: commands with few keys in any order, on a device that answers as it likes,
in a collector that is killed at any step.

The device notes what it executes. Each key has numbers of its own, so its record shows which key wrote.
"""

import asyncio
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from examples import examples
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from busway.access.audit_log import AuditLog
from busway.apps.collector.commands.command import CommandResult, CommandState, OldValue
from busway.apps.collector.commands.journal import CommandJournal
from busway.apps.collector.commands.runner import CommandRunner, NoSuchPoint, WriteTarget
from busway.apps.collector.cost import network_cost
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.poller import LinkPoller
from busway.apps.collector.sample_clock import EARLIEST, SampleClock
from busway.apps.collector.schedule import LinkSchedule
from busway.codes import Table
from busway.errors import ExceptionReply, InvalidRequest, LinkDown, NoReply, Overloaded, WriteOutcomeUnknown
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.points import Point, ReadRules, WriteRule
from busway.values import value_type

KEYS = 4
SPAN = 1000
"""Numbers of one key: key 2 writes 2000…2999."""
MOST = 30_000
POINT = Point(
    "setpoint",
    Table.HOLDING_REGISTERS,
    0,
    value_type("uint16"),
    writing=WriteRule(function=6, verify="read-back", minimum=10, maximum=MOST, step=10),
)
LEVEL = Point("level", Table.HOLDING_REGISTERS, 1, value_type("uint16"))


class Killed(BaseException):
    """The process has ended here."""


class Boiler:
    """A device behind a link: what it executes, and what it says about it."""

    def __init__(self) -> None:
        self.executed: list[int] = []
        self.behaviour = "answers"
        self.held = 0

    async def run(self, unit: int, requests: Sequence[Any], call_options: Any) -> list[Any]:
        await asyncio.sleep(0)
        return [self.answer(request) for request in requests]

    def answer(self, request: Any) -> Any:
        is_write = isinstance(request, WriteSingleRegister)
        if self.behaviour == "down":
            return LinkDown("no connection", sent=False)
        if self.behaviour == "refuses" and is_write:
            return ExceptionReply(4)
        if self.behaviour == "loses" and is_write:  # it may be executed later or never: here it is
            self.execute(request.value)
            return WriteOutcomeUnknown("no answer")
        if self.behaviour == "is silent":
            return WriteOutcomeUnknown("no answer") if is_write else NoReply("no answer")
        if is_write:
            self.execute(request.value)
            return WriteSingleRegister.Reply(request.address, request.value)
        return ReadHoldingRegisters.Reply((self.held if self.behaviour != "lies" else 7).to_bytes(2, "big"))

    def execute(self, value: int) -> None:
        self.executed.append(value)
        self.held = value


class Targets:
    """One point that can be written, and one that cannot."""

    def __init__(self, poller: LinkPoller) -> None:
        self.poller = poller

    def target(self, device: str, point: str) -> WriteTarget:
        found = {"setpoint": POINT, "level": LEVEL}.get(point)
        if found is None or device != "boiler":
            raise NoSuchPoint(f"there is no {device}/{point}")
        return WriteTarget(found, self.poller)

    def last(self, device: str, point: str) -> OldValue | None:
        return None


class Commands(RuleBasedStateMachine):
    """Commands in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.loop = asyncio.new_event_loop()
        self.folder = tempfile.TemporaryDirectory()
        self.boiler = Boiler()
        self.now = 1_000_000.0
        self.known: dict[str, CommandResult] = {}
        self.armed: list[str] = []
        self.next_armed = KEYS * SPAN
        self.end_at = ""
        self.start()

    def start(self) -> None:
        self.loop.run_until_complete(self._start())

    async def _start(self) -> None:
        loop = asyncio.get_running_loop()
        poller = LinkPoller(
            "hall",
            self.boiler,
            LinkSchedule(1.0),
            SampleClock(loop.time(), EARLIEST),
            lambda batch: None,
            lambda interval: None,
            numbered=True,
            now=loop.time,
        )
        poller.add("boiler", 1, PlanBook({"c": [POINT]}, ReadRules(), network_cost()), {"c": 3600.0})
        self.poller = poller
        self.task = asyncio.create_task(poller.run())
        self.audit = AuditLog(Path(self.folder.name) / "audit.log")
        self.journal = CommandJournal(Path(self.folder.name), most=12)
        self.runner = CommandRunner(Targets(poller), self.journal, self.audit, now=lambda: self.now, step=self.step)
        self.runner.subscribe(self.note)

    def step(self, name: str) -> None:
        if name == self.end_at:
            raise Killed

    def note(self, result: CommandResult) -> None:
        self.known[result.command.key] = result

    def teardown(self) -> None:
        self.loop.run_until_complete(self.stop())
        self.loop.close()
        self.folder.cleanup()

    async def stop(self) -> None:
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)
        await self.runner.close()
        self.audit.close()

    # What may happen.

    @rule(
        commands=st.lists(st.tuples(st.integers(0, KEYS - 1), st.integers(-1, 5)), min_size=1, max_size=4),
        late=st.sampled_from([30.0, 30.0, 0.0, -5.0]),
    )
    def write(self, commands: list[tuple[int, int]], late: float) -> None:
        """Several commands at once. Numbers that are no steps of 10, and one below all, are against the rule."""
        self.loop.run_until_complete(self._write(commands, late))

    async def _write(self, commands: list[tuple[int, int]], late: float) -> None:
        made = [
            self.runner.write(
                "boiler",
                "setpoint",
                -5 if number < 0 else key * SPAN + (5 if number == 5 else 10 * (number + 1)),
                by="anna",
                origin="api",
                expires=self.now + late,
                key=f"k{key}",
            )
            for key, number in commands
        ]
        for found in await asyncio.gather(*made, return_exceptions=True):
            assert isinstance(found, CommandResult | Killed), found

    @rule()
    def arm(self) -> None:
        self.next_armed += 10
        if self.next_armed >= MOST:
            return
        try:
            armed = self.runner.arm("boiler", "setpoint", self.next_armed, by="anna", origin="page")
        except (InvalidRequest, Overloaded):
            return
        self.armed.append(armed.command.key)

    @precondition(lambda self: self.armed)
    @rule(data=st.data(), times=st.integers(1, 3))
    def confirm(self, data: st.DataObject, times: int) -> None:
        key = data.draw(st.sampled_from(self.armed))
        self.loop.run_until_complete(self._confirm(key, times))

    async def _confirm(self, key: str, times: int) -> None:
        made = (self.runner.confirm(key, by="anna") for _ in range(times))
        for found in await asyncio.gather(*made, return_exceptions=True):
            assert isinstance(found, CommandResult | Killed | InvalidRequest), found

    @rule(point=st.sampled_from(["level", "nothing"]), value=st.sampled_from([1, "on", [1], True]))
    def write_what_cannot_be_written(self, point: str, value: Any) -> None:
        try:
            found = self.loop.run_until_complete(
                self.runner.write("boiler", point, value, by="anna", origin="api", key="wrong")
            )
        except NoSuchPoint:
            return
        assert found.state is CommandState.REFUSED

    @rule(behaviour=st.sampled_from(["answers", "refuses", "loses", "is silent", "down", "lies"]))
    def behave(self, behaviour: str) -> None:
        self.boiler.behaviour = behaviour

    @rule(seconds=st.sampled_from([1.0, 20.0, 90.0]))
    def pass_time(self, seconds: float) -> None:
        self.now += seconds

    @rule(paused=st.booleans())
    def maintain(self, paused: bool) -> None:
        self.poller.pause("boiler", paused=paused)

    @rule(step=st.sampled_from(["", "claimed", "answered", "recorded"]))
    def end_at_step(self, step: str) -> None:
        self.end_at = step

    @rule()
    def kill(self) -> None:
        """End the process as it is, and start another one on its files."""
        self.loop.run_until_complete(self._kill())
        self.end_at = ""
        self.start()

    async def _kill(self) -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.runner._thread.shutdown()
        self.journal.close()
        self.audit.close()

    # What must hold.

    @invariant()
    def no_key_is_executed_twice(self) -> None:
        by_key = defaultdict(list)
        for value in self.boiler.executed:
            by_key[value // SPAN if value < KEYS * SPAN else value].append(value)
        assert all(len(values) == 1 for values in by_key.values()), by_key

    @invariant()
    def the_rule_holds(self) -> None:
        assert all(10 <= value <= MOST and value % 10 == 0 for value in self.boiler.executed)

    @invariant()
    def what_is_done_was_executed(self) -> None:
        for result in self.known.values():
            if result.is_done:
                assert result.command.value in self.boiler.executed
            if result.state in (CommandState.REFUSED, CommandState.EXPIRED):
                assert result.command.value not in self.boiler.executed


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.SHOWN_AFTER", (0.0, 0.0))


TestCommands = Commands.TestCase
TestCommands.settings = settings(max_examples=examples(40), stateful_step_count=25, deadline=None)
