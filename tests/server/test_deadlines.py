"""What is overdue and when to look again, by times that the test hands in."""

from dataclasses import dataclass
from typing import Any

import pytest

from busway.options.server import ListenerParameters
from busway.server.deadlines import Deadlines, Overdue


@dataclass(eq=False)
class Connection:
    """One connection, as its times see it."""

    last_used: float = 0.0
    unfinished: int = 0
    unsent: int = 0
    is_idle: bool = True


def deadlines(**options: Any) -> Deadlines[Connection]:  # Any: options of several types
    return Deadlines(ListenerParameters(**options))


@pytest.mark.clause("T40")
@pytest.mark.parametrize(
    ("unfinished", "due", "what"), [(1, 5.0, Overdue.HEADER), (6, 5.0, Overdue.HEADER), (7, 10.0, Overdue.FRAME)]
)
def test_a_header_and_a_whole_frame_have_times_of_their_own(unfinished: int, due: float, what: Overdue) -> None:
    times = deadlines(header_timeout=5.0, frame_timeout=10.0)
    one = Connection(unfinished=unfinished)
    assert times.frame_begun(one, 100.0, anew=True) == 100.0 + due
    assert times.next_due(100.0, has_connections=True) == 100.0 + due
    assert times.due([one], 100.0 + due - 0.1) == []
    assert times.due([one], 100.0 + due) == [(one, what)]
    assert times.next_due(111.0, has_connections=True) is None


def test_the_time_of_a_frame_runs_from_its_first_byte_however_many_pieces_come() -> None:
    times = deadlines(header_timeout=5.0, frame_timeout=10.0)
    one = Connection(unfinished=1)
    times.frame_begun(one, 0.0, anew=True)
    one.unfinished = 8
    assert times.frame_begun(one, 4.0, anew=False) == 10.0
    assert times.due([one], 9.9) == []
    assert times.due([one], 10.0) == [(one, Overdue.FRAME)]


def test_the_next_frame_has_the_whole_time_again_and_one_that_ended_is_forgotten() -> None:
    times = deadlines(header_timeout=None, frame_timeout=10.0)
    one = Connection(unfinished=8)
    times.frame_begun(one, 0.0, anew=True)
    assert times.frame_begun(one, 6.0, anew=True) == 16.0
    one.unfinished = 0
    assert times.due([one], 16.0) == []
    assert times.next_due(16.0, has_connections=True) is None


def test_a_header_timeout_beyond_that_of_the_frame_is_the_frames() -> None:
    times = deadlines(header_timeout=5.0, frame_timeout=1.0)
    one = Connection(unfinished=3)
    assert times.frame_begun(one, 0.0, anew=True) == 1.0
    assert times.due([one], 1.0) == [(one, Overdue.FRAME)]


def test_without_timeouts_nothing_is_ever_due() -> None:
    times = deadlines(header_timeout=None, frame_timeout=None, write_timeout=None)
    one = Connection(unfinished=3, unsent=9)
    assert times.frame_begun(one, 0.0, anew=True) is None
    assert times.stuck(one, 0.0) is None
    assert times.next_due(0.0, has_connections=True) is None
    assert times.due([one], 1e9) == []


@pytest.mark.clause("T39")
def test_replies_that_are_not_taken_are_due_and_any_that_is_taken_starts_the_time_anew() -> None:
    times = deadlines(write_timeout=60.0)
    one = Connection(unsent=1000)
    assert times.stuck(one, 0.0) == 60.0
    one.unsent = 900
    assert times.due([one], 60.0) == []
    assert times.next_due(60.0, has_connections=True) == 120.0
    assert times.due([one], 120.0) == [(one, Overdue.WRITE)]
    times.stuck(one, 130.0)
    times.taken(one)
    assert times.due([one], 999.0) == []


def test_reading_that_is_paused_goes_on_in_time() -> None:
    times = deadlines()
    one = Connection()
    assert times.pause(one, 7.0) == 7.0
    assert times.is_paused(one)
    assert times.due([one], 6.9) == []
    assert times.due([one], 7.0) == [(one, Overdue.PAUSE)]
    assert not times.is_paused(one)


@pytest.mark.clause("T6")
def test_idle_connections_are_looked_for_sixteen_times_in_their_time_and_none_is_closed_before_it() -> None:
    times = deadlines(idle_timeout=16.0)
    used = Connection(last_used=10.0)
    idle = Connection(last_used=0.0)
    busy = Connection(last_used=0.0, is_idle=False)
    now, looks, closed = 0.0, 0, []
    while now < 30.0:
        due = times.next_due(now, has_connections=True)
        assert due is not None
        assert due > now
        now, looks = due, looks + 1
        closed += [(one, now) for one, what in times.due([used, idle, busy], now) if what is Overdue.IDLE]
    assert looks == 30
    first = {id(one): when for one, when in reversed(closed)}
    assert first == {id(idle): 16.0, id(used): 26.0}


def test_without_connections_there_is_no_look() -> None:
    assert deadlines(idle_timeout=16.0).next_due(0.0, has_connections=False) is None


def test_one_that_has_ended_is_forgotten() -> None:
    times = deadlines()
    one = Connection(unfinished=1, unsent=1)
    times.frame_begun(one, 0.0, anew=True)
    times.stuck(one, 0.0)
    times.pause(one, 5.0)
    times.forget(one)
    assert times.next_due(0.0, has_connections=True) is None
    assert times.due([], 1e9) == []
