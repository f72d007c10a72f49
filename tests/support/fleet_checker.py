"""Judges a fleet from outside: by what devices saw on their wires, and by what stores and sinks hold. Pure.

Knows frames, periods of ownership, samples and faults as data; knows no process, socket or product code.

1. Per link, after the first frame of an epoch at most one of any older epoch: a process that was frozen between its
   check and its `send` may start one late transaction. More than one is two masters, or an epoch that went back.
2. Every sample whose commit was told is in a store, and in the sink where there is one. No reading is there twice:
   each reply of a device has a value of its own.
3. No write is executed twice, and none that was reported as not executed was.
4. Between two faults a link is silent for at most the time of a takeover and a second, once there are a quorum and a
   collector that may own it. What the machine itself stood still, or let a process wait for a processor, is added.
5. Every moment of a hole is in the store of the collector that ended it, or in that of the link's last owner before
   that moment, as samples without a value or as an interval. What others say of a link that they do not own is nothing.
   What the machine itself stood still needs no record.
6. What the machine stood still excuses no more of one silence than its bound: none may be twice as long. A run in
   which more than `MOST_EXCUSED` of the long silences need that excuse is not judged: it fails.
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

Epoch = tuple[int, int]
MOST_EXCUSED = 1 / 3
"""Part of the silences of more than a period and a second that a machine that stood still may excuse."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One request that a device received: when, of which collector; the value that it gave or was given."""

    at: float
    link: str
    collector: str
    is_write: bool
    value: int


@dataclass(frozen=True, slots=True)
class Owned:
    """A period of ownership of a link, from the log of its collector; no end where the process was killed."""

    collector: str
    link: str
    epoch: Epoch
    begin: float
    end: float | None


@dataclass(frozen=True, slots=True)
class Stored:
    """A good sample of a store."""

    collector: str
    link: str
    value: int
    at: float


@dataclass(frozen=True, slots=True)
class Unread:
    """A time without values that a store has; no link where it is all of them, no end while it lasts."""

    collector: str
    link: str | None
    begin: float
    end: float | None


@dataclass(frozen=True, slots=True)
class Bounds:
    """What is allowed.

    Attributes:
        period: seconds between two due times of a link.
        takeover: seconds of a takeover: time to live, guard and one more.
        unrecorded: seconds of a hole that need no record: a period and a second.
    """

    period: float
    takeover: float
    unrecorded: float


@dataclass
class Logs:
    """All that is known of one run.

    Attributes:
        frames: in the order of each device.
        committed: link and value of each sample whose commit was told.
        sunk: what the sink holds, each with how many rows have it; None without a sink.
        sunk_until: samples up to this moment have to be in the sink.
        not_executed: values of writes that were reported as not executed.
        faults: the moments at which something was broken.
        down: times without a quorum or without a collector that may own.
        stalls: times in which the machine stood still, or had no time for a part of the run; one after the other.
        begin, end: of what is judged.
    """

    begin: float
    end: float
    frames: list[Frame] = field(default_factory=list)
    owned: list[Owned] = field(default_factory=list)
    stored: list[Stored] = field(default_factory=list)
    unread: list[Unread] = field(default_factory=list)
    committed: set[tuple[str, int]] = field(default_factory=set)
    sunk: dict[tuple[str, int], int] | None = None
    sunk_until: float = 0.0
    not_executed: set[int] = field(default_factory=set)
    faults: list[float] = field(default_factory=list)
    down: list[tuple[float, float]] = field(default_factory=list)
    stalls: list[tuple[float, float]] = field(default_factory=list)


def judged(logs: Logs, bounds: Bounds) -> list[str]:
    """All that is wrong in a run, as sentences; none where all is well."""
    return [
        *epochs_that_overlap(logs),
        *samples_that_are_wrong(logs),
        *writes_that_are_wrong(logs),
        *silences_that_are_too_long(logs, bounds),
        *holes_without_a_record(logs, bounds),
        *too_little_judged(logs, bounds),
    ]


def epochs_by_frame(logs: Logs) -> list[tuple[Frame, Epoch | None]]:
    """Each frame with the epoch in which it was sent: the last that its collector had begun on that link."""
    begun: dict[tuple[str, str], list[Owned]] = defaultdict(list)
    for each in sorted(logs.owned, key=lambda each: each.begin):
        begun[each.collector, each.link].append(each)
    found: list[tuple[Frame, Epoch | None]] = []
    for frame in logs.frames:
        known = begun[frame.collector, frame.link]
        place = bisect_right(known, frame.at, key=lambda each: each.begin)
        found.append((frame, known[place - 1].epoch if place else None))
    return found


