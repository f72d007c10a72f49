"""The polling engine: samples of what devices say, reasons for what they do not, intervals, and what it learns."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import pytest
from waiting import until

import busway
from busway.apps.collector.adaptive_timeout import SHORTEST
from busway.apps.collector.cost import network_cost
from busway.apps.collector.derived_points import DerivedPoints
from busway.apps.collector.device_status import status_of
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.poller import LinkPoller
from busway.apps.collector.sample_clock import EARLIEST, NANOSECONDS, SampleClock
from busway.apps.collector.samples import SampleBatch, StateInterval
from busway.apps.collector.schedule import LinkSchedule
from busway.codes import Table
from busway.errors import BadReply, ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoReply
from busway.pdu.message import Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.points import Conversion, Point, ReadRules, Reason
from busway.points.point_rules import ItemRange
from busway.points.quality import exception_reason
from busway.values import value_type

H = Table.HOLDING_REGISTERS
START = EARLIEST + 1000 * NANOSECONDS


def number(name: str, start: int, type: str = "uint16", **more: Any) -> Point:
    return Point(name, H, start, value_type(type), **more)


@dataclass
class Device:
    """Registers that hold their own address, behind a link whose transactions take 20 ms of a fake clock."""

    now: float = 100.0
    error: Callable[[], ModbusError] | None = None
    holes: Sequence[int] = ()
    asked: list[Request] = field(default_factory=list)
    timeouts: list[float] = field(default_factory=list)

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        self.timeouts.append(call_options["timeout"])
        self.now += 0.02
        return [self.answer(request) for request in requests]

    def answer(self, request: Any) -> Any:
        self.asked.append(request)
        if self.error is not None:
            return self.error()
        if any(request.address <= hole < request.address + request.count for hole in self.holes):
            return ExceptionReply(2)
        if isinstance(request, ReadCoils):
            return ReadCoils.Reply(bytes((request.count + 7) // 8))
        data = b"".join((request.address + at).to_bytes(2, "big") for at in range(request.count))
        return ReadHoldingRegisters.Reply(data)


@dataclass
class Bench:
    """An engine over a fake device."""

    points: Sequence[Point]
    device: Device = field(default_factory=Device)
    rules: ReadRules = field(default_factory=lambda: ReadRules(bridge=True))
    batches: list[SampleBatch] = field(default_factory=list)
    intervals: list[StateInterval] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.schedule = LinkSchedule(1.0)
        self.book = PlanBook({"c": self.points}, self.rules, network_cost())
        self.poller = LinkPoller(
            "hall",
            self.device,
            self.schedule,
            SampleClock(0.0, START),
            self.batches.append,
            self.intervals.append,
            numbered=True,
            now=lambda: self.device.now,
        )
        self.poller.add("meter", 7, self.book, {"c": 1.0})

    async def until(self, time: float) -> None:
        while self.device.now < time:
            turn = self.schedule.next(self.device.now)
            if isinstance(turn, float):
                self.device.now = min(max(turn, self.device.now + 1e-6), time)
            else:
                await self.poller.make(turn)


async def test_each_point_of_a_read_gets_a_sample_with_the_middle_of_the_transaction() -> None:
    bench = Bench([number("a", 4), number("b", 10, conversion=Conversion(scale=0.1)), number("c", 5, "uint32")])
    await bench.until(103)
    batch = max(bench.batches, key=len)
    assert batch.device == "meter"
    assert dict(zip(batch.points, batch.values, strict=True)) == {"a": 4, "c": (5 << 16) + 6, "b": 1.0}
    assert batch.reasons == 0
    assert batch.half_width == pytest.approx(10_000_000, abs=2)
    begun = (batch.time - START) / NANOSECONDS - 0.01
    assert 100 < begun < bench.device.now


async def test_a_value_that_is_not_good_has_its_reason_and_the_others_are_good() -> None:
    bench = Bench([number("a", 4), number("b", 5, conversion=Conversion(invalid=(5,)))])
    await bench.until(103)
    batch = max(bench.batches, key=len)
    assert list(batch.values) == [4, None]
    assert list(batch.reason_column()) == [0, Reason.NO_VALUE]


async def test_coils_are_read_as_states() -> None:
    bench = Bench([Point("run", Table.COILS, 3), Point("stop", Table.COILS, 5)])
    await bench.until(103)
    assert list(max(bench.batches, key=len).values) == [False, False]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (lambda: ExceptionReply(4), exception_reason(4)),
        (lambda: ExceptionReply(0x55), exception_reason(0x55)),
        (lambda: BadReply("a length that cannot be"), Reason.BROKEN_REPLY),
    ],
)
async def test_what_a_device_refuses_or_breaks_is_a_sample_with_the_reason(
    error: Callable[[], ModbusError], reason: int
) -> None:
    bench = Bench([number("a", 4), number("b", 5)])
    await bench.until(102)
    bench.device.error = error
    bench.batches.clear()
    await bench.until(110)
    assert len(bench.batches) >= 7  # the device lives and keeps its period
    assert {batch.reasons for batch in bench.batches} == {reason}
    assert {tuple(batch.values) for batch in bench.batches} == {(None, None)}
    assert not bench.intervals


@pytest.mark.parametrize(
    ("error", "reason", "interval"),
    [
        (lambda: NoReply("no reply"), Reason.TIMEOUT, Reason.SUSPENDED),
        (lambda: NoReply("not asked", kind="in doubt"), Reason.IN_DOUBT, Reason.SUSPENDED),
        (lambda: LinkDown("refused"), Reason.NO_CONNECTION, Reason.NO_CONNECTION),
        (lambda: ExceptionReply(0x0B), exception_reason(0x0B), Reason.SUSPENDED),
        (lambda: InvalidRequest("no request has this unit"), Reason.CONFIGURATION, Reason.NO_CONNECTION),
        (lambda: ConfigError("the certificate is not there"), Reason.CONFIGURATION, Reason.NO_CONNECTION),
    ],
)
async def test_a_silent_device_has_one_bad_sample_and_then_an_interval_until_it_answers(
    error: Callable[[], ModbusError], reason: int, interval: int
) -> None:
    bench = Bench([number("a", 4)])
    await bench.until(102)
    bench.device.error = error
    bench.batches.clear()
    await bench.until(200)
    assert [batch.reasons for batch in bench.batches] == [reason]
    assert [(each.reason, each.end) for each in bench.intervals] == [(interval, None)]
    bench.device.error = None
    await bench.until(400)
    begun, ended = bench.intervals
    assert (ended.begin, ended.reason) == (begun.begin, begun.reason)
    assert ended.end is not None
    assert bench.batches[1].reasons == 0
    assert bench.batches[1].time <= ended.end
    assert len(bench.batches) > 100


async def test_the_log_says_why_a_device_is_not_read_and_when_it_answers(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench([number("a", 4)])
    await bench.until(102)
    with caplog.at_level("WARNING", "busway.collector"):
        bench.device.error = lambda: NoReply("no reply")
        await bench.until(150)
        bench.device.error = None
        await bench.until(300)
    first, last = [each.getMessage() for each in caplog.records]
    assert "is not read: " in first
    assert last.endswith("answers again")


async def test_a_silent_device_does_not_answer_again_because_its_link_ends(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench([number("a", 4)])
    await bench.until(102)
    with caplog.at_level("WARNING", "busway.collector"):
        bench.device.error = lambda: NoReply("no reply")
        await bench.until(150)
        bench.poller.close()
    assert [each.end is None for each in bench.intervals] == [True, False]
    assert "answers again" not in caplog.text


async def test_an_error_of_the_whole_call_is_that_of_each_read() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(102)

    async def run(unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        raise LinkDown("the link is closed")

    bench.device.run = run  # type: ignore[method-assign]
    bench.batches.clear()
    await bench.until(104)
    assert [batch.reasons for batch in bench.batches] == [Reason.NO_CONNECTION]


async def test_a_hole_is_learnt_and_then_not_asked_for_again() -> None:
    bench = Bench([number(f"p{at}", at) for at in range(40)])
    bench.device.holes = [17]
    await bench.until(150)
    assert [(hole.start, hole.code) for hole in bench.book.knowledge.holes] == [(17, 2)]
    bench.batches.clear()
    bench.device.asked.clear()
    await bench.until(170)
    assert {batch.reasons for batch in bench.batches} == {0}
    assert not [each for each in bench.device.asked if each.address <= 17 < each.address + each.count]


async def test_a_point_that_is_not_asked_for_any_more_is_told_once_and_stands_in_the_status(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench([number(f"p{at}", at) for at in range(40)])
    bench.device.holes = [17]
    await bench.until(170)
    (told,) = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    polled = bench.poller.devices["meter"]
    assert told.startswith("meter/p17 is not read: ")
    assert told.endswith("; `busway collect learnt FILE --forget meter` has it asked again")
    assert list(polled.unread) == ["p17"]
    assert status_of(bench.poller, "meter").unread == (f"p17: {polled.unread['p17']}",)


async def test_a_point_that_is_not_asked_for_is_bad_for_its_reason_again_after_each_outage() -> None:
    bench = Bench([number(f"p{at}", at) for at in range(40)])
    bench.device.holes = [17]
    await bench.until(150)
    bench.device.error = lambda: NoReply("no reply")
    await bench.until(160)
    bench.device.error = None
    bench.batches.clear()
    await bench.until(400)
    (mark,) = [batch for batch in bench.batches if "p17" in batch.points]
    assert (mark.points, list(mark.values), mark.reasons) == (("p17",), [None], exception_reason(2))
    assert mark.time == bench.intervals[-1].end


async def test_a_point_that_no_read_may_fetch_by_its_rules_is_bad_once_for_its_configuration() -> None:
    loop, device, batches = asyncio.get_running_loop(), Device(), list[SampleBatch]()
    poller = LinkPoller(
        "plc", device, LinkSchedule(1.0), SampleClock(loop.time(), START), batches.append, print,
        numbered=True, now=loop.time,
    )  # fmt: skip
    rules = ReadRules(forbidden={H: (ItemRange(5, 6),)}, bridge=True)
    book = PlanBook({"c": [number("a", 4), number("b", 5)]}, rules, network_cost())
    poller.add("plc", 1, book, {"c": 0.001})
    task = asyncio.create_task(poller.run())
    await until(lambda: len(batches) > 20)
    poller.finish()
    await task
    marks = [batch for batch in batches if "b" in batch.points]
    assert [(each.points, list(each.values), each.reasons) for each in marks] == [
        (("b",), [None], Reason.CONFIGURATION)
    ]
    assert {batch.reasons for batch in batches if batch.points == ("a",)} == {0}
    assert not [each for each in device.asked if each.address <= 5 < each.address + each.count]


async def test_the_cost_of_reads_is_learnt_from_their_times() -> None:
    bench = Bench([number(f"p{at}", at) for at in range(40)])
    await bench.until(200)
    assert bench.book.cost.base == pytest.approx(0.02, rel=0.01)
    assert bench.book.knowledge.base == pytest.approx(0.02, rel=0.01)


async def test_the_timeout_follows_the_device_where_replies_are_numbered() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(150)
    assert bench.device.timeouts[0] == 1.0
    assert bench.device.timeouts[-1] == SHORTEST


async def test_it_is_told_within_which_time_parts_of_the_last_requests_were_answered() -> None:
    bench = Bench([number("a", 4)])
    assert bench.poller.latencies((0.5, 0.9)) == []
    answered = bench.device.run

    async def run(unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        bench.device.now += 0.5 if len(bench.device.asked) % 20 == 0 else 0.0  # one of twenty is slow
        return await answered(unit, requests, call_options)

    bench.device.run = run  # type: ignore[method-assign]
    await bench.until(400)
    assert bench.poller.latencies((0.5, 0.9, 0.99)) == [pytest.approx(each) for each in (0.02, 0.02, 0.52)]


async def test_maintenance_is_an_interval_without_reads() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    bench.poller.pause("meter", paused=True)
    bench.device.asked.clear()
    await bench.until(150)
    assert not bench.device.asked
    bench.poller.pause("meter", paused=False)
    await bench.until(160)
    assert [each.reason for each in bench.intervals] == [Reason.MAINTENANCE] * 2
    assert len(bench.device.asked) >= 9


async def test_a_read_that_is_under_way_when_maintenance_begins_gives_no_samples() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    answered = bench.device.run

    async def run(unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        bench.poller.pause("meter", paused=True)
        bench.batches.clear()
        return await answered(unit, requests, call_options)

    bench.device.run = run  # type: ignore[method-assign]
    await bench.until(107)
    assert bench.batches == []
    bench.device.run = answered  # type: ignore[method-assign]
    bench.poller.pause("meter", paused=False)
    await bench.until(109)
    begun, ended = bench.intervals
    assert ended.end is not None
    assert bench.batches
    assert not [batch for batch in bench.batches if begun.begin <= batch.time < ended.end]


async def test_a_read_under_way_over_the_whole_of_maintenance_gives_no_samples() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    answered = bench.device.run

    async def run(unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        bench.device.run = answered  # type: ignore[method-assign]
        bench.device.now += 0.02
        bench.poller.pause("meter", paused=True)
        bench.device.now += 0.02
        bench.poller.pause("meter", paused=False)
        bench.batches.clear()
        return await answered(unit, requests, call_options)

    bench.device.run = run  # type: ignore[method-assign]
    await bench.until(108)
    _, ended = bench.intervals
    assert ended.end is not None
    assert not [batch for batch in bench.batches if ended.begin <= batch.time < ended.end]
    assert bench.batches, "it is polled again"


async def test_a_read_that_waits_for_its_pause_when_maintenance_begins_is_not_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    bench.device.asked.clear()

    async def wait_for(device: str) -> None:
        bench.poller.pause("meter", paused=True)

    monkeypatch.setattr(bench.poller, "wait_for", wait_for)
    await bench.until(108)
    assert not bench.device.asked


async def test_a_device_whose_first_request_waits_for_its_pause_when_maintenance_begins_is_polled_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As after a command, whose write begins the pause."""
    bench = Bench([number("a", 4)])

    async def wait_for(device: str) -> None:
        monkeypatch.undo()
        bench.poller.pause("meter", paused=True)

    monkeypatch.setattr(bench.poller, "wait_for", wait_for)
    await bench.until(105)
    assert not bench.device.asked
    bench.poller.pause("meter", paused=False)
    await bench.until(110)
    assert len(bench.device.asked) >= 4


