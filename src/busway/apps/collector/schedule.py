"""The schedule of one link: decides which read request is sent next, and when.

Pure: every call gets the time as an argument; knows no clock and no socket. A driver asks `LinkSchedule.next`, sends
the requests of the turn that is returned, and reports the result to `LinkSchedule.done`.

1. Writes go first, then leased points (those that a viewer watches), then rounds of poll classes, by the earliest
   deadline. A read that has begun is never interrupted. The reads of a round follow each other, unless a round with an
   earlier deadline comes up. After `MOST_WRITES_IN_A_ROW` writes one read that is due goes between: a flood of commands
   does not stop polling.
2. A round is one pass of reads for all poll classes of a device that are due at about the same time (`SLACK`). Its
   deadline is its due time plus the shortest period of these classes. Due times stand on a grid, so that nothing
   drifts. The first due times of devices are spread by the time that their reads need.
3. A device has at most one round that runs and one that waits. If a class is due again while its round still waits,
   this due time is skipped and counted, never queued: memory does not grow under overload.
4. A device that was not asked yet is asked by one cheap read. A silent device is suspended: its rounds stop until it
   answers a probe, which is its cheapest read. When it is probed: `silent_devices`. First reads and probes come after
   the rounds, but before them while a whole timeout is saved up for probes.
5. Test reads for learning wait until nothing else is due.
"""

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import count
from typing import Any, Final

from .plan import PlannedRead
from .plan_cache import Classes, PlanBook
from .silent_devices import DEAD_SHARE, LONGEST_BACKOFF, SilentDevices

SLACK: Final = 0.05
"""How early a poll class may be read together with classes that are due, as a fraction of its period."""
MOST_WRITES: Final = 256
"""Most writes that wait for a link; further ones are refused."""
MOST_WRITES_IN_A_ROW: Final = 8
"""Most writes in a row before a read that is due gets its turn."""
_SPREAD: Final = 0.618_033_988_75
"""The golden section: its multiples, modulo 1, are spread evenly however many there are."""
_PLACED_LOAD: Final = 0.85
"""Share of the time between the first due times of two devices that reads of the first device fill on average."""

LEASED: Final = "(leased)"
"""The poll class of leased points: those that a viewer watches, read more often for some seconds (`lease`)."""


class TurnKind(Enum):
    """Why a device is sent a request: a write, a polling round, a probe (does it answer?), or a test read to learn."""

    WRITE = "write"
    ROUND = "round"
    PROBE = "probe"
    TEST_READ = "test read"


class TurnOutcome(Enum):
    """What the requests of a turn have shown about a device: that it answers, that it is silent, or nothing.

    ``ANSWERED``: the device answered, also by an exception. ``SILENT``: it did not answer in time. ``DOWN``: nothing is
    known, because the link was down or lost its connection, was overloaded, or the request was invalid.
    """

    ANSWERED = "answered"  # also by an exception: the device lives
    SILENT = "silent"
    DOWN = "down"  # the link was not there; the device may live


@dataclass(slots=True)
class PollRound:
    """One polling round of a device: one pass of reads that fetches the points of all poll classes that are due.

    Attributes:
        device: name of the device.
        classes: the poll classes that are due.
        due: when the round was due. All times are seconds of the schedule's clock.
        deadline: when the round should have ended.
        reads: the reads still to be sent; empty until the round begins.
        own: seconds that the reads of the round took so far.
        began: when `LinkSchedule.next` returned the first read; None before.
        skipped_since: the first due time of the device that was skipped since its last round began; None if none
            was, and until this round begins.
    """

    device: str
    classes: Classes
    due: float
    deadline: float
    reads: deque[PlannedRead] = field(default_factory=deque)
    own: float = 0.0
    began: float | None = None
    skipped_since: float | None = None

    @property
    def rank(self) -> int:
        """Sort key of waiting rounds: 0 for a round with leased points, which goes first, else 1."""
        return 0 if LEASED in self.classes else 1


@dataclass(frozen=True, slots=True)
class Turn:
    """The next thing to send on a link: some reads of a device, or a write.

    Attributes:
        kind: why the device is asked.
        device: name of the device.
        reads: the reads to send together, at most ``batch`` of the schedule; empty for a write.
        write: the object given to `LinkSchedule.write`; None for reads.
        round: the polling round that the reads belong to; None for other kinds.
    """

    kind: TurnKind
    device: str
    reads: tuple[PlannedRead, ...] = ()
    write: Any = None  # Any: the caller's own
    round: PollRound | None = None


