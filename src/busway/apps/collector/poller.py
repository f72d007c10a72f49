"""Polls the devices of one link: sends the reads that the schedule chooses, and turns replies into samples.

Knows the schedule, a link of asyncio and the decoders of points; knows no store and no file.

1. Every read of a polling round gives each of its points a sample: good, or bad with the reason. A probe of a silent
   device that fails gives none: the interval in which the device is suspended stands for its samples.
2. The time of a sample is the middle of its transaction; half of the transaction's length is kept too.
3. A point that no read fetches, for example because the device was found to refuse it, gets a bad sample with that
   reason at the first answer of its device, and again after each interval: its last value is never "not read yet".
4. Nothing that a device or a link does ends polling. A defect in a decoder or in a receiver of samples does: its
   exception ends the task, and is raised where the task is awaited.
"""

import asyncio
import logging
import math
from collections import deque
from collections.abc import Awaitable, Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

from ...codes import ExceptionCode, Table
from ...errors import BadReply, ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoReply, Overloaded
from ...pdu.message import Request
from ...pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from ...points.decoder import ReadDecoder
from ...points.point import Point
from ...points.quality import Reading, Reason, exception_reason, reason_text
from ...values.counts import counted
from .adaptive_timeout import AdaptiveTimeout
from .derived_points import DerivedPoints
from .knowledge import DeviceKnowledge
from .learning import ReadOutcome, outcome_of
from .plan import PlannedRead, ReadItem
from .plan_cache import PlanBook
from .sample_clock import ClockCorrection, SampleClock
from .samples import PointGroup, SampleBatch, StateInterval, failed_batch
from .schedule import LinkSchedule, Turn, TurnKind, TurnOutcome

MOST_DECODERS: Final = 512
"""Most compiled reads of one device that are kept."""
KEPT_LATENCIES: Final = 1000
"""Number of response times that are kept for each link, to compute quantiles."""
MOST_SHARED_DECODERS: Final = 4096
"""Most decoders that are kept to be shared by devices."""

_log = logging.getLogger("busway.collector")

_REQUESTS: Final = {
    Table.COILS: ReadCoils,
    Table.DISCRETE_INPUTS: ReadDiscreteInputs,
    Table.INPUT_REGISTERS: ReadInputRegisters,
    Table.HOLDING_REGISTERS: ReadHoldingRegisters,
}
_GATEWAY_EXCEPTIONS: Final = frozenset(
    {ExceptionCode.GATEWAY_PATH_UNAVAILABLE, ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND}
)


class PollLink(Protocol):
    """Interface of the link over which a poller sends its reads; `busway.AsyncLink` implements it."""

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        """Send requests to a unit, and return a reply or a `ModbusError` for each request, in order.

        Args:
            unit: unit identifier.
            requests: the requests.
            call_options: a dictionary of `CallOptions`: the timeout in seconds, and the number of retries.
        """


@dataclass(slots=True, eq=False)
class _CompiledRead:
    """A planned read, ready to be sent: the request, the decoder of its reply, and the points whose samples it gives.

    Attributes:
        read: the planned read.
        request: the request to send.
        decoder: makes values from the data of the reply.
        group: the device and the points, in the order of the values.
        data: the data of the last reply, kept for `PolledDevice.registers_of`; empty before the first.
        at: sample time of that reply, nanoseconds since 1970 UTC.
        exponents: names of the points in the read that are scale factors of other points.
        scaled: for each point in the read whose scale factor is in another read: its place among the values, and the
            name of the factor.
    """

    read: PlannedRead
    request: Any  # a request of the table's class
    decoder: ReadDecoder
    group: PointGroup
    data: bytes = b""
    at: int = 0
    exponents: tuple[str, ...] = ()
    scaled: tuple[tuple[int, str], ...] = ()


@dataclass(frozen=True, slots=True)
class _QueuedWrite:
    """A command's write that waits for its turn on the link.

    Attributes:
        perform: makes the write on the link and reports its result itself.
        drop: called instead if polling ends first; None for nothing.
    """

    perform: Callable[[], Awaitable[None]]
    drop: Callable[[], None] | None


