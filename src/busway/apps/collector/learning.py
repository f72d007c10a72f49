"""Learns from the reads of a device what they cost, and which ranges it refuses.

Pure: knows reads and their results; knows no clock, no socket and no file.

What a read costs:

1. The price of a register is fixed by the line, so each read that succeeds gives one estimate of the base: its seconds
   less the price of its registers. The median of the last `MEMORY` estimates is the base: up to half of them may be
   wrong, for example because a frame was repeated.
2. Where the line is not known (over a network), the price of a register is learnt too: the median slope between the
   usual durations of reads of different widths. This needs `WIDTHS` widths with `READS_OF_A_WIDTH` reads each. Once the
   price is known, reads of two widths are enough to correct it, and reads of one width leave it as it is: most devices
   are read by few widths. 16 bits count as a register. The base is at least the fraction `LEAST_BASE` of the quickest
   read's time, so that noise on a quick network never makes a read look free.

What the device refuses:

3. Exceptions 02 and 03 mean that something in a read is refused. Three silences in a row mean it too, if meanwhile a
   narrower read succeeds. Everything else (04, 06, a lost connection) teaches nothing.
4. Test reads ask for each half of a refused read once, at low priority; then for the halves of a half that is refused.
   An item that is refused alone is a hole.
5. If both halves succeed, a test read of the items on both sides of the cut finds the reason. If it is refused, the
   device has a hole or a border there; if it succeeds, the read was too wide, unless an equally wide read has
   succeeded before: then no reason is found. The largest width is found by reads of widths in between.
6. A fact that is learnt is used from then on, and not tested again.
"""

from bisect import insort
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations, pairwise
from statistics import median
from typing import Any, Final

from ...codes import ExceptionCode, Table
from .cost import NETWORK_REGISTER, ReadCost
from .knowledge import DeviceKnowledge, LearntHole, LearntLimit
from .plan import ItemRange, PlannedRead, ReadRules

MEMORY: Final = 64
"""Number of latest reads from which the base is computed; a device that got slower is noticed after half as many."""
SETTLED_AFTER: Final = 48
"""Number of reads that must have succeeded before the cost counts as known; it also needs reads of `WIDTHS` widths."""
WIDTHS: Final = 3
"""Number of different widths that must have been read from a device before its cost counts as known."""
READS_OF_A_WIDTH: Final = 3
"""Reads of one width before they count for the price of a register: the first ones are slow, to open connections."""
READS_TO_CORRECT: Final = 8
"""Reads of one width before they correct a price that is known: a few that all went wrong must not spoil the price."""
SLOPE_EVERY: Final = 8
"""Number of reads between two estimates of the price of a register."""
BITS_OF_A_REGISTER: Final = 16
LEAST_BASE: Final = 0.25
"""Least base, as a fraction of the quickest read's time. At 9600 baud, a read of 43 registers has this fraction."""
SILENCES: Final = 3
"""Number of silences in a row after which test reads examine a read (rules 3 and 4)."""
TEST_READS: Final = 64
"""Most test reads that one refusal causes; further holes of the device are found after the next refusal."""

MOST_IGNORED: Final = 1024
"""Most refusals in a row of one read that are ignored, if all its parts were found to succeed."""

_REFUSALS: Final = frozenset({ExceptionCode.ILLEGAL_DATA_ADDRESS, ExceptionCode.ILLEGAL_DATA_VALUE})


