"""The rules of docs/tcp.md for connection slots, written from the page alone: who gets in, and who makes room.

Looks at all open connections each time. Where the page leaves a choice, such as between two silent connections, it
names all that may make room.
"""

from typing import Generic, Protocol, TypeVar

from busway.server.connection_slots import SECONDS_TO_SPEAK, SlotLimits, SlotPool


class OpenConnection(Protocol):
    """What the page asks about a connection."""

    host: str
    is_priority: bool
    last_used: float
    received: int
    has_ended: bool

    @property
    def is_busy(self) -> bool:
        """Whether a request is in progress."""


One = TypeVar("One", bound=OpenConnection)


class SlotRules(Generic[One]):
    """The open connections as the page wants them.

    Attributes:
        open: the pool of each, the oldest first.
    """

    def __init__(self, limits: SlotLimits) -> None:
        self.limits = limits
        self.open: dict[One, SlotPool] = {}

    def of(self, pool: SlotPool) -> list[One]:
        return [one for one, its_pool in self.open.items() if its_pool is pool]

    def may_have_priority_slot(self, host: str) -> bool:
        here = self.of(SlotPool.PRIORITY)
        own = sum(one.host == host for one in here)
        return len(here) < self.limits.priority and own < self.limits.priority_per_host

    def may_make_room(self, now: float) -> list[One]:
        """Connections of other hosts of which one makes room, by the table of two pools."""
        others = [one for one in self.open if not one.is_priority]
        if silent := [
            one for one in others if not one.received and (one.has_ended or now - one.last_used >= SECONDS_TO_SPEAK)
        ]:
            return silent
        if idle := [one for one in others if not one.is_busy]:
            unused_since = min(one.last_used for one in idle)
            return [one for one in idle if one.last_used == unused_since]
        return others[:1]

    def decision(
        self, host: str, now: float, *, is_priority: bool, has_ended: bool = False
    ) -> tuple[SlotPool | None, list[One]]:
        """The pool that a new connection gets, or None; and the connections of which one makes room, if any."""
        if is_priority and self.may_have_priority_slot(host):
            return SlotPool.PRIORITY, []
        own = [one for one in self.open if one.host == host and not one.is_priority]
        in_others = self.of(SlotPool.OTHER)
        if not is_priority and self.limits.per_host is not None and len(own) >= self.limits.per_host:
            leaves = own[:1]
        elif len(in_others) < self.limits.other:
            return SlotPool.OTHER, []
        else:
            leaves = self.may_make_room(now)
        if has_ended:
            return None, []
        if not leaves and is_priority:
            leaves = [one for one in in_others if one.host == host][:1] or in_others[:1]
        return (SlotPool.OTHER if leaves else None), leaves

    def leave(self, one: One) -> None:
        """Remove a connection; a free priority slot goes to the oldest connection that may have it."""
        del self.open[one]
        waiting = [up for up in self.of(SlotPool.OTHER) if up.is_priority and self.may_have_priority_slot(up.host)]
        for up in waiting[:1]:
            self.open[up] = SlotPool.PRIORITY
