"""Who gets a place and who makes room: the cases by name, and what holds after anything that may happen."""

from collections import Counter
from dataclasses import dataclass

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.server.connection_slots import SECONDS_TO_SPEAK, ConnectionSlots, SlotLimits, SlotPool


@dataclass(eq=False)
class Connection:
    """One connection, as the pools see it."""

    host: str
    is_priority: bool = False
    last_used: float = 0.0
    is_busy: bool = False
    pool: SlotPool = SlotPool.OTHER
    received: int = 12
    has_ended: bool = False


def pools(
    priority: int = 2, other: int = 2, priority_per_host: int = 2, per_host: int | None = None
) -> ConnectionSlots[Connection]:
    return ConnectionSlots(SlotLimits(priority, other, priority_per_host, per_host))


@pytest.mark.clause("T13")
def test_marked_connections_take_priority_places_up_to_the_limit_of_their_device_and_then_others() -> None:
    both = pools(priority=3, other=3, priority_per_host=2)
    own = [Connection("a", is_priority=True) for _ in range(3)]
    for one in own:
        assert both.admit(one).accepted
    foreign = Connection("b", is_priority=True)
    both.admit(foreign)
    assert [one.pool for one in own] == [SlotPool.PRIORITY, SlotPool.PRIORITY, SlotPool.OTHER]
    assert foreign.pool is SlotPool.PRIORITY
    assert (both.count(SlotPool.PRIORITY), both.count(SlotPool.OTHER), len(both)) == (3, 1, 4)


@pytest.mark.clause("T13", "T18")
def test_who_has_said_nothing_and_is_gone_makes_room_before_the_one_unused_longest() -> None:
    both = pools(other=3)
    worker, silent, gone = Connection("a", last_used=1.0), Connection("b", received=0), Connection("c", received=0)
    for number, one in enumerate((worker, silent, gone)):
        one.last_used = float(number) / 10
        both.admit(one)
    gone.has_ended = True
    assert both.admit(Connection("x", last_used=0.5)).evicted is gone
    silent.received = 12  # it speaks, and is like all others
    assert both.admit(Connection("y", last_used=0.6)).evicted is worker


@pytest.mark.clause("T13")
def test_a_silent_connection_makes_room_however_many_that_have_sent_something_came_before_it() -> None:
    both = pools(other=200)
    for number in range(199):
        both.admit(Connection(f"worker-{number}"))
    silent = Connection("silent", received=0)
    both.admit(silent)
    assert both.admit(Connection("x", last_used=SECONDS_TO_SPEAK)).evicted is silent


@pytest.mark.clause("T13")
def test_who_had_time_and_said_nothing_makes_room_before_all_that_have_said_something() -> None:
    both = pools(other=2)
    worker, silent = Connection("a", last_used=1.0), Connection("b", last_used=5.0, received=0)
    both.admit(worker)
    both.admit(silent)
    assert both.admit(Connection("x", last_used=5.0 + SECONDS_TO_SPEAK)).evicted is silent


@pytest.mark.clause("T13")
def test_new_connection_that_has_just_come_keeps_its_place_though_it_said_nothing_yet() -> None:
    both = pools(other=2)
    worker, fresh = Connection("a", last_used=1.0), Connection("b", last_used=5.0, received=0)
    both.admit(worker)
    both.admit(fresh)
    assert both.admit(Connection("x", last_used=5.0 + SECONDS_TO_SPEAK / 2)).evicted is worker


@pytest.mark.clause("T13")
def test_new_connection_whose_peer_has_closed_takes_no_slot_of_others() -> None:
    both = pools(other=1)
    both.admit(Connection("a"))
    assert not both.admit(Connection("x", last_used=9.0, received=0, has_ended=True)).accepted
    assert both.count(SlotPool.OTHER) == 1


@pytest.mark.clause("T13")
def test_marked_new_connection_without_a_priority_place_pushes_out_one_that_is_not_marked() -> None:
    both = pools(priority=1, other=1)
    stranger = Connection("x")
    both.admit(stranger)
    assert both.admit(Connection("a", is_priority=True)).evicted is None
    second = Connection("b", is_priority=True)
    assert both.admit(second).evicted is stranger
    assert second.pool is SlotPool.OTHER


@pytest.mark.clause("T13")
@pytest.mark.clause("T40")
def test_new_connection_that_is_not_marked_is_refused_where_only_marked_ones_are_left() -> None:
    both = pools(priority=1, other=1)
    is_priority = [Connection("a", is_priority=True) for _ in range(2)]
    for one in is_priority:
        both.admit(one)
    admission = both.admit(Connection("x"))
    assert not admission.accepted
    assert admission.evicted is None
    assert len(both) == 2


@pytest.mark.clause("T13")
def test_marked_new_connection_among_marked_ones_replaces_the_oldest_of_its_own_device_beyond_its_places() -> None:
    both = pools(priority=1, other=2, priority_per_host=1)
    first, foreign, own = (
        Connection("a", is_priority=True),
        Connection("b", is_priority=True),
        Connection("a", is_priority=True),
    )
    for one in (first, foreign, own):
        both.admit(one)
    assert both.admit(Connection("a", is_priority=True)).evicted is own
    assert both.admit(Connection("c", is_priority=True)).evicted is foreign
    assert first.pool is SlotPool.PRIORITY