async def test_skipped_rounds_are_an_interval() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    bench.device.now += 10  # the machine slept
    await bench.until(120)
    (skipped,) = bench.intervals
    assert skipped.reason == Reason.SKIPPED
    assert skipped.end is not None
    assert skipped.end - skipped.begin == pytest.approx(10 * NANOSECONDS, rel=0.15)


async def test_a_sample_says_when_the_clock_is_not_known_to_be_right() -> None:
    bench = Bench([number("a", 4)])
    bench.poller._clock = SampleClock(0.0, 1)
    await bench.until(103)
    assert list(bench.batches[-1].reason_column()) == [Reason.CLOCK]
    assert list(bench.batches[-1].values) == [4]


async def test_leased_points_are_read_more_often_while_the_lease_lasts() -> None:
    bench = Bench([number("a", 4), number("b", 500)])
    await bench.until(105)
    bench.poller.lease("meter", ["a"], 0.1, 5.0)
    bench.batches.clear()
    await bench.until(110)
    assert sum("a" in batch.points for batch in bench.batches) >= 45
    assert sum("b" in batch.points for batch in bench.batches) <= 7
    bench.batches.clear()
    await bench.until(120)
    assert sum("a" in batch.points for batch in bench.batches) <= 12


async def test_a_write_goes_before_the_reads() -> None:
    bench = Bench([number("a", 4)])
    await bench.until(105)
    done: list[int] = []

    async def perform() -> None:
        done.append(len(bench.device.asked))

    before = len(bench.device.asked)
    bench.device.now += 3
    assert bench.poller.write("meter", perform)
    await bench.until(110)
    assert done == [before]