class CostLearner:
    """Learns how many seconds reads of one device take, from reads that succeeded.

    Args:
        assumed: the cost that is used until enough is known.
        fixed: whether the seconds per register of ``assumed`` are certain; if not, they are learnt too.

    Attributes:
        reads: number of reads learnt from.
        widths: the different widths of these reads: numbers of registers or of bits. A read of 16 registers and one of
            16 bits count as one width.
    """

    def __init__(self, assumed: ReadCost, *, fixed: bool = True) -> None:
        self._assumed = assumed
        self._fixed = fixed
        self._seen: deque[tuple[float, float]] = deque(maxlen=MEMORY)  # width in registers, and seconds
        self._in_order: list[float] = []  # the estimates of the base, for the median
        self._estimates: deque[float] = deque()
        self._last_slope: float | None = None
        self._probed: list[tuple[float, float]] = []  # like `_seen`
        self.reads: int = 0
        self.widths: set[int] = set()

    def observe(self, table: Table, width: int, seconds: float, *, probes: bool = False) -> None:
        """Learn what reads cost from one read that succeeded at its first attempt.

        Args:
            table: the table that was read.
            width: number of registers or bits that were read.
            seconds: from the begin of the request to the reply.
            probes: whether the read was a test read to measure the cost; after the last of these, call `end_probes`.
        """
        self.reads += 1
        self.widths.add(width)
        seen = (width / BITS_OF_A_REGISTER if table.holds_bits else width, seconds)
        self._seen.append(seen)
        if probes:
            self._probed.append(seen)
        estimate = seconds - self._assumed.per_item(table) * width
        self._estimates.append(estimate)
        insort(self._in_order, estimate)
        if len(self._estimates) > MEMORY:
            self._in_order.remove(self._estimates.popleft())
        if not self._fixed and self.reads % SLOPE_EVERY == 0:
            self._last_slope = self._slope()

    def end_probes(self) -> None:
        """Correct the learnt seconds per register by the test reads since the last call.

        They stay as they are if the seconds per register are ``fixed``, or if fewer than `WIDTHS` widths were read by
        `READS_OF_A_WIDTH` or more of these test reads.
        """
        if not self._fixed:
            found = _slope_of(self._probed, WIDTHS, READS_OF_A_WIDTH)
            self._last_slope = self._last_slope if found is None else found
        self._probed.clear()

    @property
    def is_settled(self) -> bool:
        """Whether the cost counts as known: enough reads were observed, of enough different widths."""
        return self.reads >= SETTLED_AFTER and len(self.widths) >= WIDTHS

    @property
    def cost(self) -> ReadCost:
        """How many seconds reads of the device take, as learnt so far; the assumed cost before the first read.

        From the first read on the base is learnt. The seconds per register are the assumed ones if they are ``fixed``,
        or as long as they are not learnt yet (rule 2).
        """
        if not self._seen:
            return self._assumed
        if not self._fixed:
            slope = self._slope()
            if slope is not None:
                return self._network_cost(slope)
        middle = len(self._in_order) // 2
        base = self._in_order[middle]
        if len(self._in_order) % 2 == 0:
            base = (base + self._in_order[middle - 1]) / 2
        return self._assumed.with_base(max(base, 1e-6))

    def _network_cost(self, slope: float) -> ReadCost:
        """Return the cost of reads, with ``slope`` as the seconds per register unless the base would be too small.

        The base is at least `LEAST_BASE` of the quickest read's time. If ``slope`` leaves less, the base is that, and
        the seconds per register are computed again from the reads. A bit costs a sixteenth of a register.
        """
        least = LEAST_BASE * min(seconds for _, seconds in self._seen)
        base = median(seconds - slope * width for width, seconds in self._seen)
        if base < least:  # what one wide read lost on its way looks like a price
            slope = max(median((seconds - least) / width for width, seconds in self._seen), NETWORK_REGISTER)
        return ReadCost(max(base, least, 1e-6), slope, slope / BITS_OF_A_REGISTER)

    def _slope(self) -> float | None:
        """Return the learnt seconds per register (rule 2).

        They are computed from the last `MEMORY` reads if these have enough widths; otherwise they are as learnt before.
        None if they were never learnt.
        """
        widths, reads = (WIDTHS, READS_OF_A_WIDTH) if self._last_slope is None else (2, READS_TO_CORRECT)
        found = _slope_of(self._seen, widths, reads)
        return self._last_slope if found is None else found