@pytest.mark.clause("T13")
def test_priority_place_that_becomes_free_goes_to_the_oldest_marked_one_that_may_have_it() -> None:
    both = pools(priority=2, other=3, priority_per_host=1)
    first, waiting, stranger, other = (
        Connection("a", is_priority=True),
        Connection("a", is_priority=True),
        Connection("x"),
        Connection("b", is_priority=True),
    )
    for one in (first, waiting, stranger, other):
        both.admit(one)
    both.leave(other)
    assert waiting.pool is SlotPool.OTHER  # its device has its one place
    both.leave(first)
    assert waiting.pool is SlotPool.PRIORITY
    assert (both.count(SlotPool.PRIORITY), both.count(SlotPool.OTHER)) == (1, 1)


@pytest.mark.clause("T12")
def test_connection_unused_longest_goes_first_and_busy_ones_stay_while_another_can_go() -> None:
    both = pools(other=4)
    used = {4.0: True, 1.0: True, 3.0: False, 2.0: False}
    found = {}
    for last_used, busy in used.items():
        found[last_used] = Connection("x", last_used=last_used, is_busy=busy)
        both.admit(found[last_used])
    assert both.admit(Connection("x", last_used=9.0, is_busy=True)).evicted is found[2.0]
    assert both.admit(Connection("x", last_used=9.0, is_busy=True)).evicted is found[3.0]
    assert both.admit(Connection("x", last_used=9.0)).evicted is found[4.0]  # all are busy: the oldest


@pytest.mark.clause("T18")
def test_device_beyond_its_own_limit_replaces_its_oldest_connection_and_no_other() -> None:
    both = pools(other=9, per_host=1)
    other, old = Connection("y"), Connection("x", is_busy=True)
    both.admit(other)
    both.admit(old)
    assert both.admit(Connection("x")).evicted is old
    assert len(both) == 2


@pytest.mark.clause("T13", "T18")
def test_device_beyond_its_own_limit_keeps_its_connection_where_the_new_one_is_closed_already() -> None:
    both = pools(other=9, per_host=1)
    worker = Connection("x")
    both.admit(worker)
    assert not both.admit(Connection("x", last_used=9.0, received=0, has_ended=True)).accepted
    assert both.admit(Connection("x")).evicted is worker


def test_one_that_has_lost_its_place_may_leave_again() -> None:
    both = pools(other=1)
    first, second = Connection("x"), Connection("y")
    both.admit(first)
    both.admit(second)
    both.leave(first)
    both.leave(second)
    both.leave(second)
    assert len(both) == 0


class Naive:
    """The rules of the other pool, looked up among all connections each time."""

    def __init__(self) -> None:
        self.here: list[Connection] = []

    def longest_unused(self) -> Connection | None:
        strangers = [one for one in self.here if not one.is_priority and one.pool is SlotPool.OTHER]
        idle = [one for one in strangers if not one.is_busy]
        return min(idle, key=lambda one: one.last_used) if idle else next(iter(strangers), None)


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["come", "come", "come", "leave", "use", "busy"]), st.integers(0, 30), st.sampled_from("abcxyz")
    ),
    max_size=120,
)
LIMITS = st.builds(
    SlotLimits,
    priority=st.integers(0, 4),
    other=st.integers(1, 5),
    priority_per_host=st.integers(1, 3),
    per_host=st.none() | st.integers(1, 3),
)


@pytest.mark.clause("T13")
@pytest.mark.clause("T14")
@settings(max_examples=examples(400), deadline=None)
@given(LIMITS, EVENTS)
def test_whatever_happens_the_limits_hold_and_marked_connections_stay(
    limits: SlotLimits, events: list[tuple[str, int, str]]
) -> None:
    both: ConnectionSlots[Connection] = ConnectionSlots(limits)
    naive = Naive()
    now = 0.0
    for what, number, host in events:
        now += 1.0
        here = naive.here
        if what == "come":
            candidate = Connection(host, is_priority=host in "abc", last_used=now)
            own = [one for one in here if one.host == host and not one.is_priority]
            expected = naive.longest_unused()
            was_full = both.count(SlotPool.OTHER) >= limits.other
            admission = both.admit(candidate)
            gone = admission.evicted
            if not admission.accepted:
                assert not candidate.is_priority
                assert all(one.is_priority for one in here)
                continue
            if candidate.is_priority and candidate.pool is SlotPool.PRIORITY:
                assert gone is None
            elif not candidate.is_priority and limits.per_host is not None and len(own) >= limits.per_host:
                assert gone is own[0]
            elif was_full and expected is not None:
                assert gone is expected
            elif was_full:
                assert candidate.is_priority
                assert gone is not None
                assert gone.is_priority
                assert gone.pool is SlotPool.OTHER
            else:
                assert gone is None
            if gone is not None:
                assert not (gone.is_priority and gone.pool is SlotPool.PRIORITY)
                here.remove(gone)
            here.append(candidate)
        elif here:
            one = here[number % len(here)]
            if what == "leave":
                both.leave(one)
                here.remove(one)
            elif what == "use":
                one.last_used = now
            else:
                one.is_busy = not one.is_busy
        in_priority = [one for one in here if one.pool is SlotPool.PRIORITY]
        assert all(one.is_priority for one in in_priority)
        assert both.count(SlotPool.PRIORITY) == len(in_priority) <= limits.priority
        assert both.count(SlotPool.OTHER) == len(here) - len(in_priority) <= limits.other
        assert max(Counter(one.host for one in in_priority).values(), default=0) <= limits.priority_per_host
        if limits.per_host is not None:
            strangers = Counter(one.host for one in here if not one.is_priority)
            assert max(strangers.values(), default=0) <= limits.per_host
