"""Echo: exactly one copy of each sent frame is taken out, and the automatic mode learns."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.echo import ECHO_WINDOW, Echo, EchoFilter

FRAME = bytes.fromhex("01 03 00 00 00 0A C5 CD")


def after_sending(mode: Echo, *, may_be_reply: bool = False) -> EchoFilter:
    echo = EchoFilter(mode)
    echo.sent(FRAME, 1.0, may_be_reply=may_be_reply)
    return echo


def test_off_hands_everything_through() -> None:
    assert after_sending(Echo.OFF).receive(FRAME, 1.0) == FRAME


@pytest.mark.clause("S15")
@given(st.lists(st.integers(1, 20), max_size=8), st.binary(max_size=20))
def test_on_takes_one_copy_however_it_is_cut(cuts: list[int], behind: bytes) -> None:
    echo = after_sending(Echo.ON, may_be_reply=True)
    stream, out, at = FRAME + behind, b"", 0
    for cut in [*cuts, len(stream)]:
        if stream[at : at + cut]:
            out += echo.receive(stream[at : at + cut], 1.0)
        at += cut
    assert out == behind


def test_bytes_that_differ_go_on_whole() -> None:
    echo = after_sending(Echo.ON)
    assert echo.receive(FRAME[:4], 1.0) == b""
    assert echo.pending
    assert echo.receive(b"\xff\xff", 1.0) == FRAME[:4] + b"\xff\xff"
    assert echo.present is True


def known_to_echo(mode: Echo) -> EchoFilter:
    echo = after_sending(mode)
    assert echo.receive(FRAME, 1.0) == b""
    echo.sent(FRAME, 2.0, may_be_reply=True)
    return echo


KNOWN = pytest.mark.parametrize("mode", [Echo.ON, Echo.AUTOMATIC])


@KNOWN
@given(st.lists(st.integers(1, 20), max_size=8), st.binary(max_size=20))
def test_a_late_copy_is_taken_out_where_the_line_echoes_and_the_reply_like_it_is_not(
    mode: Echo, cuts: list[int], behind: bytes
) -> None:
    echo = known_to_echo(mode)
    stream, out, at, now = FRAME + FRAME + behind, b"", 0, 2.0 + 10 * ECHO_WINDOW
    for cut in [*cuts, len(stream)]:
        if stream[at : at + cut]:
            out += echo.receive(stream[at : at + cut], now)
        at += cut
        now += 0.001
    assert out == FRAME + behind


@KNOWN
@given(st.binary(min_size=1, max_size=20), st.lists(st.integers(1, 20), max_size=8))
def test_noise_before_the_copy_does_not_make_the_copy_pass(mode: Echo, noise: bytes, cuts: list[int]) -> None:
    echo = known_to_echo(mode)
    stream, out, at = noise + FRAME, b"", 0
    for cut in [*cuts, len(stream)]:
        if stream[at : at + cut]:
            out += echo.receive(stream[at : at + cut], 2.0)
        at += cut
    assert out == noise
    assert echo.present is True


@KNOWN
def test_a_copy_after_the_response_timeout_is_taken_out_where_the_line_echoes(mode: Echo) -> None:
    echo = known_to_echo(mode)
    assert echo.release() == b""
    assert echo.receive(FRAME, 4.0) == b""


def test_automatic_removes_copies_until_three_frames_in_a_row_had_none() -> None:
    echo = known_to_echo(Echo.AUTOMATIC)
    for lost in (1, 2, 3):
        assert echo.receive(b"\x01\x83\x02\xc0\xf1", 2.0 + lost) == b"\x01\x83\x02\xc0\xf1"
        echo.sent(FRAME, 3.0 + lost, may_be_reply=True)
        if lost == 2:
            assert echo.receive(b"\xff" + FRAME, 3.0 + lost) == b"\xff"
            for again in (1, 2, 3):
                echo.sent(FRAME, 6.0 + again, may_be_reply=True)
                assert echo.present is (again == 1)
                echo.release()
                echo.release()
    assert echo.receive(FRAME, 10.0) == FRAME
    assert echo.present is False


@KNOWN
def test_the_begin_of_a_copy_whose_rest_is_missing_is_let_go(mode: Echo) -> None:
    echo = known_to_echo(mode)
    assert echo.receive(FRAME[:3], 5.0) == b""
    due = echo.deadline()
    assert due == 5.0 + ECHO_WINDOW
    assert echo.tick(due) == FRAME[:3]
    assert echo.receive(FRAME, due) == b""


def test_a_copy_after_the_window_is_not_the_echo_while_the_line_is_unknown() -> None:
    echo = after_sending(Echo.AUTOMATIC)
    assert echo.receive(FRAME, 1.0 + ECHO_WINDOW * 1.01) == FRAME
    assert echo.present is False


def test_a_part_of_a_copy_is_let_go_when_the_window_ends() -> None:
    echo = after_sending(Echo.AUTOMATIC)
    echo.receive(FRAME[:3], 1.0)
    due = echo.deadline()
    assert due == 1.0 + ECHO_WINDOW
    assert echo.tick(due - 0.001) == b""
    assert echo.tick(due) == FRAME[:3]
    assert echo.present is False


@pytest.mark.clause("S15")
def test_automatic_learns_both_ways_and_unlearns() -> None:
    echo = after_sending(Echo.AUTOMATIC)
    assert echo.present is None
    assert echo.receive(FRAME, 1.0) == b""
    assert echo.present is True
    echo.sent(FRAME, 2.0, may_be_reply=False)
    assert echo.receive(b"\x01\x83\x02", 2.0) == b"\x01\x83\x02"
    assert echo.present is False
    echo.sent(FRAME, 3.0, may_be_reply=False)
    assert echo.receive(FRAME, 3.0) == b""
    assert echo.present is True


@pytest.mark.clause("S15")
def test_a_copy_that_may_be_the_reply_is_held_only_while_the_line_is_unknown() -> None:
    echo = after_sending(Echo.AUTOMATIC, may_be_reply=True)
    assert echo.receive(FRAME, 1.0) == b""
    assert echo.receive(FRAME, 1.2) == FRAME  # the second one is the reply
    assert echo.present is True
    unknown = after_sending(Echo.AUTOMATIC, may_be_reply=True)
    assert unknown.receive(FRAME, 1.0) == b""
    assert unknown.release() == FRAME
    assert unknown.present is False
    unknown.sent(FRAME, 2.0, may_be_reply=True)
    assert unknown.receive(FRAME, 2.0) == FRAME


def test_release_with_nothing_held_ends_the_wait_for_a_copy_while_the_line_is_unknown() -> None:
    echo = after_sending(Echo.AUTOMATIC)
    assert echo.release() == b""
    assert echo.receive(FRAME, 1.0) == FRAME


READ_REPLY = bytes.fromhex("01 03 02 00 07 F9 86")


def after_reply(mode: Echo, raw: bytes = FRAME, *, may_be_request: bool = True) -> EchoFilter:
    echo = EchoFilter(mode)
    echo.replied(raw, 1.0, 1.004, may_be_request=may_be_request)
    return echo


def test_off_knows_a_reply_that_a_master_may_send_too_by_its_time() -> None:
    assert after_reply(Echo.OFF).is_own_reply(FRAME, 0.9)
    assert not after_reply(Echo.OFF).is_own_reply(FRAME, 1.004)


def test_off_knows_the_copy_of_other_replies_however_late() -> None:
    echo = after_reply(Echo.OFF, READ_REPLY, may_be_request=False)
    assert echo.is_own_reply(READ_REPLY, 9.0)
    for number in (10.0, 20.0, 30.0):  # that has shown the echo
        echo.replied(FRAME, number, number + 0.004, may_be_request=True)
        assert echo.is_own_reply(FRAME, number + 5.0)
    for number in (40.0, 50.0, 60.0):  # three replies without a copy
        echo.replied(FRAME, number, number + 0.004, may_be_request=True)
        assert not echo.is_own_reply(READ_REPLY, number + 5.0)
    echo.replied(FRAME, 70.0, 70.004, may_be_request=True)
    assert not echo.is_own_reply(FRAME, 75.0)


def test_only_the_first_frame_after_a_reply_is_its_copy() -> None:
    echo = after_reply(Echo.OFF)
    assert echo.is_own_reply(FRAME, 0.9)
    assert not echo.is_own_reply(FRAME, 0.9)
    echo = after_reply(Echo.OFF)
    assert not echo.is_own_reply(READ_REPLY, 0.9)
    assert not echo.is_own_reply(FRAME, 0.9)


def test_parts_of_a_copy_that_pass_for_frames_are_the_copy() -> None:
    echo = after_reply(Echo.OFF, FRAME + READ_REPLY)
    assert echo.is_own_reply(FRAME, 0.9)
    assert echo.is_own_reply(READ_REPLY, 0.9)
    assert not echo.is_own_reply(READ_REPLY, 0.9)


@pytest.mark.parametrize("mode", [Echo.ON, Echo.AUTOMATIC])
def test_frame_after_a_removed_copy_is_a_request(mode: Echo) -> None:
    echo = after_reply(mode)
    assert echo.receive(FRAME, 0.9) == b""
    assert echo.receive(FRAME, 1.01) == FRAME
    assert not echo.is_own_reply(FRAME, 1.01)


def test_automatic_hands_through_a_repeated_request_where_the_line_does_not_echo() -> None:
    echo = after_reply(Echo.AUTOMATIC, READ_REPLY, may_be_request=False)
    assert echo.receive(FRAME, 1.01) == FRAME
    assert echo.present is False
    for number in (2.0, 3.0):
        echo.replied(FRAME, number, number + 0.004, may_be_request=True)
        assert echo.receive(FRAME, number + 0.01) == FRAME
        assert not echo.is_own_reply(FRAME, number + 0.01)
    echo.replied(FRAME, 4.0, 4.004, may_be_request=True)
    assert echo.receive(FRAME, 3.99) == b""  # no master may send yet
    assert echo.present is True


def test_automatic_drops_an_early_repeated_request_while_nothing_is_known_and_learns_nothing() -> None:
    echo = after_reply(Echo.AUTOMATIC)
    assert echo.receive(FRAME, 1.01) == b""
    assert echo.present is None
    assert echo.receive(FRAME, 1.3) == FRAME


@pytest.mark.parametrize("times_tell", [True, False])
def test_automatic_takes_a_copy_that_begins_before_its_request_has_ended_for_the_echo(times_tell: bool) -> None:
    echo = EchoFilter(Echo.AUTOMATIC)
    echo.times_tell = times_tell
    echo.sent(FRAME, 1.0, may_be_reply=True, replies_from=0.9995)
    assert echo.receive(FRAME, 0.99) == b""
    assert echo.pending is not times_tell
    assert echo.present is (True if times_tell else None)
    assert echo.release() == (b"" if times_tell else FRAME)