_decoders: dict[tuple[Any, ...], ReadDecoder] = {}
"""Decoders by the range of a read and the ``id()`` of its points: devices with the same profile share them."""


def _decoder_of(read: PlannedRead) -> ReadDecoder:
    key = (read.table, read.start, read.width, *map(id, read.items))
    found = _decoders.get(key)
    if found is None:
        if len(_decoders) >= MOST_SHARED_DECODERS:
            _decoders.clear()
        found = _decoders[key] = ReadDecoder(read.items, read.table, read.start, read.width)
    return found


@dataclass(slots=True)
class PolledDevice:
    """A device as its poller knows it: points, read plans, and what was read last.

    Attributes:
        name: name of the device.
        unit: its unit identifier.
        book: its read plans.
        timeout: how long to wait for its replies.
        derived: computes totals and formulas from its reads; None if it has none.
        pause: least seconds from a reply to the next request to the device.
        ready_at: when it may be asked next, seconds of the monotonic clock.
        limits: seconds without a read after which the value of a point is held, by name.
        scale_factors: exponents read from the device that scale the values of other points, by name.
        factors_at: when each scale factor was read last, seconds of the monotonic clock, by name.
        reads: number of reads in polling rounds since the device was added, failed ones included.
        failures: number of these reads that failed.
        last_seconds: how many seconds its last transaction took.
        last_error: the last error, also after the device answers again; empty if there was none.
        maintained: the interval of the maintenance that ended last; None if none has ended.
        suspended: the present interval in which the device is not polled, because it is silent or in maintenance; None
            while it is polled.
        unread: points that no allowed read can fetch, by name, each with the reason.
        unread_given: whether the points in ``unread`` got their bad sample (rule 3) since the device was added, or
            since its last interval ended.
        single: for each point that got a sample on its own, a group with only that point, by name of the point.
    """

    name: str
    unit: int
    book: PlanBook
    timeout: AdaptiveTimeout
    derived: DerivedPoints | None = None
    pause: float = 0.0
    ready_at: float = 0.0
    limits: Mapping[str, float] = field(default_factory=dict)
    scale_factors: dict[str, int] = field(default_factory=dict)
    factors_at: dict[str, float] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    unread_given: bool = False
    reads: int = 0
    failures: int = 0
    last_seconds: float = 0.0
    last_error: str = ""
    maintained: StateInterval | None = None
    suspended: StateInterval | None = None
    single: dict[str, PointGroup] = field(default_factory=dict)
    _compiled: dict[int, _CompiledRead] = field(default_factory=dict)

    def registers_of(self, points: Container[str]) -> dict[str, bytes]:
        """Return the raw registers of points as last read, by point: two bytes for each register.

        Left out are points that were not read yet or whose last reply was forgotten (`compiled`), coils, discrete
        inputs and computed points.
        """
        found: dict[str, bytes] = {}
        for each in sorted(self._compiled.values(), key=lambda one: one.at):
            if not each.data or each.read.table in (Table.COILS, Table.DISCRETE_INPUTS):
                continue
            for item in each.read.items:
                if item.name in points:
                    begin = 2 * (item.start - each.read.start)
                    found[item.name] = bytes(each.data[begin : begin + 2 * item.width])
        return found

    def is_factor_held(self, name: str, now: float) -> bool:
        """Whether a scale factor was not read again when it was due, so that values scaled by it are uncertain.

        False for a factor that was never read.

        Args:
            name: name of the point with the factor.
            now: seconds of the monotonic clock.
        """
        at = self.factors_at.get(name)
        return at is not None and now - at > self.limits.get(name, math.inf)

    def compiled(self, read: PlannedRead) -> _CompiledRead:
        """Return a planned read of the device with its request, decoder and points; made at the first use, and kept.

        When `MOST_DECODERS` of them are kept, all are forgotten before the next is made, with the last reply of each.
        """
        found = self._compiled.get(id(read))
        if found is None or found.read is not read:
            if len(self._compiled) >= MOST_DECODERS:
                self._compiled.clear()
            names = tuple(point.name for point in read.items)
            found = self._compiled[id(read)] = _CompiledRead(
                read,
                _REQUESTS[read.table](read.start, read.width),
                _decoder_of(read),
                PointGroup(self.name, names),
                exponents=tuple(point.name for point in read.items if point.is_exponent),
                scaled=tuple(
                    (place, factor)
                    for place, point in enumerate(read.items)
                    if (factor := point.conversion.scale_from) and factor not in names
                ),
            )
        return found