async def test_a_device_is_polled_over_a_real_link_until_the_task_is_cancelled() -> None:
    units = {1: busway.Device(holding_registers=100)}
    async with busway.serve("tcp://127.0.0.1:0", units=units) as server, busway.open(server.endpoints[0]) as link:
        units[1].holding_registers[3:5] = [300, 400]
        loop = asyncio.get_running_loop()
        batches: asyncio.Queue[SampleBatch] = asyncio.Queue()
        schedule = LinkSchedule(1.0, batch=4)
        poller = LinkPoller(
            "plc",
            link,
            schedule,
            SampleClock(loop.time(), START),
            batches.put_nowait,
            print,
            numbered=True,
            now=loop.time,
        )
        points = [number("x", 3), number("y", 4), number("far", 99)]
        poller.add("plc", 1, PlanBook({"c": points}, ReadRules(), network_cost()), {"c": 0.02})
        task = asyncio.create_task(poller.run())
        seen: dict[str, Any] = {}
        async with asyncio.timeout(60):
            while len(seen) < 3:
                batch = await batches.get()
                if batch.reasons == 0:  # else the machine paused for longer than a timeout
                    seen |= dict(zip(batch.points, batch.values, strict=True))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert seen == {"x": 300, "y": 400, "far": 0}


async def test_a_write_wakes_an_engine_that_sleeps() -> None:
    loop = asyncio.get_running_loop()
    schedule = LinkSchedule(1.0)
    device = Device()
    poller = LinkPoller(
        "plc",
        device,
        schedule,
        SampleClock(loop.time(), START),
        lambda batch: None,
        print,
        numbered=True,
        now=loop.time,
    )
    poller.add("plc", 1, PlanBook({"c": [number("a", 1)]}, ReadRules(), network_cost()), {"c": 3600.0})
    task = asyncio.create_task(poller.run())
    written = asyncio.Event()
    await asyncio.sleep(0)
    poller.write("plc", lambda: _set(written))
    async with asyncio.timeout(60):
        await written.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def _set(event: asyncio.Event) -> None:
    event.set()


