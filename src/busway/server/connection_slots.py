"""Connection slots in two pools: which new connection gets one, and which is closed for it (Messaging §4.2.1, §4.3.1).

Pure: knows who is connected and since when unused; closes nothing, logs nothing, looks at no clock.

1. There are two pools. A connection of a priority host takes a place of the priority pool, from where nothing ever
   moves it. Each device has a limit there, so that one does not take all.
2. A priority connection is always accepted: beyond its limit it takes a place of the other pool, and moves up when one
   of the priority pool becomes free.
3. In the other pool a new connection pushes out one that has never said anything, if its other end has closed or it had
   `SECONDS_TO_SPEAK`; else the connection unused longest, or the oldest where all are busy. One of a host
   without priority never pushes out one of a priority host: where only such are left, it is refused itself. So clients
   that connect and close, or send nothing, take no slot of one that works; nor does a new connection that has ended.
4. Only a priority connection that finds nothing but priority connections takes the place of one: of its own device's
   oldest, if there is one. Nothing else keeps both the bound and rule 2.
5. A host without priority may have a limit of its own; its next connection replaces its oldest. With a limit of 1
   a client that has started anew replaces what is left of it (§4.2.2).
"""

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from typing import Final, Generic, Protocol, TypeVar

from ..options.server import ListenerParameters

SECONDS_TO_SPEAK: Final = 1.0
"""Seconds until a connection that has sent nothing is closed for a new one before those that have."""
_LOOKS: Final = 64
"""Silent connections whose other ends are looked at for one new connection at most."""


class Pool(Enum):
    """The two pools of connection slots: one for priority hosts, one for all other hosts."""

    PRIORITY = "priority"
    OTHER = "other"


class PoolMember(Protocol):
    """Interface of a connection that counts towards a listener's limit of connections (occupies a slot).

    Attributes:
        host: host of the client.
        is_priority: whether it is a priority host.
        pool: the pool of its slot, set when it gets one.
        last_used: seconds; never decreases. The time of its connect until it has sent something.
        received: bytes so far.
    """

    host: str
    is_priority: bool
    pool: Pool
    last_used: float
    received: int

    @property
    def is_busy(self) -> bool:
        """Whether a request of the connection is in progress or a reply is unsent."""

    @property
    def has_ended(self) -> bool:
        """Whether the client is known to have closed the connection, with nothing left to read."""


One = TypeVar("One", bound=PoolMember)