def epochs_that_overlap(logs: Logs) -> list[str]:
    """Rule 1."""
    newest: dict[str, Epoch] = {}
    late: dict[tuple[str, Epoch], int] = defaultdict(int)
    found: list[str] = []
    for frame, epoch in epochs_by_frame(logs):
        if epoch is None:
            found.append(f"{frame.at:.3f}: {frame.collector} asked {frame.link} without having recorded an epoch")
        elif epoch < newest.get(frame.link, (0, 0)):
            late[frame.link, newest[frame.link]] += 1
            if late[frame.link, newest[frame.link]] == 2:
                found.append(f"{frame.at:.3f}: {frame.link} by {frame.collector} in {epoch} after {newest[frame.link]}")
        else:
            newest[frame.link] = epoch
    return found


def samples_that_are_wrong(logs: Logs) -> list[str]:
    """Rule 2."""
    given = {(frame.link, frame.value) for frame in logs.frames if not frame.is_write}
    times: dict[tuple[str, int], int] = defaultdict(int)
    for each in logs.stored:
        times[each.link, each.value] += 1
    found = [f"{link}: {value} was committed, and no store has it" for link, value in logs.committed - times.keys()]
    found += [f"{link}: {value} is in stores {count} times" for (link, value), count in times.items() if count > 1]
    found += [f"{link}: {value} is in a store, and no device gave it" for link, value in times.keys() - given]
    if logs.sunk is not None:
        wanted = {(each.link, each.value) for each in logs.stored if each.at <= logs.sunk_until}
        found += [f"{link}: {value} is in a store, not in the sink" for link, value in wanted - logs.sunk.keys()]
        found += [
            f"{link}: {value} is in the sink {count} times" for (link, value), count in logs.sunk.items() if count > 1
        ]
        found += [f"{link}: {value} is in the sink, in no store" for link, value in logs.sunk.keys() - times.keys()]
    return sorted(found)


def writes_that_are_wrong(logs: Logs) -> list[str]:
    """Rule 3."""
    executed: dict[int, int] = defaultdict(int)
    for frame in logs.frames:
        if frame.is_write:
            executed[frame.value] += 1
    found = [f"the write of {value} was executed {count} times" for value, count in executed.items() if count > 1]
    return found + [
        f"the write of {value} was executed, and reported as not" for value in logs.not_executed & executed.keys()
    ]


def silences_that_are_too_long(logs: Logs, bounds: Bounds) -> list[str]:
    """Rule 4."""
    found: list[str] = []
    most = bounds.takeover + bounds.period
    for each in long_silences(logs, bounds):
        if each.seconds - min(stood_still(logs, each.low, each.high), most) > most:
            found.append(
                f"{each.link} was silent from {each.begin:.2f} to {each.end:.2f}, {each.seconds:.2f} s of it without a "
                "cause"
            )
    links = {frame.link for frame in logs.frames}
    for link in links:
        last_frame = max(frame.at for frame in logs.frames if frame.link == link)
        if logs.end - last_frame > bounds.takeover:
            found.append(f"{link} is silent at the end")
    return found


@dataclass(frozen=True, slots=True)
class Silence:
    """A time in which a link was not read, and what of it is between two faults: from ``low`` to ``high``."""

    link: str
    begin: float
    end: float
    low: float
    high: float

    @property
    def seconds(self) -> float:
        return self.high - self.low


def long_silences(logs: Logs, bounds: Bounds) -> list[Silence]:
    """The silences of which more than a period and a second are between two faults."""
    stretches = good_stretches(logs)
    return [
        Silence(link, begin, end, max(begin, first), min(end, last))
        for link, begin, end in _silences((frame.link, frame.at) for frame in logs.frames if not frame.is_write)
        if end - begin > bounds.unrecorded
        for first, last in stretches
        if min(end, last) - max(begin, first) > bounds.unrecorded
    ]


def stood_still(logs: Logs, low: float, high: float) -> float:
    """Seconds of a time in which the machine stood still."""
    return sum(max(0.0, min(high, end) - max(low, begin)) for begin, end in logs.stalls)