@dataclass(slots=True)
class ScheduledDevice:
    """A device in the schedule of a link: when its poll classes are due, and whether it answers.

    Attributes:
        name: name of the device.
        book: its read plans.
        periods: poll periods in seconds, by poll class; with `LEASED` while points are leased.
        due: when each poll class is due next. All times are seconds of the schedule's clock.
        lives: whether the device answered its last read; None before the first result. Writes do not count.
        waiting: its round that has not begun; None without one.
        release_at: when its next poll class is due, so that a round begins to wait.
        skipped_since: the first due time that was skipped since its last round began; None if none was.
        test_read_at: when a test read for learning may be sent next.
        leased_until: when the lease of its points ends.
        rounds: number of rounds completed so far; a round whose last reads got no answer does not count.
        skipped: number of due times skipped so far.
        worst_wait: the longest time in seconds from the due time of a round to its end, without the time of its own
            reads.
        worst_fast: like ``worst_wait``, but only of rounds with the poll class of the shortest period.
        is_paused: whether the device is in maintenance, and therefore not polled.
    """

    name: str
    book: PlanBook
    periods: dict[str, float]
    due: dict[str, float]
    lives: bool | None = None
    waiting: PollRound | None = None
    release_at: float = 0.0
    skipped_since: float | None = None
    test_read_at: float = 0.0
    leased_until: float = 0.0
    rounds: int = 0
    skipped: int = 0
    worst_wait: float = 0.0
    worst_fast: float = 0.0
    is_paused: bool = False

    @property
    def shortest(self) -> float:
        """The shortest poll period of the device, in seconds."""
        return min(self.periods.values())


