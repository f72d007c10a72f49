"""Two pools of connection slots against a model from docs/tcp.md alone: who gets in, and who makes room.

The model keeps a list of open connections, the oldest first, and looks at all of them each time. Where the page leaves
a choice, such as between two silent connections, it names all that may make room.
"""

from dataclasses import dataclass

import pytest
from examples import examples
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from busway.server.connection_slots import SECONDS_TO_SPEAK, ConnectionSlots, SlotLimits, SlotPool

PRIORITY_HOSTS = ("p1", "p2", "p3")
OTHER_HOSTS = ("a", "b", "c")
STEPS = (0.0, 0.0, 0.1, SECONDS_TO_SPEAK / 2, SECONDS_TO_SPEAK, 3.0)
"""Seconds between two events; several can have the same time."""


@dataclass(eq=False)
class Connection:
    """One connection, as the slots see it."""

    host: str
    is_priority: bool
    last_used: float
    received: int = 0
    is_busy: bool = False
    has_ended: bool = False
    pool: SlotPool = SlotPool.OTHER


class SlotsModel(RuleBasedStateMachine):
    """Connections that come, speak, work, end and leave; each decision is compared with the page's."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.open: list[Connection] = []
        self.pool_of: dict[Connection, SlotPool] = {}

    @initialize(
        priority=st.integers(0, 4),
        other=st.integers(1, 5),
        priority_per_host=st.integers(1, 3),
        per_host=st.none() | st.integers(1, 3),
    )
    def begin(self, priority: int, other: int, priority_per_host: int, per_host: int | None) -> None:
        self.limits = SlotLimits(priority, other, priority_per_host, per_host)
        self.slots: ConnectionSlots[Connection] = ConnectionSlots(self.limits)

    # --- the page's rules ---

    def of(self, pool: SlotPool) -> list[Connection]:
        return [one for one in self.open if self.pool_of[one] is pool]

    def may_have_priority_slot(self, host: str) -> bool:
        here = self.of(SlotPool.PRIORITY)
        own = sum(one.host == host for one in here)
        return len(here) < self.limits.priority and own < self.limits.priority_per_host

    def may_make_room(self) -> list[Connection]:
        """Connections of other hosts of which one makes room, by the table of two pools."""
        others = [one for one in self.open if not one.is_priority]
        if silent := [
            one
            for one in others
            if not one.received and (one.has_ended or self.now - one.last_used >= SECONDS_TO_SPEAK)
        ]:
            return silent
        if idle := [one for one in others if not one.is_busy]:
            unused_since = min(one.last_used for one in idle)
            return [one for one in idle if one.last_used == unused_since]
        return others[:1]

    def decision(self, new: Connection) -> tuple[SlotPool | None, list[Connection]]:
        """The pool that a new connection gets, or None; and the connections of which one makes room, if any."""
        if new.is_priority and self.may_have_priority_slot(new.host):
            return SlotPool.PRIORITY, []
        own = [one for one in self.open if one.host == new.host and not one.is_priority]
        in_others = self.of(SlotPool.OTHER)
        if not new.is_priority and self.limits.per_host is not None and len(own) >= self.limits.per_host:
            leaves = own[:1]
        elif len(in_others) < self.limits.other:
            return SlotPool.OTHER, []
        else:
            leaves = self.may_make_room()
        if new.has_ended:
            return None, []
        if not leaves and new.is_priority:
            leaves = [one for one in in_others if one.host == new.host][:1] or in_others[:1]
        return (SlotPool.OTHER if leaves else None), leaves

    # --- events ---

    def later(self, seconds: float) -> None:
        self.now += seconds

    @rule(host=st.sampled_from(PRIORITY_HOSTS + OTHER_HOSTS), seconds=st.sampled_from(STEPS), ended=st.integers(0, 5))
    def connect(self, host: str, seconds: float, ended: int) -> None:
        self.later(seconds)
        new = Connection(host, host in PRIORITY_HOSTS, self.now, has_ended=not ended)
        pool, leaves = self.decision(new)
        admission = self.slots.admit(new)
        assert admission.accepted is (pool is not None), (new, pool, leaves)
        if leaves:
            assert admission.evicted in leaves, (admission.evicted, leaves)
            assert admission.evicted is not None
            self.open.remove(admission.evicted)
            del self.pool_of[admission.evicted]
        else:
            assert admission.evicted is None
        if pool is not None:
            self.open.append(new)
            self.pool_of[new] = pool

    @precondition(lambda self: self.open)
    @rule(number=st.integers(0, 8), seconds=st.sampled_from(STEPS), is_use=st.booleans())
    def speak(self, number: int, seconds: float, is_use: bool) -> None:
        self.later(seconds)
        one = self.open[number % len(self.open)]
        if not one.has_ended:
            one.received += 12
            one.last_used = self.now if is_use else one.last_used

    @precondition(lambda self: self.open)
    @rule(number=st.integers(0, 8), seconds=st.sampled_from(STEPS))
    def work(self, number: int, seconds: float) -> None:
        self.later(seconds)
        one = self.open[number % len(self.open)]
        if one.received:
            one.is_busy = not one.is_busy
            one.last_used = self.now

    @precondition(lambda self: self.open)
    @rule(number=st.integers(0, 8))
    def end(self, number: int) -> None:
        self.open[number % len(self.open)].has_ended = True

    @precondition(lambda self: self.open)
    @rule(number=st.integers(0, 8), twice=st.booleans())
    def leave(self, number: int, twice: bool) -> None:
        one = self.open.pop(number % len(self.open))
        was_in = self.pool_of.pop(one)
        self.slots.leave(one)
        if was_in is SlotPool.PRIORITY:
            waiting = [one for one in self.open if one.is_priority and self.pool_of[one] is SlotPool.OTHER]
            for up in [one for one in waiting if self.may_have_priority_slot(one.host)][:1]:
                self.pool_of[up] = SlotPool.PRIORITY
        if twice:
            self.slots.leave(one)

    # --- always ---

    @invariant()
    def has_the_pools_of_the_page(self) -> None:
        assert [one.pool for one in self.open] == [self.pool_of[one] for one in self.open]
        for pool in SlotPool:
            assert self.slots.count(pool) == len(self.of(pool)) if self.open else True
        if self.open:
            assert len(self.slots) == len(self.open)


TestSlotsModel = pytest.mark.clause("T12", "T13", "T14")(SlotsModel.TestCase)
TestSlotsModel.settings = settings(max_examples=examples(60), stateful_step_count=60, deadline=None)