async def test_members_of_a_group_are_read_once_their_number_is_known() -> None:
    members = [number(f"m{at}", 10 + at, exists=(("count", at),)) for at in range(1, 10)]
    points = [number("count", 4), *members]
    bench = Bench(points)
    bench.poller.add(
        "counted", 8, PlanBook({"c": points}, bench.rules, network_cost()), {"c": 1.0}, DerivedPoints("counted", points)
    )
    await bench.until(110)
    widest = max((each for each in bench.batches if each.device == "counted"), key=len)
    assert widest.points == ("count", "m1", "m2", "m3", "m4")


async def test_computed_points_are_samples_of_their_round() -> None:
    points = [number("a", 4), number("b", 900), Point("sum", H, 0, formula="a + b")]
    bench = Bench(points[:2])
    bench.poller.remove("meter")
    bench.poller.add("meter", 7, bench.book, {"c": 1.0}, DerivedPoints("meter", points))
    await bench.until(110)
    found = [each for each in bench.batches if each.points == ("sum",)]
    assert len(found) >= 8
    assert {each.values[0] for each in found} == {904.0}


@pytest.mark.parametrize(("on_line", "seconds"), [(False, SHORTEST), (True, 2.0)])
def test_behind_a_gateway_to_a_line_replies_have_the_configured_time(on_line: bool, seconds: float) -> None:
    """A silent neighbour on the line holds up the replies of a device that answers in a millisecond."""
    poller = LinkPoller(
        "plc", Device(), LinkSchedule(2.0), SampleClock(0.0, START), lambda batch: None, print,
        numbered=True, now=lambda: 0.0,
    )  # fmt: skip
    book = PlanBook({"c": [number("a", 1)]}, ReadRules(), network_cost())
    poller.add("plc", 1, book, {"c": 1.0}, on_line=on_line)
    timeout = poller.devices["plc"].timeout
    for _ in range(100):
        timeout.answered(0.001)
    assert timeout.seconds == seconds