class LinkSchedule:
    """Decides which device of one link is sent which request next, and when.

    Args:
        timeout: seconds that a read without a reply takes.
        batch: most reads of a round that are sent at once; 1 on serial lines.
        share: share of the link's time that probes of silent devices may use, above 0 and at most 1.

    Attributes:
        timeout: seconds that a read without a reply takes.
        devices: the devices of the link, by name.
        refused_writes: number of writes refused because too many waited.
        busy: seconds that all turns together took so far.
    """

    def __init__(self, timeout: float, *, batch: int = 1, share: float = DEAD_SHARE) -> None:
        self.timeout = timeout
        self.devices: dict[str, ScheduledDevice] = {}
        self.refused_writes: int = 0
        self.busy: float = 0.0
        self._batch = batch
        self._silent = SilentDevices(timeout, share)
        self._writes: deque[tuple[str, Any]] = deque()
        self._writes_in_a_row = 0
        self._releases: list[tuple[float, int, str]] = []
        self._ready: list[tuple[int, float, int, PollRound]] = []
        self._new: deque[str] = deque()
        self._asking: deque[str] = deque()
        self._numbers = count()
        self._added = 0
        self._placed = 0.0

    # Devices and what is asked of them.

    def add(self, name: str, book: PlanBook, periods: Mapping[str, float], now: float) -> None:
        """Start to poll a device. Its rounds begin once it has answered one cheap read, which `next` returns before.

        Args:
            name: name of the device.
            book: its read plans.
            periods: poll periods in seconds, by poll class. Classes without points of the device are ignored; if no
                class is left, the device is not added.
            now: the time.
        """
        known = {name: period for name, period in periods.items() if name in book.classes}
        if not known:
            return
        device = ScheduledDevice(name, book, known, self._first_dues(book, known, now))
        self.devices[name] = device
        self._silent.add(name)
        self._new.append(name)
        if name not in self._asking:
            self._asking.append(name)

    def _first_dues(self, book: PlanBook, periods: Mapping[str, float], now: float) -> dict[str, float]:
        """Return the first due time of each poll class of a new device, spread so that not all become due together.

        The class with the shortest period is due within one such period from ``now``: after the reads of devices that
        were added before, modulo the period. A class with a longer period is first due at the same time, or a whole
        number of shortest periods later, but less than its own period. The device's reads are counted for the devices
        that are added next.
        """
        shortest = min(periods.values())
        first = now + self._placed % shortest
        for name, period in periods.items():
            self._placed += book.plan_for(frozenset({name})).seconds * (shortest / period) / _PLACED_LOAD
        self._added += 1
        step = (self._added * _SPREAD) % 1.0
        return {name: first + int(step * int(period / shortest + 1e-9)) * shortest for name, period in periods.items()}

    def remove(self, name: str) -> None:
        """Stop polling a device and forget it; a read in progress still ends, and waiting writes stay in the queue."""
        self.devices.pop(name, None)
        self._silent.remove(name)
        self._ready = [each for each in self._ready if each[3].device != name]
        heapq.heapify(self._ready)

    def pause(self, name: str, *, paused: bool, now: float) -> None:
        """Stop polling a device because of maintenance, or poll it again; does nothing if that is already so.

        Args:
            name: name of the device.
            paused: True to stop, False to poll again.
            now: the time.
        """
        device = self.devices[name]
        if device.is_paused is paused:
            return
        device.is_paused = paused
        if paused:
            self._drop_rounds(device)
            self._silent.leave_alone(name)
        else:
            self._resume(device, now, at_once=True)

    def write(self, device: str, what: Any) -> bool:  # Any: the caller's own
        """Queue a write; return False, with nothing queued, if `MOST_WRITES` wait already.

        Args:
            device: name of the device.
            what: what `next` returns as ``write`` of the turn; the schedule does not look into it.
        """
        if len(self._writes) >= MOST_WRITES:
            self.refused_writes += 1
            return False
        self._writes.append((device, what))
        return True

    def take_writes(self) -> list[Any]:  # Any: the caller's own
        """Remove all waiting writes from the queue and return them, oldest first; for the end of polling."""
        waiting = [what for _, what in self._writes]
        self._writes.clear()
        return waiting

    def lease(self, name: str, items: Sequence[Any], period: float, until: float, now: float) -> None:
        """Read some points of a device more often for a while, with priority over the poll classes.

        Replaces an earlier lease of the device. While the device is silent or in maintenance, nothing is read.

        Args:
            name: name of the device.
            items: its points to read.
            period: seconds between two reads.
            until: when the lease ends, a time like ``now``.
            now: the time.
        """
        device = self.devices[name]
        device.book.set_class(LEASED, items)
        device.periods[LEASED] = period
        device.leased_until = until
        device.due[LEASED] = now
        if device.lives and not device.is_paused:
            self._release_at(now, device)

    # What is next.

    def next(self, now: float) -> Turn | float:
        """Return the turn to send now; if nothing is due, return the time at which to call `next` again.

        The caller sends the requests of the turn, calls `done`, and then calls `next` again. If the schedule is changed
        while nothing is due, such as by `write`, `add` or `lease`, the caller calls `next` at once.
        """
        self._silent.credit_until(now)
        self._release_due(now)
        if self._writes and self._writes_in_a_row < MOST_WRITES_IN_A_ROW:
            return self._write_turn()
        self._writes_in_a_row = 0
        due = self._due_read(now)
        if due is None and self._writes:
            return self._write_turn()
        return due or self._next_test_read(now) or self._next_event(now)

    def _write_turn(self) -> Turn:
        self._writes_in_a_row += 1
        device, what = self._writes.popleft()
        return Turn(TurnKind.WRITE, device, write=what)

    def _due_read(self, now: float) -> Turn | None:
        """Return the next read that is due now: of a round, a first read of a new device, or a probe; None if none is.

        First reads and probes come after the rounds; but before them while a whole timeout is saved up for probes
        (rule 4).
        """
        if self._silent.has_saved_a_timeout:  # not even overload keeps a device from its first answer for ever
            asked = self._first_contact() or self._probe(now)
            if asked is not None:
                return asked
        while self._ready:
            turn = self._turn_of_round(now)
            if turn is not None:  # else nothing of it may be read
                return turn
        return self._first_contact() or self._probe(now)

    def _turn_of_round(self, now: float) -> Turn | None:
        chosen = self._ready[0][3]
        device = self.devices[chosen.device]
        if chosen.began is None:
            chosen.began = now
            chosen.reads = deque(device.book.plan_for(chosen.classes).reads)
            chosen.skipped_since, device.skipped_since = device.skipped_since, None
            device.waiting = None
        reads = tuple(chosen.reads.popleft() for _ in range(min(self._batch, len(chosen.reads))))
        if not chosen.reads:
            self._forget_ready(chosen)
        return Turn(TurnKind.ROUND, chosen.device, reads, round=chosen) if reads else None

    def _forget_ready(self, ended: PollRound) -> None:
        if self._ready and self._ready[0][3] is ended:
            heapq.heappop(self._ready)
            return
        self._ready = [each for each in self._ready if each[3] is not ended]
        heapq.heapify(self._ready)

    def _release_due(self, now: float) -> None:
        while self._releases and self._releases[0][0] <= now:
            when, _, name = heapq.heappop(self._releases)
            device = self.devices.get(name)
            if device is not None and device.release_at == when and device.lives and not device.is_paused:
                self._release(device, now)

    def _release(self, device: ScheduledDevice, now: float) -> None:
        """Queue a polling round for the poll classes that are due, or add them to the waiting round (rules 2, 3)."""
        if LEASED in device.periods and now >= device.leased_until:
            del device.periods[LEASED], device.due[LEASED]
            device.book.set_class(LEASED, ())
        due = {
            name: device.due[name]
            for name, period in device.periods.items()
            if device.due[name] <= now + SLACK * period and device.due[name] <= now + device.shortest / 2
        }
        if not any(each <= now for each in due.values()):
            due = {}
        for name, each in due.items():
            following = _next_on_grid(each, device.periods[name], now)
            self._skip(device, round((following - each) / device.periods[name]) - 1, each)
            device.due[name] = following
        if due:
            self._add_to_round(device, due)
        self._release_at(min(device.due.values()), device)

    def _skip(self, device: ScheduledDevice, times: int, since: float) -> None:
        if times > 0:
            device.skipped += times
            if device.skipped_since is None:
                device.skipped_since = since

    def _add_to_round(self, device: ScheduledDevice, due: Mapping[str, float]) -> None:
        waiting = device.waiting
        new = frozenset(due)
        deadline = min(each + device.periods[name] for name, each in due.items())
        if waiting is None:
            waiting = PollRound(device.name, new, min(due.values()), deadline)
        else:
            for name in new & waiting.classes:
                self._skip(device, 1, due[name])
            if new <= waiting.classes:
                return
            self._forget_ready(waiting)
            fresh = min(due[name] + device.periods[name] for name in new - waiting.classes)
            waiting.classes |= new
            waiting.deadline = min(waiting.deadline, fresh)
        device.waiting = waiting
        heapq.heappush(self._ready, (waiting.rank, waiting.deadline, next(self._numbers), waiting))

    def _release_at(self, when: float, device: ScheduledDevice) -> None:
        device.release_at = when
        heapq.heappush(self._releases, (when, next(self._numbers), device.name))

    # What became of it.

    def done(self, turn: Turn, began: float, now: float, outcome: TurnOutcome) -> None:
        """Record the result of a turn after its requests have ended.

        Args:
            turn: what `next` returned.
            began: when the requests were sent.
            now: when the last request was answered or given up.
            outcome: what the requests have shown; for a write it is ``ANSWERED``.
        """
        self.busy += now - began
        device = self.devices.get(turn.device)
        if device is None:
            return
        if turn.kind is TurnKind.PROBE:
            is_silent = device.lives is False or outcome is not TurnOutcome.ANSWERED
            self._silent.probed(now - began, is_silent=is_silent)
        if outcome is TurnOutcome.ANSWERED:
            self._answered(device, turn, now)
            if turn.round is not None:
                self._after_read(device, turn.round, now - began, now)
        else:
            self._unanswered(device, now, down=outcome is TurnOutcome.DOWN)

    def _after_read(self, device: ScheduledDevice, made: PollRound, seconds: float, now: float) -> None:
        made.own += seconds
        if not made.reads:
            device.rounds += 1
            wait = now - made.due - made.own
            device.worst_wait = max(device.worst_wait, wait)
            if made.deadline - made.due <= device.shortest * (1 + SLACK):
                device.worst_fast = max(device.worst_fast, wait)

    def _answered(self, device: ScheduledDevice, turn: Turn, now: float) -> None:
        if device.lives:
            return
        is_read = turn.kind is not TurnKind.WRITE
        self._silent.answered(device.name, now, is_read=is_read)
        if is_read:
            was_suspended = device.lives is False
            device.lives = True
            if not device.is_paused:
                self._resume(device, now, at_once=was_suspended)

    def _resume(self, device: ScheduledDevice, now: float, *, at_once: bool) -> None:
        """Poll a device at its due times again if it answers; if it is silent or was never asked, have it asked now.

        Args:
            device: the device.
            now: the time.
            at_once: whether one round is made now for due times that have passed meanwhile; False to wait for the next
                due time.
        """
        if device.lives is None:
            if device.name not in self._new:  # its first request was not sent, because maintenance began before
                self._new.append(device.name)
            return
        if not device.lives:
            self._silent.probe_now(device.name, now)
            return
        for name, period in device.periods.items():
            if device.due[name] <= now:
                device.due[name] = _next_on_grid(device.due[name], period, now) - (period if at_once else 0.0)
        self._release_at(min(device.due.values()), device)

    def _unanswered(self, device: ScheduledDevice, now: float, *, down: bool) -> None:
        """Suspend a device that did not answer (rule 4); ``down``: whether that was because the link was down."""
        was_polled = bool(device.lives)
        device.lives = False
        self._silent.unanswered(device.name, now, device.shortest, was_polled=was_polled, was_down=down)
        if was_polled:
            self._drop_rounds(device)
        if device.is_paused:
            self._silent.leave_alone(device.name)

    def _drop_rounds(self, device: ScheduledDevice) -> None:
        device.waiting = None
        self._ready = [each for each in self._ready if each[3].device != device.name]
        heapq.heapify(self._ready)

    # First reads, probes and test reads.

    def _first_contact(self) -> Turn | None:
        """Return the first request to a device that was never asked; None if there is no such device.

        Devices in maintenance and devices without a read are not asked.
        """
        for _ in range(len(self._new)):
            device = self.devices.get(self._new.popleft())
            if device is None or device.lives is not None:
                continue
            if device.is_paused:
                self._new.append(device.name)
                continue
            turn = self._probe_turn(device)
            if turn is not None:
                return turn
        return None

    def _probe(self, now: float) -> Turn | None:
        name = self._silent.take_due(now)
        return None if name is None else self._probe_turn(self.devices[name])

    def _probe_turn(self, device: ScheduledDevice) -> Turn | None:
        read = device.book.cheapest
        return None if read is None else Turn(TurnKind.PROBE, device.name, (read,))

    def _next_test_read(self, now: float) -> Turn | None:
        """Return the turn of the next test read for learning: at most one per device in its shortest poll period.

        None if no device has a test read now. Devices that do not answer, or are in maintenance, are left out.
        """
        for _ in range(len(self._asking)):
            device = self.devices.get(self._asking[0])
            if device is None:
                self._asking.popleft()
                continue
            self._asking.rotate(-1)
            if not device.lives or device.is_paused or device.test_read_at > now:
                continue
            device.test_read_at = now + device.shortest
            read = device.book.next_test_read()
            if read is not None:
                return Turn(TurnKind.TEST_READ, device.name, (read,))
        return None

    def _next_event(self, now: float) -> float:
        soonest = self._releases[0][0] if self._releases else now + LONGEST_BACKOFF
        probe_at = self._silent.next_probe_at(now)
        if probe_at is not None:
            soonest = min(soonest, probe_at)
        asking = (each for each in self.devices.values() if each.lives and not each.is_paused and each.book.may_ask)
        asked = (each.test_read_at for each in asking)
        return max(now, min(soonest, min(asked, default=soonest)))

    # What it promises, and what probes took.

    @property
    def probing(self) -> float:
        """The part of `busy` that probes of silent devices took, in seconds."""
        return self._silent.probing

    @property
    def blocking(self) -> float:
        """Longest time in seconds for which other reads hold up a round: that of the longest read plus a timeout.

        The longest read is taken from the plans for all poll classes together, without leased points. Writes are not
        counted.
        """
        longest = (
            read.seconds
            for device in self.devices.values()
            for read in device.book.plan_for(device.book.classes - {LEASED}).reads
        )
        return max(longest, default=0.0) + self.timeout

    @property
    def revival_bound(self) -> float:
        """Longest time in seconds until a silent device that could answer again is polled again.

        On an overloaded link it can take longer.
        """
        silent = sum(not device.lives for device in self.devices.values())
        return self._silent.longest_wait(silent) + self.blocking


def lateness_bound(period: float, blocking: float) -> float:
    """Return how late a polling round can be at most, in seconds, if the admission test has passed.

    Args:
        period: poll period of the class, in seconds.
        blocking: `LinkSchedule.blocking` of the link.
    """
    return max(SLACK * period, blocking)


def _next_on_grid(due: float, period: float, now: float) -> float:
    """Return the first time after ``now`` that is a whole number of periods, one or more, after ``due``."""
    following = due + period
    if following > now:
        return following
    return due + period * (int((now - due) / period) + 1)