def good_stretches(logs: Logs) -> list[tuple[float, float]]:
    """The times between two faults in which there were a quorum and a collector that may own."""
    cuts = sorted({logs.begin, logs.end, *logs.faults, *(moment for each in logs.down for moment in each)})
    cuts = [each for each in cuts if logs.begin <= each <= logs.end]
    return [
        (first, last)
        for first, last in pairwise(cuts)
        if not any(begin <= first and last <= end for begin, end in logs.down)
    ]


def holes_without_a_record(logs: Logs, bounds: Bounds) -> list[str]:
    """Rule 5."""
    unread: dict[str, list[Unread]] = defaultdict(list)
    for each in logs.unread:
        unread[each.collector].append(each)
    found: list[str] = []
    owners = _last_owners(logs)
    ended_by = {(each.link, each.at): each.collector for each in logs.stored}
    for link, begin, end in _silences((each.link, each.at) for each in logs.stored):
        if end - begin > bounds.unrecorded and begin >= logs.begin:
            told = [each for each in unread[ended_by[link, end]] if each.link in (None, link)]
            for owner, first, last in owners[link]:
                told += [
                    Unread(owner, link, max(each.begin, first), min(last if each.end is None else each.end, last))
                    for each in unread[owner]
                    if each.link in (None, link) and each.begin < last and (each.end is None or each.end > first)
                ]
            most = bounds.takeover + bounds.period
            left = max(
                last - first - min(stood_still(logs, first, last), most) for first, last in _uncovered(begin, end, told)
            )
            if left > bounds.unrecorded:
                found.append(f"{link}: {left:.2f} s of the hole from {begin:.2f} to {end:.2f} are not recorded")
    return found


def excused(logs: Logs, bounds: Bounds) -> float:
    """The part of the long silences that are no breach only because the machine stood still, 0…1."""
    found = long_silences(logs, bounds)
    needing = [each for each in found if each.seconds > bounds.takeover + bounds.period]
    return len(needing) / len(found) if found else 0.0


def too_little_judged(logs: Logs, bounds: Bounds) -> list[str]:
    """Rule 6."""
    part = excused(logs, bounds)
    if part <= MOST_EXCUSED:
        return []
    return [f"{part:.0%} of the long silences are excused by a machine that stood still: try again with less load"]


def _last_owners(logs: Logs) -> dict[str, list[tuple[str, float, float]]]:
    """By link, who owned it last, from its begin until another one began."""
    found: dict[str, list[tuple[str, float, float]]] = defaultdict(list)
    by_link: dict[str, list[Owned]] = defaultdict(list)
    for each in sorted(logs.owned, key=lambda each: each.begin):
        by_link[each.link].append(each)
    for link, rows in by_link.items():
        for place, row in enumerate(rows):
            last = rows[place + 1].begin if place + 1 < len(rows) else float("inf")
            found[link].append((row.collector, row.begin, last))
    return found


def holes(logs: Logs, longest: float) -> list[tuple[str, float, float]]:
    """The holes in what stores have that are longer than so many seconds: link, begin and end."""
    return [each for each in _silences((each.link, each.at) for each in logs.stored) if each[2] - each[1] > longest]


def taken(logs: Logs, collector: str, begin: float, end: float) -> set[str]:
    """The links that a collector read in the two seconds before a time, and others in that time."""
    before = {each.link for each in logs.frames if each.collector == collector and begin - 2.0 < each.at < begin}
    return before & {each.link for each in logs.frames if each.collector != collector and begin < each.at < end}


def _silences(moments: Iterable[tuple[str, float]]) -> list[tuple[str, float, float]]:
    by_link: dict[str, list[float]] = defaultdict(list)
    for link, at in moments:
        by_link[link].append(at)
    return [(link, *pair) for link, times in by_link.items() for pair in pairwise(sorted(times))]


def _uncovered(begin: float, end: float, recorded: Sequence[Unread]) -> list[tuple[float, float]]:
    """The parts of a time that no record covers; the last one may be empty."""
    found, at = [], begin
    for each in sorted(recorded, key=lambda each: each.begin):
        until = end if each.end is None else each.end
        if until > at and each.begin < end:
            found.append((at, max(at, each.begin)))
            at = max(at, until)
    return [*found, (at, max(at, end))]


def histogram(lengths: Iterable[float], edges: Sequence[float]) -> Mapping[float, int]:
    """How many lengths are below each edge and not below the one before it."""
    found = dict.fromkeys(edges, 0)
    for each in lengths:
        for edge in edges:
            if each < edge:
                found[edge] += 1
                break
    return found