@dataclass(frozen=True, slots=True)
class PoolLimits:
    """Limits of the two slot pools: numbers of slots in total and per host.

    Attributes:
        priority: slots of the priority pool.
        other: slots of the other pool.
        priority_per_device: priority slots that one host may use.
        per_device: limit of the other slots for one host without priority; None for all of them.
    """

    priority: int
    other: int
    priority_per_device: int
    per_device: int | None = None

    @classmethod
    def of(cls, parameters: ListenerParameters) -> "PoolLimits":
        """Return the limits of connection slots that a listener's options set."""
        return cls(
            priority=parameters.max_priority_connections,
            other=parameters.max_connections,
            priority_per_device=parameters.max_priority_per_remote or max(parameters.max_priority_connections // 2, 1),
            per_device=parameters.max_per_remote,
        )


@dataclass(frozen=True, slots=True)
class Admission(Generic[One]):
    """The decision about a new connection: whether it gets a slot, and which connection is closed for it.

    Attributes:
        accepted: whether it got a slot.
        evicted: the connection that has lost its slot for it; the caller closes it.
    """

    accepted: bool
    evicted: One | None = None


class Pools(Generic[One]):
    """All connection slots of a listener: those for priority hosts and those for other hosts."""

    def __init__(self, limits: PoolLimits) -> None:
        self.limits = limits
        self._priority: dict[One, None] = {}
        self._priority_of: Counter[str] = Counter()
        self._other: dict[One, int] = {}  # in the order they came, with the number of each
        self._numbered: dict[int, One] = {}
        self._of_device: dict[str, dict[One, None]] = {}  # of those in the other pool of hosts without priority
        self._silent: dict[One, None] = {}  # of those, the ones that had said nothing, in the order they came
        self._by_use: deque[tuple[float, int]] = deque()  # the longest unused first, as they stood once
        self._next_number = 0

    def __len__(self) -> int:
        return len(self._priority) + len(self._other)

    def count(self, pool: Pool) -> int:
        """Return how many connections there are in a pool: of priority hosts, or of others."""
        return len(self._priority if pool is Pool.PRIORITY else self._other)

    def admit(self, candidate: One) -> Admission[One]:
        """Give a new connection a slot, if necessary that of another connection, which is returned to be closed."""
        if candidate.is_priority and self._has_priority_place(candidate.host):
            self._prefer(candidate)
            return Admission(True)
        evicted = self._of_same_device(candidate)
        if evicted is None and len(self._other) >= self.limits.other:
            if candidate.has_ended:
                return Admission(False)
            evicted = self._silent_one(candidate) or self._longest_unused() or self._oldest_priority(candidate)
            if evicted is None:
                return Admission(False)
        if evicted is not None:
            self._remove(evicted)
        self._take(candidate)
        return Admission(True, evicted)

    def leave(self, member: One) -> None:
        """Free the connection slot of a connection that has ended; no effect if it had lost its slot before."""
        if member in self._other:
            self._remove(member)
        elif member in self._priority:
            del self._priority[member]
            self._priority_of[member.host] -= 1
            if not self._priority_of[member.host]:
                del self._priority_of[member.host]
            self._move_up()

    # Who goes.

    def _of_same_device(self, candidate: One) -> One | None:
        """Return the oldest connection of a host at its limit, to be closed for a new one; None for priority hosts."""
        limit = self.limits.per_device
        if limit is None or candidate.is_priority:
            return None
        own = self._of_device.get(candidate.host, {})
        return next(iter(own)) if len(own) >= limit else None

    def _silent_one(self, candidate: One) -> One | None:
        """Return a connection to close first: one that never sent a byte and has ended or outlived
        `SECONDS_TO_SPEAK`.
        """
        for member in list(islice(self._silent, _LOOKS)):
            if member.received:
                del self._silent[member]
            elif member.has_ended or candidate.last_used - member.last_used >= SECONDS_TO_SPEAK:
                return member
        return None

    def _longest_unused(self) -> One | None:
        """Return the connection without priority that was unused longest, or the oldest if all are busy."""
        found = self._first_idle()
        if found is None:
            # Sorted once for many new connections: what has not been used since then stands in its order still, and all
            # others have been used later. A storm of new connections costs a step for each, not a look at all.
            self._by_use = deque(
                sorted((member.last_used, number) for member, number in self._other.items() if not member.is_priority)
            )
            found = self._first_idle()
        return found or next((member for member in self._other if not member.is_priority), None)

    def _first_idle(self) -> One | None:
        busy: list[tuple[float, int]] = []
        found = None
        while self._by_use and found is None:
            used, number = self._by_use.popleft()
            member = self._numbered.get(number)
            if member is None or member.last_used != used:
                continue
            if member.is_busy:
                busy.append((used, number))
            else:
                found = member
        self._by_use.extendleft(reversed(busy))
        return found

    def _oldest_priority(self, candidate: One) -> One | None:
        """Return the oldest priority connection in the other pool, if only such ones are there to be
        closed (rule 4).
        """
        if not candidate.is_priority:
            return None
        own = (member for member in self._other if member.host == candidate.host)
        return next(own, None) or next(iter(self._other))

    # Slots.

    def _has_priority_place(self, host: str) -> bool:
        limits = self.limits
        return len(self._priority) < limits.priority and self._priority_of[host] < limits.priority_per_device

    def _prefer(self, member: One) -> None:
        member.pool = Pool.PRIORITY
        self._priority[member] = None
        self._priority_of[member.host] += 1

    def _take(self, member: One) -> None:
        member.pool = Pool.OTHER
        self._other[member] = self._next_number
        self._numbered[self._next_number] = member
        self._next_number += 1
        if not member.is_priority:
            self._of_device.setdefault(member.host, {})[member] = None
            self._silent[member] = None

    def _remove(self, member: One) -> None:
        del self._numbered[self._other.pop(member)]
        self._silent.pop(member, None)
        own = self._of_device.get(member.host)
        if own is not None and not member.is_priority:
            del own[member]
            if not own:
                del self._of_device[member.host]

    def _move_up(self) -> None:
        """Move the oldest priority connection in a normal connection slot to a free priority slot."""
        for member in self._other:
            if member.is_priority and self._has_priority_place(member.host):
                self._remove(member)
                self._prefer(member)
                return