def _slope_of(seen: Iterable[tuple[float, float]], widths: int, reads: int) -> float | None:
    """Return the seconds per register: the median slope over all pairs of widths, at least `NETWORK_REGISTER`.

    The time of a width is the lower quartile of its reads' times. None if fewer than ``widths`` widths have at least
    ``reads`` reads each.

    Args:
        seen: width in registers and seconds of each read.
        widths: least number of different widths.
        reads: least number of reads of a width that counts.
    """
    by_width: dict[float, list[float]] = {}
    for width, seconds in seen:
        by_width.setdefault(width, []).append(seconds)
    usual = {
        width: sorted(each)[(len(each) - 1) // 4]  # what goes wrong makes a read late, never early
        for width, each in by_width.items()
        if len(each) >= reads
    }
    if len(usual) < widths:
        return None
    slopes = [(usual[b] - usual[a]) / (b - a) for a, b in combinations(sorted(usual), 2)]
    return max(median(slopes), NETWORK_REGISTER)


def probes_for(reads: Sequence[PlannedRead], cost: ReadCost) -> list[PlannedRead]:
    """Return test reads of different widths, narrowest first, that measure what reads of a device cost.

    These are one read of each width in ``reads``, a read of the first half of the widest read's items, and a read of
    its narrowest item. Each of the last two is left out if one of its items belongs to an atomic group. If these have
    fewer than `WIDTHS` widths, and the widest read has a hole, there is one more: it ends halfway in the first hole.
    All lie within ranges of ``reads``, and no two have the same width. Empty if ``reads`` is empty.

    Args:
        reads: the reads of a device's plans.
        cost: the assumed cost, for the expected duration of the new reads.
    """
    widest = max(reads, key=lambda read: read.width, default=None)
    if widest is None:
        return []
    found = {widest.width: widest}
    for part in (list(widest.items[: (len(widest.items) + 1) // 2]), [min(widest.items, key=lambda one: one.width)]):
        if all(one.group is None for one in part):
            read = read_of(widest.table, part, cost)
            found.setdefault(read.width, read)
    for read in reads:
        found.setdefault(read.width, read)
    if len(found) < WIDTHS:  # two items apart: the first, and half of the hole that is read anyway
        ends = [(a.start + a.width, b.start) for a, b in pairwise(widest.items) if a.start + a.width < b.start]
        for end, start in ends[:1]:
            width = (end + start + 1) // 2 - widest.start
            read = PlannedRead(widest.table, widest.start, width, widest.items[:1], cost.of(widest.table, width))
            found.setdefault(width, read)
    return sorted(found.values(), key=lambda read: read.width)


def read_of(table: Table, items: Sequence[Any], cost: ReadCost) -> PlannedRead:  # Any: the caller's kind of ReadItem
    """Return the narrowest read that covers some items of a table, with everything between them; no limit is checked.

    Args:
        table: the table.
        items: the items (`ReadItem`) of this table, one or more.
        cost: the cost of reads, for the expected duration of the new read.
    """
    start = min(one.start for one in items)
    width = max(one.start + one.width for one in items) - start
    return PlannedRead(table, start, width, tuple(items), cost.of(table, width))


class ReadOutcome(Enum):
    """The result of a read, as far as it says which ranges the device accepts.

    ``REFUSED``: exception 02 or 03. ``SILENCE``: no reply. ``OTHER``: a failure that says nothing about the range.
    """

    SUCCESS = "success"
    REFUSED = "refused"
    SILENCE = "silence"
    OTHER = "other"


def outcome_of(code: int | None, *, silent: bool = False) -> ReadOutcome:
    """Return what a failed read says about the range that was read.

    This is ``REFUSED`` for the exceptions 02 and 03, ``SILENCE`` if there was no reply at all, else ``OTHER``: another
    exception, a damaged reply, a lost connection.

    Args:
        code: the exception code of the reply; None if there was no exception.
        silent: whether there was no reply at all; ignored if there is a code.
    """
    if code is not None:
        return ReadOutcome.REFUSED if code in _REFUSALS else ReadOutcome.OTHER
    return ReadOutcome.SILENCE if silent else ReadOutcome.OTHER


@dataclass(slots=True)
class _Part:
    """A read that a device refused, and the results of reading its two halves.

    Attributes:
        read: the refused read.
        halves: the reads of the two halves.
        succeeded: how many of the halves were accepted so far, 0…2.
    """

    read: PlannedRead
    halves: list[PlannedRead]
    succeeded: int = 0


class _Purpose(Enum):
    """What a test read is to find out.

    ``CONTROL``: whether the device answers at all. ``ITEM``: whether one item is refused alone. ``HALF``: whether half
    of a refused read is refused. ``GAP``: whether a read across the cut between two accepted halves is refused.
    ``WIDTH``: whether a width between an accepted and a refused one is accepted.
    """

    CONTROL = "control"  # whether the device answers at all
    ITEM = "item"  # whether one item is refused alone
    HALF = "half"
    GAP = "gap"  # whether the hole between two halves is what is refused
    WIDTH = "width"  # whether a width between a good and a bad one succeeds


@dataclass(slots=True)
class _TestRead:
    """A test read: sent only to find out, from its result, what a device refuses.

    Attributes:
        purpose: what it finds out.
        read: the read to send.
        part: the refused read that a ``HALF`` or ``GAP`` belongs to; None for other purposes.
        silences: how often the test read had no reply, in a row.
    """

    purpose: _Purpose
    read: PlannedRead
    part: _Part | None = None
    silences: int = 0


@dataclass(slots=True)
class _Wait:
    """How many refusals of a read are ignored, after test reads found no reason, before they look for it again.

    Attributes:
        left: number of refusals still to be ignored.
        next: how many refusals are ignored the next time that test reads find no reason.
    """

    left: int = 0
    next: int = 4


class MapLearner:
    """Learns which reads one device refuses, and why, by test reads of parts of refused reads.

    Results of ordinary reads go to `observe`. `next_test_read` gives the test read to send, whose result goes to
    `answered`.

    Args:
        knowledge: facts already known about the device.
        cost: what reads of the device cost, for the expected duration of test reads.

    Attributes:
        knowledge: the facts known now, including those known at the beginning.
        asked: number of test reads that had a result, silence included.
        inconclusive: number of refused reads that could not be explained, because all test reads succeeded.
    """

    def __init__(self, knowledge: DeviceKnowledge, cost: ReadCost) -> None:
        self.knowledge: DeviceKnowledge = knowledge
        self.asked: int = 0
        self.inconclusive: int = 0
        self._cost = cost
        self._silences: dict[tuple[Table, int, int], int] = {}
        self._waits: dict[tuple[Table, int, int], _Wait] = {}
        self._test_reads: deque[_TestRead] = deque()
        self._cause: PlannedRead | None = None
        self._by_silence = False
        self._code = 0
        self._left = 0
        self._widest: dict[bool, int] = {}  # by kind of table, the widest read that succeeded
        self._narrowest: PlannedRead | None = None

    @property
    def is_asking(self) -> bool:
        """Whether `next_test_read` has a test read to send."""
        return bool(self._test_reads)

    def next_test_read(self) -> PlannedRead | None:
        """Return the test read to send next, at low priority; None if there is none.

        The same read is returned until `answered` has its result.
        """
        return self._test_reads[0].read if self._test_reads else None

    def observe(self, read: PlannedRead, outcome: ReadOutcome, code: int = 0) -> None:
        """Learn from the result of an ordinary read; after a failure, `next_test_read` may have test reads.

        It has some after a refusal, and after `SILENCES` silences in a row of one read. It has none if the read has no
        items, or for silence if no narrower read is known. Failures are ignored while earlier test reads are still to
        be sent; so are, for a number of times, refusals of a read for which test reads found no reason.

        Args:
            read: the read.
            outcome: its result.
            code: the exception code; 0 for none.
        """
        place = (read.table, read.start, read.width)
        if outcome is ReadOutcome.SUCCESS:
            self._note_success(read)
            return
        if self._test_reads or not read.items:
            return
        if outcome is ReadOutcome.REFUSED:
            wait = self._waits.get(place)
            if wait is not None and wait.left:
                wait.left -= 1
            else:
                self._begin(read, code)
        elif outcome is ReadOutcome.SILENCE:
            count = self._silences[place] = self._silences.get(place, 0) + 1
            if count >= SILENCES:
                self._silences.clear()
                self._ask_control(read)

    def answered(self, outcome: ReadOutcome, code: int = 0) -> bool:
        """Learn from the result of the test read of `next_test_read`. To be called only while `is_asking`.

        If test reads examine a silence, a test read without a reply stays the next one; `SILENCES` silences of it in a
        row count as a refusal. Any other failure that is no refusal ends all test reads, and so does each failure of
        the control read, which shows whether the device answers.

        Args:
            outcome: the result of the read.
            code: the exception code; 0 for none.

        Returns:
            Whether `knowledge` has changed, so that the device's read plans are out of date.
        """
        test_read = self._test_reads[0]
        self.asked += 1
        self._left -= 1
        if outcome is ReadOutcome.SILENCE and test_read.purpose is not _Purpose.CONTROL and self._by_silence:
            test_read.silences += 1
            if test_read.silences < SILENCES:
                return False
            outcome = ReadOutcome.REFUSED
        self._test_reads.popleft()
        before = self.knowledge
        if outcome is ReadOutcome.SUCCESS:
            self._note_success(test_read.read)
            self._when_good(test_read)
        elif outcome is ReadOutcome.REFUSED and test_read.purpose is not _Purpose.CONTROL:
            self._code = code
            self._when_refused(test_read)
        else:
            self._end()
        if self._left <= 0:
            self._end()
        return self.knowledge is not before

    def _note_success(self, read: PlannedRead) -> None:
        self._silences.pop((read.table, read.start, read.width), None)
        kind = read.table.holds_bits
        self._widest[kind] = max(self._widest.get(kind, 0), read.width)
        if self._narrowest is None or read.seconds < self._narrowest.seconds:
            self._narrowest = read

    def _begin(self, read: PlannedRead, code: int) -> None:
        self._cause, self._by_silence, self._code, self._left = read, False, code, TEST_READS
        self._split(read)

    def _give_up(self) -> None:
        """Record that a refused read cannot be explained, because all its parts succeed; ignore its next refusals.

        The first time 4 are ignored, then each time twice as many, up to `MOST_IGNORED`.
        """
        self.inconclusive += 1
        assert self._cause is not None
        wait = self._waits.setdefault((self._cause.table, self._cause.start, self._cause.width), _Wait())
        wait.left = wait.next
        wait.next = min(2 * wait.next, MOST_IGNORED)

    def _ask_control(self, read: PlannedRead) -> None:
        """Queue a test read that is narrower than ``read``, which got no reply: it shows whether the device answers.

        Nothing is queued if no narrower read is known.
        """
        control = self._narrowest
        if control is None or control.width >= read.width:
            control = read_of(read.table, [min(read.items, key=lambda one: one.width)], self._cost)
        if control.width >= read.width:
            return  # nothing narrower is known: silence of the one item that there is teaches nothing
        self._cause, self._by_silence, self._code, self._left = read, True, 0, TEST_READS
        self._test_reads.append(_TestRead(_Purpose.CONTROL, control))

    def _split(self, read: PlannedRead) -> None:
        """Queue test reads of the two halves of a refused read, before all others; or a test read of its only item.

        Items that one read must fetch together (`_bundles`) count as one item.
        """
        bundles = _bundles(read.items)
        if len(bundles) == 1:
            self._test_reads.append(_TestRead(_Purpose.ITEM, read_of(read.table, bundles[0], self._cost)))
            return
        middle = (read.start + read.end) / 2
        cut = min(range(1, len(bundles)), key=lambda at: abs(bundles[at][0].start - middle))
        halves = [
            read_of(read.table, [one for bundle in each for one in bundle], self._cost)
            for each in (bundles[:cut], bundles[cut:])
        ]
        part = _Part(read, halves)
        # The parts of a part come first: the narrowest read that is refused says most.
        self._test_reads.extendleft(_TestRead(_Purpose.HALF, half, part) for half in reversed(halves))

    def _when_good(self, test_read: _TestRead) -> None:
        part = test_read.part
        if test_read.purpose is _Purpose.CONTROL:
            assert self._cause is not None
            self._split(self._cause)
        elif test_read.purpose is _Purpose.ITEM:
            self._give_up()
        elif test_read.purpose is _Purpose.HALF:
            assert part is not None
            part.succeeded += 1
            if part.succeeded == len(part.halves):
                self._both_good(part)
        elif test_read.purpose is _Purpose.GAP:
            assert part is not None
            if self._has_been_as_wide(part.read):
                self._give_up()
            else:
                self._too_wide(part.read)
        else:
            self._narrow_limit(test_read.read.table, good=test_read.read.width)

    def _when_refused(self, test_read: _TestRead) -> None:
        read = test_read.read
        if test_read.purpose is _Purpose.WIDTH:
            self._narrow_limit(read.table, bad=read.width)
        elif test_read.purpose is _Purpose.GAP:
            assert test_read.part is not None
            self._learn_gap(test_read.part)
        elif len(_bundles(read.items)) == 1:
            self._learn_hole(read.table, read.start, read.end)
        else:
            self._split(read)

    def _both_good(self, part: _Part) -> None:
        """Queue the next test of a read that was refused while both its halves were accepted, or learn why (rule 5)."""
        left, right = part.halves
        across = read_of(part.read.table, [*_bundles(left.items)[-1], *_bundles(right.items)[0]], self._cost)
        if across.width < part.read.width:
            self._test_reads.appendleft(_TestRead(_Purpose.GAP, across, part))
        elif right.start > left.end or self._has_been_as_wide(part.read):
            self._learn_gap(part)
        else:
            self._too_wide(part.read)

    def _has_been_as_wide(self, read: PlannedRead) -> bool:
        return self._widest.get(read.table.holds_bits, 0) >= read.width

    def _learn_gap(self, part: _Part) -> None:
        left, right = part.halves
        self._learn_hole(part.read.table, left.end, right.start)

    def _learn_hole(self, table: Table, start: int, end: int) -> None:
        self.knowledge = self.knowledge.with_hole(LearntHole(table, start, end, self._code))

    def _too_wide(self, read: PlannedRead) -> None:
        kind = read.table.holds_bits
        good = self._widest.get(kind, 0)
        if good < read.width:
            self.knowledge = self.knowledge.with_limit(LearntLimit(kind, good, read.width))
            self._test_reads.clear()  # the limit may be why the other parts were refused
            assert self._cause is not None
            self._ask_width(self._cause)

    def _narrow_limit(self, table: Table, *, good: int | None = None, bad: int | None = None) -> None:
        limit = self.knowledge.limit(table.holds_bits)
        if limit is None or limit.pinned:
            return
        better = replace(limit, good=limit.good if good is None else good, bad=limit.bad if bad is None else bad)
        self.knowledge = self.knowledge.with_limit(better)
        assert self._cause is not None
        self._ask_width(self._cause)

    def _ask_width(self, read: PlannedRead) -> None:
        """Queue a test read of about the width halfway between the widest accepted and the narrowest refused one.

        It is a part of ``read``. None is queued if no part has a width between the two, or if one is queued already.
        """
        limit = self.knowledge.limit(read.table.holds_bits)
        if (
            limit is None
            or limit.bad - limit.good < 2
            or any(one.purpose is _Purpose.WIDTH for one in self._test_reads)
        ):
            return
        middle = (limit.good + limit.bad) / 2
        best: list[Any] | None = None  # Any: the caller's kind of ReadItem
        nearest = float(limit.bad)
        for run, width in _runs(read):
            if limit.good < width < limit.bad and abs(width - middle) < nearest:
                if self.knowledge.refuses(read.table, run[0].start, run[0].start + width):
                    continue
                best, nearest = run, abs(width - middle)
        if best is not None:
            self._test_reads.append(_TestRead(_Purpose.WIDTH, read_of(read.table, best, self._cost)))

    def _end(self) -> None:
        self._test_reads.clear()
        self._silences.clear()


def _bundles(items: Sequence[Any]) -> list[list[Any]]:
    """Return items, sorted by start, in lists that one read must fetch together: atomic groups, overlapping items."""
    found: list[list[Any]] = []
    end = -1
    for one in sorted(items, key=lambda each: (each.start, -each.width)):
        together = found and (one.start < end or (one.group is not None and one.group == found[-1][-1].group))
        if together:
            found[-1].append(one)
        else:
            found.append([one])
        end = max(end, one.start + one.width)
    return found


def _runs(read: PlannedRead) -> Iterator[tuple[list[Any], int]]:
    """Yield both parts of each possible cut of a read in two: the items of the part, and the width of a read of them.

    Items that one read must fetch together (`_bundles`) are never cut.
    """
    bundles = _bundles(read.items)
    for at in range(1, len(bundles)):
        for part in (bundles[:at], bundles[at:]):
            run = [one for bundle in part for one in bundle]
            yield run, max(one.start + one.width for one in run) - run[0].start


def with_knowledge(rules: ReadRules, knowledge: DeviceKnowledge) -> ReadRules:
    """Return a copy of rules for reading a device, narrowed by the learnt holes, borders and largest reads."""
    forbidden = {table: list(spans) for table, spans in rules.forbidden.items()}
    borders = {table: set(places) for table, places in rules.borders.items()}
    for hole in knowledge.holes:
        if hole.is_border:
            borders.setdefault(hole.table, set()).add(hole.start)
        else:
            forbidden.setdefault(hole.table, []).append(ItemRange(hole.start, hole.end))
    registers, bits = knowledge.limit(False), knowledge.limit(True)
    return replace(
        rules,
        forbidden=forbidden,
        borders=borders,
        max_registers=rules.max_registers if registers is None else max(1, min(rules.max_registers, registers.good)),
        max_bits=rules.max_bits if bits is None else max(1, min(rules.max_bits, bits.good)),
    )