async def test_a_value_whose_scale_factor_was_not_read_when_due_is_held() -> None:
    factor = number("factor", 4, is_exponent=True)
    scaled = number("power", 900, conversion=Conversion(scale_from="factor"))
    bench = Bench([scaled])
    bench.poller.remove("meter")
    book = PlanBook({"slow": [factor], "fast": [scaled]}, bench.rules, network_cost())
    bench.poller.add("meter", 7, book, {"slow": 10.0, "fast": 1.0}, limits={"factor": 20.0, "power": 3.0})
    await bench.until(115)
    bench.batches.clear()
    bench.device.holes = (4,)
    await bench.until(140)
    found = [
        (batch.time, reason)
        for batch in bench.batches
        for point, reason in zip(batch.points, batch.reason_column(), strict=True)
        if point == "power"
    ]
    assert {reason for _, reason in found} == {Reason.NONE, Reason.HELD}
    reasons = [reason for _, reason in sorted(found)]
    assert reasons == sorted(reasons), "once it is held, it stays so until the factor is read"
    assert bench.poller.is_factor_held("meter", "factor")


async def test_a_counter_with_a_scale_factor_rolls_over_where_its_registers_end() -> None:
    class Counting(Device):
        registers = (2, 65_530)

        def answer(self, request: Any) -> Any:
            values = self.registers[request.address : request.address + request.count]
            return ReadHoldingRegisters.Reply(b"".join(value.to_bytes(2, "big") for value in values))

    counter = number(
        "energy", 1, conversion=Conversion(scale_from="factor"), rollover=65_536.0, rollover_is_scaled=True
    )
    points = [number("factor", 0, is_exponent=True), counter]
    device = Counting()
    bench = Bench(points, device=device)
    bench.poller.remove("meter")
    bench.poller.add("meter", 7, bench.book, {"c": 1.0}, DerivedPoints("meter", points))
    await bench.until(105)
    device.registers = (2, 4)
    await bench.until(110)
    totals = [
        value
        for batch in bench.batches
        for name, value in zip(batch.points, batch.values, strict=True)
        if name == "energy"
    ]
    assert (totals[0], totals[-1]) == (6_553_000, 6_554_000)


async def test_a_device_that_needs_a_pause_gets_it() -> None:
    loop = asyncio.get_running_loop()
    asked: list[float] = []

    class Slow(Device):
        async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
            asked.append(loop.time())
            return [self.answer(request) for request in requests]

    poller = LinkPoller(
        "plc",
        Slow(),
        LinkSchedule(1.0),
        SampleClock(loop.time(), START),
        lambda batch: None,
        print,
        numbered=True,
        now=loop.time,
    )
    book = PlanBook({"c": [number("a", 1)]}, ReadRules(), network_cost())
    poller.add("plc", 1, book, {"c": 0.01}, pause=0.05)
    task = asyncio.create_task(poller.run())
    await until(lambda: len(asked) >= 4)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert min(b - a for a, b in pairwise(asked)) >= 0.05
