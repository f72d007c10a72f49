"""When a connection may be made anew: the table, and pauses that only a valid reply resets."""

import pytest

from busway.session.reconnect import TRANSITIONS, ConnectionEvent, ConnectionState, Reconnect

S, E = ConnectionState, ConnectionEvent

PATHS: dict[ConnectionState, tuple[ConnectionEvent, ...]] = {
    S.DOWN: (),
    S.CONNECTING: (E.DIALLED,),
    S.UP: (E.DIALLED, E.CONNECTED),
    S.SUSPECT: (E.DIALLED, E.CONNECTED, E.TIMEOUT),
    S.BACKING_OFF: (E.DIALLED, E.FAILED),
}


def at(state: ConnectionState, jitter: float = 1.0) -> Reconnect:
    """A connection that has come to ``state``, at time 0."""
    one = Reconnect(lambda: jitter)
    for event in PATHS[state]:
        one.move(event, 0.0)
    assert one.state is state
    return one


@pytest.mark.clause("T6")
@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("event", list(E))
def test_every_event_in_every_state_moves_as_the_table_says(state: ConnectionState, event: ConnectionEvent) -> None:
    one = at(state)
    one.move(event, 1.0, had_reply=True)
    expected = TRANSITIONS.get((state, event), state)
    assert one.state is expected


def test_every_state_can_be_left() -> None:
    for state in S:
        assert any(start is state and end is not state for (start, _), end in TRANSITIONS.items())


@pytest.mark.clause("T7")
@pytest.mark.parametrize("state", [S.UP, S.SUSPECT])
def test_a_connection_that_worked_is_made_anew_at_the_next_need(state: ConnectionState) -> None:
    one = at(state)
    one.move(E.LOST, 5.0, had_reply=True)
    assert one.state is S.DOWN
    assert one.may_dial(5.0)


@pytest.mark.parametrize("state", [S.UP, S.SUSPECT])
def test_a_peer_that_accepts_and_closes_is_left_alone_for_a_while(state: ConnectionState) -> None:
    one = at(state)
    one.move(E.LOST, 5.0, had_reply=False)
    assert one.state is S.BACKING_OFF
    assert (one.failures, one.not_before) == (1, 5.1)
    assert not one.may_dial(5.09)
    assert one.may_dial(5.1)


def test_the_pause_doubles_up_to_its_limit() -> None:
    one = Reconnect(lambda: 1.0, first=0.1, most=5.0)
    pauses = []
    now = 0.0
    for _ in range(10):
        assert one.may_dial(now)
        one.move(E.DIALLED, now)
        one.move(E.FAILED, now)
        pauses.append(round(one.not_before - now, 3))
        now = one.not_before
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0, 5.0]


def test_the_pause_does_not_overflow_after_years_of_failures() -> None:
    one = Reconnect(lambda: 0.5)
    one.failures = 100_000
    one.move(E.DIALLED, 0.0)
    one.move(E.FAILED, 0.0)
    assert one.not_before == 5.0 * 0.75


@pytest.mark.parametrize(("jitter", "pause"), [(0.0, 0.05), (0.5, 0.075), (1.0, 0.1)])
def test_jitter_takes_off_up_to_half_of_the_pause(jitter: float, pause: float) -> None:
    assert at(S.BACKING_OFF, jitter).not_before == pytest.approx(pause)


def test_only_a_valid_reply_resets_the_pause() -> None:
    one = Reconnect(lambda: 1.0)
    now = 0.0
    for _ in range(3):
        assert one.may_dial(now)
        one.move(E.DIALLED, now)
        one.move(E.CONNECTED, now)  # a connection alone is not enough
        one.move(E.LOST, now)
        now = one.not_before
    assert one.failures == 3
    assert one.may_dial(now)
    one.move(E.DIALLED, now)
    one.move(E.CONNECTED, now)
    one.move(E.VALID_REPLY, now)
    assert one.failures == 0


def test_only_a_link_that_is_down_may_dial() -> None:
    for state in S:
        assert at(state).may_dial(0.0) == (state is S.DOWN)


# --- ends that prove nothing, and news -----------------------------------------------------------


@pytest.mark.parametrize("failures", [0, 3])
@pytest.mark.parametrize("state", [S.UP, S.SUSPECT])
def test_a_connection_that_is_closed_unused_proves_nothing_either_way(state: ConnectionState, failures: int) -> None:
    one = at(state)
    one.failures = failures
    one.move(E.RELEASED, 5.0)
    assert (one.state, one.failures) == (S.DOWN, failures)
    assert one.may_dial(5.0)


def test_it_flaps_from_the_second_attempt_in_a_row_on() -> None:
    one = Reconnect(lambda: 1.0)
    seen = []
    now = 0.0
    for _ in range(3):
        assert one.may_dial(now)
        one.move(E.DIALLED, now)
        one.move(E.CONNECTED, now)
        one.move(E.LOST, now)
        seen.append(one.is_flapping)
        now = one.not_before
    assert seen == [False, True, True]
    one.may_dial(now)
    assert not one.is_flapping


STORIES = {
    "a peer that works, is lost and works again": [
        (E.DIALLED, ""),
        (E.CONNECTED, "up: connected"),
        (E.VALID_REPLY, ""),
        (E.TIMEOUT, "suspect: no reply in time"),
        (E.TIMEOUT, ""),
        (E.VALID_REPLY, "up: it answers again"),
        (E.RELEASED, "down: why"),
        (E.DIALLED, ""),
        (E.CONNECTED, "up: connected"),
    ],
    "a peer that is not there for three attempts": [
        (E.DIALLED, ""),
        (E.FAILED, "backing off: why"),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.FAILED, ""),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.FAILED, ""),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.CONNECTED, ""),
        (E.VALID_REPLY, "up: it answers again, after 3 attempts without a reply"),
    ],
    "a peer that accepts and closes": [
        (E.DIALLED, ""),
        (E.CONNECTED, "up: connected"),
        (E.LOST, "backing off: why"),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.CONNECTED, ""),
        (E.TIMEOUT, ""),
        (E.LOST, ""),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.CONNECTED, ""),
        (E.VALID_REPLY, "up: it answers again, after 2 attempts without a reply"),
    ],
    "a peer that misses one attempt": [
        (E.DIALLED, ""),
        (E.FAILED, "backing off: why"),
        (E.PAUSE_OVER, ""),
        (E.DIALLED, ""),
        (E.CONNECTED, ""),
        (E.VALID_REPLY, "up: it answers again, after 1 attempt without a reply"),
    ],
}


@pytest.mark.parametrize("story", list(STORIES))
def test_every_change_is_told_once_and_attempts_that_fail_in_a_row_are_counted(story: str) -> None:
    one = Reconnect(lambda: 0.0)
    assert [one.move(event, 0.0, reason="why") for event, _ in STORIES[story]] == [news for _, news in STORIES[story]]


def test_a_connection_that_had_worked_is_told_as_down_when_it_is_lost() -> None:
    one = at(S.UP)
    assert one.move(E.LOST, 1.0, reason="the peer closed it", had_reply=True) == "down: the peer closed it"


def test_an_event_that_the_table_does_not_know_is_no_news() -> None:
    assert at(S.DOWN).move(E.TIMEOUT, 1.0) == ""
