"""Connection slots in two pools: which new connection gets one, and which is closed for it (Messaging §4.2.1, §4.3.1).

Pure: knows who is connected and since when unused; closes nothing, logs nothing, looks at no clock.

1. There are two pools. A connection of a priority host takes a slot of the priority pool, and keeps it until it ends.
   Each host has a limit there, so that one host does not take all.
2. A connection of a priority host is always accepted: beyond the limit it takes a slot of the other pool, and moves up
   when a slot of the priority pool becomes free.
3. If the other pool is full, a new connection replaces another one: first one that has never sent a byte, if its client
   has closed it or it is older than `SECONDS_TO_SPEAK`; else the connection unused longest, or the oldest where all are
   busy. A connection of a host without priority never replaces one of a priority host: where only those are left, the
   new connection is refused, and so is one that its client has closed already, if there is no free slot. So clients
   that connect now and then and send nothing replace each other. Many new connections within `SECONDS_TO_SPEAK` replace
   as many others, also such as work; a limit for each host (rule 5) prevents that.
4. Only a priority host's connection that finds nothing but connections of priority hosts replaces one of them: the
   oldest of its own host, if there is one, else the oldest. Nothing else keeps both the bound and rule 2.
5. A host without priority may have a limit of its own; then its next connection replaces its oldest. With a limit of 1
   a client that has restarted replaces the connection it left behind (§4.2.2).
"""

from collections import Counter, OrderedDict
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from operator import itemgetter
from typing import Final, Generic, Protocol, TypeVar

from ..options.server import ListenerParameters

SECONDS_TO_SPEAK: Final = 1.0
"""Age in seconds from which a connection that has sent nothing is the first to be closed for a new connection."""
_LOOKS: Final = 64
"""Most silent connections that are checked, for one new connection, for whether their clients have closed them."""


class SlotPool(Enum):
    """The two pools of connection slots.

    PRIORITY is for priority hosts only, OTHER for all other hosts and for priority hosts beyond the limits of PRIORITY.
    """

    PRIORITY = "priority"
    OTHER = "other"


class SlotHolder(Protocol):
    """Interface of a connection that occupies a connection slot of a listener.

    Attributes:
        host: host of the client.
        is_priority: whether the client is a priority host.
        pool: the pool of its slot, set when it gets one.
        last_used: when it was last used, in seconds of a monotonic clock; before the first use, when it was connected.
            Never decreases.
        received: bytes received from the client so far.
    """

    host: str
    is_priority: bool
    pool: SlotPool
    last_used: float
    received: int

    @property
    def is_busy(self) -> bool:
        """Whether a request of the connection is in progress or waits for its turn, or a reply is unsent."""

    @property
    def has_ended(self) -> bool:
        """Whether the connection is closing, or the client is known to have closed it with nothing left to read."""


One = TypeVar("One", bound=SlotHolder)