class LinkPoller:
    """Polls the devices of one link, in a task that runs `run`. All methods must be called in the event loop's thread.

    Args:
        name: name of the link.
        link: sends the requests.
        schedule: decides what is sent next; `add` adds devices to it.
        clock: gives samples their time.
        samples: called with each batch of samples at once; must not block.
        intervals: called with each interval in which a device is not read, when it begins and again when it ends. An
            interval of skipped rounds is passed only once, when it is over.
        numbered: whether replies carry a transaction identifier, so that timeouts can adapt to reply times.
        now: returns seconds of the monotonic clock, which is also the clock of the schedule.

    Attributes:
        devices: the polled devices, by name.
    """

    def __init__(
        self,
        name: str,
        link: PollLink,
        schedule: LinkSchedule,
        clock: SampleClock,
        samples: Callable[[SampleBatch], None],
        intervals: Callable[[StateInterval], None],
        *,
        numbered: bool,
        now: Callable[[], float],
    ) -> None:
        self.name = name
        self.link = link
        self.schedule = schedule
        self.devices: dict[str, PolledDevice] = {}
        self._clock = clock
        self._samples = samples
        self._intervals = intervals
        self._numbered = numbered
        self._now = now
        self._wake: asyncio.Event | None = None
        self._has_ended = self._is_finishing = False
        self._latencies: deque[float] = deque(maxlen=KEPT_LATENCIES)

    def latencies(self, parts: Sequence[float]) -> list[float]:
        """Return quantiles of the response times of the link, in seconds, in the order of ``parts``.

        They are computed from the last `KEPT_LATENCIES` answered transactions. Empty before the first answer.

        Args:
            parts: the quantiles wanted, each 0…1; 0.5 is the median.
        """
        kept = sorted(self._latencies)
        return [kept[min(int(part * len(kept)), len(kept) - 1)] for part in parts] if kept else []

    # Devices.

    def add(
        self,
        name: str,
        unit: int,
        book: PlanBook,
        periods: Mapping[str, float],
        derived: DerivedPoints | None = None,
        pause: float = 0.0,
        on_line: bool = False,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        """Begin to poll one more device of the link.

        Args:
            name: name of the device.
            unit: its unit identifier.
            book: its read plans.
            periods: poll periods in seconds, by poll class.
            derived: computes totals and formulas from its reads; None if it has none.
            pause: least seconds from a reply to the next request to the device.
            on_line: whether the device is on a serial line, local or behind a gateway, where another silent device
                holds up its replies; its timeout then does not adapt.
            limits: seconds without a read after which the value of a point is held, by name; None for no limits.
        """
        timeout = AdaptiveTimeout(self.schedule.timeout, numbered=self._numbered and not on_line)
        if derived is not None:
            book.set_absent(derived.absent())
        self.devices[name] = PolledDevice(name, unit, book, timeout, derived, pause, limits=limits or {})
        self.schedule.add(name, book, periods, self._now())
        self.wake()

    def remove(self, name: str) -> None:
        """Stop polling a device and forget it; an interval in which it is not polled is reported as ended now."""
        device = self.devices.pop(name, None)
        if device is not None:
            self._end_interval(device)
            self.schedule.remove(name)

    def pause(self, name: str, *, paused: bool, since: int | None = None) -> None:
        """Begin or end the maintenance of a device; a device in maintenance is not polled.

        The interval in which the device was not polled until now, because of silence or maintenance, ends and is
        reported. If a maintenance begins, its interval is reported too, without an end.

        Args:
            name: name of the device.
            paused: True begins the maintenance, False ends it.
            since: when the maintenance began, nanoseconds since 1970 UTC; None for now.
        """
        device = self.devices[name]
        if name in self.schedule.devices:
            self.schedule.pause(name, paused=paused, now=self._now())
        self._end_interval(device)
        if paused:
            begin = self._clock.time_ns(self._now()) if since is None else since
            device.suspended = StateInterval(name, begin, None, Reason.MAINTENANCE)
            self._intervals(device.suspended)
        self.wake()

    def lease(self, name: str, points: Sequence[str], period: float, seconds: float) -> None:
        """Read some points of a device more often for a while, with priority over regular polling.

        Args:
            name: name of the device.
            points: names of its points; names of other points are ignored.
            period: seconds between two reads.
            seconds: how long this lasts from now on. Replaces an earlier lease of the device.
        """
        wanted = set(points)
        items = [each for each in self.devices[name].book.points() if each.name in wanted]
        now = self._now()
        self.schedule.lease(name, items, period, now + seconds, now)
        self.wake()

    def write(self, name: str, perform: Callable[[], Awaitable[None]], drop: Callable[[], None] | None = None) -> bool:
        """Queue a write to a device, to be made before the reads that are due.

        Args:
            name: name of the device.
            perform: makes the write on the link and reports its result itself; it must not raise.
            drop: called instead of ``perform`` if polling ends first, so that nothing was sent; None for nothing.

        Returns:
            False, with nothing queued, if too many writes wait or polling has ended; else True.
        """
        if self._has_ended:
            return False
        taken = self.schedule.write(name, _QueuedWrite(perform, drop))
        self.wake()
        return taken

    async def wait_for(self, name: str) -> None:
        """Wait until the pause that a device needs between two requests is over; return at once if there is none."""
        device = self.devices[name]
        if device.ready_at > self._now():
            await asyncio.sleep(device.ready_at - self._now())

    def note_asked(self, name: str) -> None:
        """Begin the pause that a device needs between two requests, because the caller sent it one for a command."""
        device = self.devices.get(name)
        if device is not None and device.pause:
            device.ready_at = self._now() + device.pause

    def note_reading(self, name: str, point: Point, found: Reading, began: float) -> None:
        """Pass on the value of a point that was read before or after a write, as a sample.

        Nothing is passed on for a counter, whose samples are its totals, for a device in maintenance, or for one that
        is no longer polled.

        Args:
            name: name of the device.
            point: the point.
            found: its value, and the reason why the value is not good; the reason is 0 if it is good.
            began: when the read began, seconds of the monotonic clock; it ended now.
        """
        device = self.devices.get(name)
        if device is None or point.rollover:  # a counter's sample is its total
            return
        ended = self._now()
        group = device.single.setdefault(point.name, PointGroup(name, (point.name,)))
        reason = found.reason or (Reason.NONE if self._clock.is_right else Reason.CLOCK)
        half = int((ended - began) * 500_000_000)
        batch = SampleBatch(group, self._clock.time_ns((began + ended) / 2), half, (found.value,), int(reason))
        if device.derived is not None:
            batch, _ = device.derived.take(batch, ended)
        self._give(device, batch)

    def is_factor_held(self, name: str, factor: str) -> bool:
        """Whether a scale factor of a device was not read again when it was due, so that it cannot be relied on now."""
        return self.devices[name].is_factor_held(factor, self._now())

    def wake(self) -> None:
        """Let the polling task check the schedule now, because the schedule has changed."""
        if self._wake is not None:
            self._wake.set()

    @property
    def is_finishing(self) -> bool:
        """Whether polling has ended, or will end after the transaction in progress."""
        return self._is_finishing or self._has_ended

    def finish(self) -> None:
        """End polling after the transaction in progress, so that no reply is on its way then; return at once."""
        self._is_finishing = True
        self.wake()

    # The task.

    async def run(self) -> None:
        """Poll the devices of the link until `finish` is called or the task is cancelled; then drop waiting writes.

        For each dropped write its function ``drop`` is called.

        Raises:
            Exception: a defect of a decoder or a receiver of samples (rule 4).
        """
        self._wake = asyncio.Event()
        for device in self.devices.values():
            self._log_unread(device)
        try:
            while not self._is_finishing:
                turn = self.schedule.next(self._now())
                if isinstance(turn, float):
                    await self._sleep(turn - self._now())
                else:
                    await self.make(turn)
        finally:
            self._has_ended = True
            for queued in self.schedule.take_writes():
                if queued.drop is not None:
                    queued.drop()

    async def _sleep(self, seconds: float) -> None:
        assert self._wake is not None
        self._wake.clear()
        try:
            async with asyncio.timeout(max(seconds, 0.0)):
                await self._wake.wait()
        except TimeoutError:
            pass

    def mend(self, correction: ClockCorrection) -> None:
        """Correct the begin of each present silence or maintenance that was noted before the wall clock was right.

        Nothing is passed on to ``intervals``.
        """
        for device in self.devices.values():
            begun = device.suspended
            if begun is not None:
                device.suspended = replace(begun, begin=correction.corrected(begun.begin))

    def close(self) -> None:
        """Report the end of each present silence of a device, because polling stops; maintenance goes on."""
        for device in self.devices.values():
            if device.suspended is not None and device.suspended.reason != Reason.MAINTENANCE:
                self._end_interval(device)

    async def make(self, turn: Turn) -> None:
        """Send the reads or make the write of one turn, pass on the samples, and report the outcome to the schedule.

        Waits first for the pause that the device needs between two requests. If the maintenance of the device begins
        during that wait, its reads are neither sent nor reported to the schedule.
        """
        device = self.devices.get(turn.device)
        if device is not None:
            await self.wait_for(turn.device)
        if turn.kind is not TurnKind.WRITE and device is not None and self._is_maintained(device):
            return  # it began during the wait, and people may work at the device now
        began = self._now()
        if turn.kind is TurnKind.WRITE:
            await turn.write.perform()
            self.schedule.done(turn, began, self._now(), TurnOutcome.ANSWERED)
            return
        if device is None:
            self.schedule.done(turn, began, began, TurnOutcome.DOWN)
            return
        if turn.round is not None and turn.round.skipped_since is not None:
            self._report_skipped(turn.device, turn.round.skipped_since, began)
            turn.round.skipped_since = None
        compiled = [device.compiled(read) for read in turn.reads]
        options = {"timeout": device.timeout.seconds, "retries": 0}
        try:
            outcomes = await self.link.run(device.unit, [each.request for each in compiled], options)
        except ModbusError as error:
            outcomes = [error] * len(compiled)
        ended = self._now()
        device.ready_at = ended + device.pause if device.pause else 0.0
        self._take(device, turn, compiled, outcomes, began, ended)

    # What came of it.

    def _take(
        self,
        device: PolledDevice,
        turn: Turn,
        compiled: Sequence[_CompiledRead],
        outcomes: Sequence[Any],  # replies and errors
        began: float,
        ended: float,
    ) -> None:
        middle = self._clock.time_ns((began + ended) / 2)
        half = int((ended - began) * 500_000_000)
        result = TurnOutcome.SILENT
        device.last_seconds = ended - began
        for each, outcome in zip(compiled, outcomes, strict=True):
            error = outcome if isinstance(outcome, ModbusError) else None
            if error is None:
                try:
                    batch = self._decoded(device, each, outcome, middle, half, ended)
                except BadReply as broken:
                    error = broken
            if error is not None:
                result = self._failed(device, turn, each, error, result, middle, half)
                continue
            result = TurnOutcome.ANSWERED
            if device.derived is not None:
                batch, changed = device.derived.take(batch, ended, device.scale_factors)
                if changed:
                    device.book.set_absent(device.derived.absent())
            self._give(device, batch)
            device.reads += turn.kind is TurnKind.ROUND
            self._learn(device, turn, each.read, ReadOutcome.SUCCESS, ended - began, alone=len(compiled) == 1)
        if device.derived is not None and turn.round is not None and not turn.round.reads:
            usual = Reason.NONE if self._clock.is_right else Reason.CLOCK
            computed = device.derived.computed(middle, half, ended, usual)
            if computed is not None:
                self._give(device, computed)
        if result is TurnOutcome.ANSWERED:
            device.timeout.answered(ended - began)
            self._latencies.append(ended - began)
            if device.suspended is not None and device.suspended.reason != Reason.MAINTENANCE:
                _log.warning("%s answers again", device.name)
                self._end_interval(device, middle)
            self._give_unread(device, middle, half)
        elif result is TurnOutcome.SILENT:
            device.timeout.silent()
        self.schedule.done(turn, began, ended, result)
        if result is not TurnOutcome.ANSWERED and device.suspended is None and self.schedule.devices.get(device.name):
            down = result is TurnOutcome.DOWN
            self._begin_interval(device, Reason.NO_CONNECTION if down else Reason.SUSPENDED, ended)

    def _decoded(
        self, device: PolledDevice, compiled: _CompiledRead, reply: Any, middle: int, half: int, ended: float
    ) -> SampleBatch:
        decoder = compiled.decoder
        data = reply.data
        if len(data) != decoder.size:
            raise BadReply(f"{counted(len(data), 'byte')} came where {decoder.size} were asked for", kind="content")
        compiled.data, compiled.at = data, middle
        found = decoder.decode(data, device.scale_factors)
        for name in compiled.exponents:
            device.factors_at[name] = ended
        held = [place for place, factor in compiled.scaled if device.is_factor_held(factor, ended)]
        if not found.flaws and self._clock.is_right and not held:
            return SampleBatch(compiled.group, middle, half, found.values)
        usual = Reason.NONE if self._clock.is_right else Reason.CLOCK
        reasons = [int(usual)] * len(found.values)
        for place in held:
            reasons[place] = Reason.HELD
        for place, reason in found.flaws.items():
            reasons[place] = reason
        return SampleBatch(compiled.group, middle, half, found.values, reasons)

    def _failed(
        self,
        device: PolledDevice,
        turn: Turn,
        compiled: _CompiledRead,
        error: ModbusError,
        before: TurnOutcome,
        middle: int,
        half: int,
    ) -> TurnOutcome:
        """Learn from a failed read; if it was one of a polling round, count it and pass on bad samples.

        Returns:
            The outcome of the turn so far: ``before``, which is the outcome of its earlier reads, combined with this
            failure.
        """
        reason, result = _judged(error)
        device.last_error = str(error)
        if turn.kind is TurnKind.ROUND:
            device.reads += 1
            device.failures += 1
            self._give(device, failed_batch(compiled.group, middle, half, reason))
            if device.derived is not None:
                device.derived.failed(compiled.group.points, reason)
        code = error.code if isinstance(error, ExceptionReply) else None
        outcome = outcome_of(code, silent=result is TurnOutcome.SILENT and code is None)
        self._learn(device, turn, compiled.read, outcome, 0.0, alone=False, code=code or 0)
        if TurnOutcome.ANSWERED in (before, result):
            return TurnOutcome.ANSWERED
        return result

    def _learn(
        self,
        device: PolledDevice,
        turn: Turn,
        read: PlannedRead,
        outcome: ReadOutcome,
        seconds: float,
        *,
        alone: bool,
        code: int = 0,
    ) -> None:
        if turn.kind is TurnKind.TEST_READ:
            device.book.answered(read, outcome, seconds, code)
        elif outcome is not ReadOutcome.SUCCESS:
            device.book.failed(read, outcome, code)
        elif alone:
            device.book.succeeded(read, seconds)
        if turn.kind is TurnKind.TEST_READ or outcome is not ReadOutcome.SUCCESS:
            self._log_unread(device)

    def _log_unread(self, device: PolledDevice) -> None:
        """Update `PolledDevice.unread`; log each point that is new in it, with the reason why no read can fetch it."""
        unread = {each.item.name: each.reason for each in device.book.unreadable}
        for point, reason in unread.items():
            if point not in device.unread:
                learnt = device.book.knowledge.holes
                again = f"; `busway collect learnt FILE --forget {device.name}` has it asked again" if learnt else ""
                _log.warning("%s/%s is not read: %s%s", device.name, point, reason, again)
        device.unread = unread

    def _give_unread(self, device: PolledDevice, middle: int, half: int) -> None:
        """Pass on a bad sample for each point that no read fetches (rule 3), once after each interval.

        Args:
            device: the device, which has answered now.
            middle: time of the samples, nanoseconds since 1970 UTC.
            half: half the length of the transaction, nanoseconds.
        """
        if device.unread_given:
            return
        device.unread_given = True
        if not device.unread:
            return
        for item in device.book.points():
            if item.name in device.unread:
                reason = _reason_not_to_ask(device.book.knowledge, item)
                group = device.single.setdefault(item.name, PointGroup(device.name, (item.name,)))
                self._give(device, failed_batch(group, middle, half, reason))
                if device.derived is not None:
                    device.derived.failed(group.points, reason)

    # Intervals.

    @staticmethod
    def _is_maintained(device: PolledDevice) -> bool:
        return device.suspended is not None and device.suspended.reason == Reason.MAINTENANCE

    def _report_skipped(self, device: str, since: float, until: float) -> None:
        begin, end = self._clock.time_ns(since), self._clock.time_ns(until)
        self._intervals(StateInterval(device, begin, max(begin, end), Reason.SKIPPED))

    def _begin_interval(self, device: PolledDevice, reason: int, at: float) -> None:
        device.suspended = StateInterval(device.name, self._clock.time_ns(at), None, reason)
        _log.warning("%s is not read: %s", device.name, reason_text(reason))
        self._intervals(device.suspended)

    def _give(self, device: PolledDevice, batch: SampleBatch) -> None:
        """Pass on the samples of a read; drop them if the device was in maintenance at their time."""
        begun = device.suspended if self._is_maintained(device) else device.maintained
        if begun is None or not begun.begin <= batch.time < (begun.end or batch.time + 1):
            self._samples(batch)

    def _end_interval(self, device: PolledDevice, at: int | None = None) -> None:
        begun = device.suspended
        if begun is not None:
            device.suspended, device.unread_given = None, False
            end = max(begun.begin, self._clock.time_ns(self._now()) if at is None else at)
            ended = StateInterval(begun.device, begun.begin, end, begun.reason)
            if begun.reason == Reason.MAINTENANCE:
                device.maintained = ended
            self._intervals(ended)


def _reason_not_to_ask(known: DeviceKnowledge, item: ReadItem) -> int:
    """Return the reason, as in `Sample.reason`, why no read fetches an item.

    If a learnt hole or border touches the item, it is the exception that the device answered there, or `Reason.TIMEOUT`
    if it did not answer. Otherwise it is `Reason.CONFIGURATION`: the rules for the device permit no read of the item.
    """
    for hole in known.holes:
        if hole.table is item.table and hole.start < item.start + item.width and item.start < hole.end:
            return exception_reason(hole.code) if hole.code else Reason.TIMEOUT
    return Reason.CONFIGURATION


def _judged(error: ModbusError) -> tuple[int, TurnOutcome]:
    """Return the reason for the bad samples of a failed read, and what its error shows about the device.

    No reply, and an exception of a gateway that does not reach the device, show that the device is silent. Any other
    exception, and a broken reply, show that it answers. A lost connection, an overloaded link and an invalid request
    show nothing.
    """
    if isinstance(error, ExceptionReply):
        unreachable = error.code in _GATEWAY_EXCEPTIONS
        return exception_reason(error.code), TurnOutcome.SILENT if unreachable else TurnOutcome.ANSWERED
    if isinstance(error, BadReply):
        return Reason.BROKEN_REPLY, TurnOutcome.ANSWERED
    if isinstance(error, NoReply):
        return Reason.IN_DOUBT if error.kind == "in doubt" else Reason.TIMEOUT, TurnOutcome.SILENT
    if isinstance(error, LinkDown | Overloaded):
        return Reason.NO_CONNECTION, TurnOutcome.DOWN
    if isinstance(error, InvalidRequest | ConfigError):
        return Reason.CONFIGURATION, TurnOutcome.DOWN
    return Reason.BROKEN_REPLY, TurnOutcome.ANSWERED
