"""Two pools of connection slots against the rules of docs/tcp.md (`slot_rules`): who gets in, and who makes room."""

from dataclasses import dataclass

import pytest
from examples import examples
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from slot_rules import SlotRules

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

    @initialize(
        priority=st.integers(0, 4),
        other=st.integers(1, 5),
        priority_per_host=st.integers(1, 3),
        per_host=st.none() | st.integers(1, 3),
    )
    def begin(self, priority: int, other: int, priority_per_host: int, per_host: int | None) -> None:
        limits = SlotLimits(priority, other, priority_per_host, per_host)
        self.rules: SlotRules[Connection] = SlotRules(limits)
        self.slots: ConnectionSlots[Connection] = ConnectionSlots(limits)

    @property
    def open(self) -> list[Connection]:
        return list(self.rules.open)

    # --- events ---

    def later(self, seconds: float) -> None:
        self.now += seconds

    @rule(host=st.sampled_from(PRIORITY_HOSTS + OTHER_HOSTS), seconds=st.sampled_from(STEPS), ended=st.integers(0, 5))
    def connect(self, host: str, seconds: float, ended: int) -> None:
        self.later(seconds)
        new = Connection(host, host in PRIORITY_HOSTS, self.now, has_ended=not ended)
        pool, leaves = self.rules.decision(host, self.now, is_priority=new.is_priority, has_ended=new.has_ended)
        admission = self.slots.admit(new)
        assert admission.accepted is (pool is not None), (new, pool, leaves)
        if leaves:
            assert admission.evicted in leaves, (admission.evicted, leaves)
            assert admission.evicted is not None
            self.rules.leave(admission.evicted)
        else:
            assert admission.evicted is None
        if pool is not None:
            self.rules.open[new] = pool

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
        one = self.open[number % len(self.open)]
        self.rules.leave(one)
        self.slots.leave(one)
        if twice:
            self.slots.leave(one)

    # --- always ---

    @invariant()
    def has_the_pools_of_the_page(self) -> None:
        assert {one: one.pool for one in self.open} == self.rules.open
        for pool in SlotPool:
            assert self.slots.count(pool) == len(self.rules.of(pool))
        assert len(self.slots) == len(self.open)


TestSlotsModel = pytest.mark.clause("T12", "T13", "T14")(SlotsModel.TestCase)
TestSlotsModel.settings = settings(max_examples=examples(60), stateful_step_count=60, deadline=None)