@dataclass(frozen=True, slots=True)
class SlotLimits:
    """Limits of the two slot pools: numbers of slots in total and per host.

    Attributes:
        priority: slots of the priority pool.
        other: slots of the other pool.
        priority_per_host: priority slots that one host may use.
        per_host: slots of the other pool that one host without priority may use; None for no limit per host.
    """

    priority: int
    other: int
    priority_per_host: int
    per_host: int | None = None

    @classmethod
    def of(cls, parameters: ListenerParameters) -> "SlotLimits":
        """Return the limits of connection slots that a listener's options set.

        Without the option ``max_priority_per_host``, a host may use half of the priority slots, at least one.
        """
        return cls(
            priority=parameters.max_priority_connections,
            other=parameters.max_connections,
            priority_per_host=parameters.max_priority_per_host or max(parameters.max_priority_connections // 2, 1),
            per_host=parameters.max_per_host,
        )


@dataclass(frozen=True, slots=True)
class Admission(Generic[One]):
    """The decision about a new connection: whether it gets a slot, and which connection is closed for it.

    Attributes:
        accepted: whether the new connection got a slot.
        evicted: the connection that has lost its slot to the new one; the caller closes it. None if there is none.
    """

    accepted: bool
    evicted: One | None = None


class ConnectionSlots(Generic[One]):
    """All connection slots of a listener, or of several listeners that share them: the two pools and their connections.

    ``len()`` is the number of connections in both pools.
    """

    def __init__(self, limits: SlotLimits) -> None:
        self.limits = limits
        self._priority: dict[One, None] = {}
        self._priority_of: Counter[str] = Counter()
        self._other: dict[One, None] = {}  # in the order they came
        # Of those in the other pool of hosts without priority, if these have a limit.
        self._of_device: dict[str, dict[One, None]] = {}
        # Of the other pool: those that had sent nothing when they were last looked at, in the order they came.
        self._silent: dict[One, None] = {}
        self._most_silent = _LOOKS
        self._by_use: OrderedDict[One, float] = OrderedDict()  # the longest unused first, as they stood once

    def __len__(self) -> int:
        return len(self._priority) + len(self._other)

    def count(self, pool: SlotPool) -> int:
        """Return how many connections have a slot of a pool.

        Those of priority hosts can be in the other pool too (rule 2).
        """
        return len(self._priority if pool is SlotPool.PRIORITY else self._other)

    def admit(self, candidate: One) -> Admission[One]:
        """Give a new connection a slot, if necessary that of another connection, or refuse it (rules 2 to 5).

        Sets ``pool`` of an accepted connection. The connection in ``evicted`` has lost its slot already; the caller
        closes it.
        """
        if candidate.is_priority and self._has_priority_place(candidate.host):
            self._prefer(candidate)
            return Admission(True)
        evicted = self._of_same_host(candidate)
        is_full = len(self._other) >= self.limits.other
        if (evicted is not None or is_full) and candidate.has_ended:
            return Admission(False)
        if evicted is None and is_full:
            evicted = self._silent_one(candidate) or self._longest_unused() or self._oldest_priority(candidate)
            if evicted is None:
                return Admission(False)
        if evicted is not None:
            self._remove(evicted)
        self._take(candidate)
        return Admission(True, evicted)

    def leave(self, connection: One) -> None:
        """Free the slot of a connection that has ended; no effect if it has lost its slot already.

        A priority slot that becomes free goes to the oldest connection of a priority host in the other pool whose host
        is below its limit.
        """
        if connection in self._other:
            self._remove(connection)
        elif connection in self._priority:
            del self._priority[connection]
            self._priority_of[connection.host] -= 1
            if not self._priority_of[connection.host]:
                del self._priority_of[connection.host]
            self._move_up()

    # Who goes.

    def _of_same_host(self, candidate: One) -> One | None:
        """Return the oldest connection of a host that is at its limit, to be closed for a new connection of the host.

        None if the host is below its limit or is a priority host, or if there is no such limit.
        """
        limit = self.limits.per_host
        if limit is None or candidate.is_priority:
            return None
        own = self._of_device.get(candidate.host, {})
        return next(iter(own)) if len(own) >= limit else None

    def _silent_one(self, candidate: One) -> One | None:
        """Return a connection that has never sent a byte and may be closed for a new one; None if none is found.

        Its client must have closed it already, or it must be `SECONDS_TO_SPEAK` old. Only the `_LOOKS` oldest are
        searched.
        """
        for connection in list(islice(self._silent, _LOOKS)):
            if connection.received:
                del self._silent[connection]
            elif connection.has_ended or candidate.last_used - connection.last_used >= SECONDS_TO_SPEAK:
                return connection
        return None

    def _longest_unused(self) -> One | None:
        """Return the connection of the other pool that is not busy and was unused longest; if all are busy, the oldest.

        Connections of priority hosts are left out; None if there are no others.
        """
        found = self._first_idle()
        if found is None:
            # Sorted once for many new connections: what has not been used since then stands in its order still, and all
            # others have been used later. A storm of new connections costs a step for each, not a look at all.
            without_priority = (
                (connection, connection.last_used) for connection in self._other if not connection.is_priority
            )
            self._by_use = OrderedDict(sorted(without_priority, key=itemgetter(1)))
            found = self._first_idle()
        return found or next((connection for connection in self._other if not connection.is_priority), None)

    def _first_idle(self) -> One | None:
        busy: list[tuple[One, float]] = []
        found = None
        while self._by_use and found is None:
            connection, used = self._by_use.popitem(last=False)
            if connection.last_used != used:
                continue
            if connection.is_busy:
                busy.append((connection, used))
            else:
                found = connection
        for connection, used in reversed(busy):
            self._by_use[connection] = used
            self._by_use.move_to_end(connection, last=False)
        return found

    def _oldest_priority(self, candidate: One) -> One | None:
        """Return the connection of a priority host to be replaced by a new one of a priority host (rule 4).

        It is the oldest of the same host, else the oldest. None if the new connection is not of a priority host.
        """
        if not candidate.is_priority:
            return None
        own = (connection for connection in self._other if connection.host == candidate.host)
        return next(own, None) or next(iter(self._other))

    # Slots.

    def _has_priority_place(self, host: str) -> bool:
        limits = self.limits
        return len(self._priority) < limits.priority and self._priority_of[host] < limits.priority_per_host

    def _prefer(self, connection: One) -> None:
        connection.pool = SlotPool.PRIORITY
        self._priority[connection] = None
        self._priority_of[connection.host] += 1

    def _take(self, connection: One) -> None:
        connection.pool = SlotPool.OTHER
        self._other[connection] = None
        if not connection.is_priority:
            if self.limits.per_host is not None:
                self._of_device.setdefault(connection.host, {})[connection] = None
            self._forget_speakers()
            self._silent[connection] = None

    def _forget_speakers(self) -> None:
        """Leave only silent connections in the table of silent ones, each time that it has doubled.

        So it does not grow with all open connections, and costs a step for each.
        """
        if len(self._silent) >= self._most_silent:
            self._silent = {connection: None for connection in self._silent if not connection.received}
            self._most_silent = max(2 * len(self._silent), _LOOKS)

    def _remove(self, connection: One) -> None:
        del self._other[connection]
        self._by_use.pop(connection, None)
        self._silent.pop(connection, None)
        own = self._of_device.get(connection.host)
        if own is not None and not connection.is_priority:
            del own[connection]
            if not own:
                del self._of_device[connection.host]

    def _move_up(self) -> None:
        """Move the oldest connection of a priority host in the other pool to a priority slot, if one is free for it."""
        for connection in self._other:
            if connection.is_priority and self._has_priority_place(connection.host):
                self._remove(connection)
                self._prefer(connection)
                return
