"""Counters, event log, listen-only mode and restart of a line or listener."""

import pytest

from busway.codes import DiagnosticCode
from busway.pdu.model import Refusal
from busway.session.diagnostics import EVENT_LOG_SIZE, CommunicationState, Counters

COUNTERS = {
    0x0B: "bus_message_count",
    0x0C: "bus_communication_error_count",
    0x0D: "bus_exception_error_count",
    0x0E: "server_message_count",
    0x0F: "server_no_response_count",
    0x10: "server_nak_count",
    0x11: "server_busy_count",
    0x12: "bus_character_overrun_count",
}
CHANGES = (0x01, 0x03, 0x04, 0x0A, 0x14)


def state(*, changes_allowed: bool = True) -> CommunicationState:
    return CommunicationState(changes_allowed=changes_allowed)


def log(one: CommunicationState) -> bytes:
    return one.event_log()[3]


def counters(one: CommunicationState) -> dict[str, int]:
    return {name: getattr(one.counters, name) for name in COUNTERS.values() if getattr(one.counters, name)}


# Counting (S16).


@pytest.mark.clause("S16")
def test_a_message_for_this_server_is_a_bus_message_and_a_server_message() -> None:
    one = state()
    one.received()
    assert counters(one) == {"bus_message_count": 1, "server_message_count": 1}
    assert (one.message_count, one.event_count) == (1, 0)


@pytest.mark.clause("S16")
def test_a_message_for_another_unit_is_a_bus_message_only() -> None:
    one = state()
    one.received_foreign()
    assert counters(one) == {"bus_message_count": 1}
    assert log(one) == b""


@pytest.mark.clause("S16")
def test_a_damaged_frame_is_a_communication_error_and_an_overrun_is_counted_too() -> None:
    one = state()
    one.received_damaged()
    one.received_damaged(overrun=True)
    assert counters(one) == {"bus_communication_error_count": 2, "bus_character_overrun_count": 1}
    assert log(one) == b"\x92\x82"


@pytest.mark.clause("S16")
@pytest.mark.parametrize(
    ("exception", "counter"),
    [
        *((code, "bus_exception_error_count") for code in (1, 2, 3, 4, 5, 8, 10, 11)),
        (6, "server_busy_count"),
        (7, "server_nak_count"),
    ],
)
def test_an_exception_is_counted_by_its_kind_and_is_no_event(exception: int, counter: str) -> None:
    one = state()
    one.answered(exception=exception)
    assert counters(one) == {counter: 1}
    assert one.event_count == 0


@pytest.mark.clause("S16")
def test_what_gets_no_answer_is_counted() -> None:
    one = state()
    one.received(broadcast=True)
    one.kept_silent()
    assert counters(one) == {"bus_message_count": 1, "server_message_count": 1, "server_no_response_count": 1}
    assert log(one) == b"\xc0"


@pytest.mark.clause("S16")
def test_exchanges_that_are_added_in_passing_count_like_single_ones() -> None:
    for number in (1, 5, 40, 100):
        summed, single = state(), state()
        for one in (summed, single):
            one.received()
            one.answered(exception=2)
        summed.exchanged += number
        for _ in range(number):
            single.received()
            single.answered()
        assert summed.counters == single.counters
        assert summed.event_log() == single.event_log()
        assert (summed.event_count, summed.message_count) == (single.event_count, single.message_count)


# Function 08.


@pytest.mark.clause("S16")
@pytest.mark.clause("S17")
@pytest.mark.parametrize(("sub_code", "name"), COUNTERS.items())
def test_each_counter_is_read_by_its_sub_function_on_16_bits(sub_code: int, name: str) -> None:
    one = state()
    setattr(one.counters, name, 0x1_2345)
    assert one.diagnose(sub_code, b"\x00\x00") == b"\x23\x45"
    assert getattr(one.counters, name) == 0x1_2345, "a status shows the true number"


@pytest.mark.clause("S17")
def test_a_query_comes_back_and_the_diagnostic_register_is_what_the_application_set() -> None:
    one = state(changes_allowed=False)
    assert one.diagnose(0x00, b"\xa5\x37") == b"\xa5\x37"
    one.diagnostic_register = 0xBEEF
    assert one.diagnose(0x02, b"\x00\x00") == b"\xbe\xef"


@pytest.mark.clause("S16")
@pytest.mark.clause("A23")
def test_0a_clears_counters_counts_and_the_diagnostic_register_and_keeps_the_log() -> None:
    one = state()
    one.diagnostic_register = 7
    one.exchanged += 3
    one.received_damaged()
    assert one.diagnose(0x0A, b"\x00\x00") == b"\x00\x00"
    assert one.counters == Counters()
    assert (one.event_count, one.message_count, one.diagnostic_register) == (0, 0, 0)
    assert len(log(one)) == 7


@pytest.mark.clause("S17")
def test_14_clears_the_overrun_counter_alone() -> None:
    one = state()
    one.received_damaged(overrun=True)
    one.diagnose(0x14, b"\x00\x00")
    assert counters(one) == {"bus_communication_error_count": 1}


@pytest.mark.clause("S12")
def test_03_changes_the_delimiter() -> None:
    one = state()
    assert one.ascii_delimiter == 0x0A
    assert one.diagnose(0x03, b"\x3b\x00") == b"\x3b\x00"
    assert one.ascii_delimiter == 0x3B


@pytest.mark.clause("S17")
@pytest.mark.parametrize("sub_code", CHANGES)
def test_what_changes_the_listener_is_refused_where_it_is_not_allowed(sub_code: int) -> None:
    one = state(changes_allowed=False)
    one.received()
    with pytest.raises(Refusal) as caught:
        one.diagnose(sub_code, b"\x00\x00")
    assert caught.value.code == 1
    assert (one.listen_only, one.ascii_delimiter) == (False, 0x0A)
    assert counters(one)


@pytest.mark.parametrize("sub_code", [0x05, 0x09, 0x13, 0x15, 0xFFFF])
def test_a_sub_function_that_does_not_exist_is_refused(sub_code: int) -> None:
    assert sub_code not in tuple(DiagnosticCode)
    with pytest.raises(Refusal) as caught:
        state().diagnose(sub_code, b"\x00\x00")
    assert caught.value.code == 1


# Restart and listen-only mode.


@pytest.mark.clause("A23")
@pytest.mark.clause("S17")
@pytest.mark.parametrize(("data", "kept"), [(b"\x00\x00", b"\x40\x80\x40\x80"), (b"\xff\x00", b"")])
def test_a_restart_comes_after_its_answer_and_ff00_also_clears_the_log(data: bytes, kept: bytes) -> None:
    one = state()
    one.exchanged += 1
    one.received()
    assert one.diagnose(0x01, data) == data
    assert one.message_count == 2, "not before the answer"
    one.answered()
    assert one.counters == Counters()
    assert (one.event_count, one.message_count) == (0, 0)
    assert log(one) == b"\x00" + kept
    # Only once.
    one.received()
    one.answered()
    assert one.event_count == 1


@pytest.mark.clause("A23")
@pytest.mark.clause("S17")
def test_listen_only_mode_is_entered_and_left_without_an_answer() -> None:
    one = state()
    one.received()
    one.diagnose(0x04, b"\x00\x00")
    one.kept_silent()
    assert one.listen_only
    assert log(one) == b"\x04\x80"
    one.received()
    assert log(one)[:1] == b"\xa0", "received in listen-only mode"
    one.diagnose(0x01, b"\x00\x00")
    one.kept_silent()
    assert not one.listen_only
    assert log(one)[:1] == b"\x00"
    assert one.counters == Counters()


@pytest.mark.clause("S17")
def test_in_listen_only_mode_only_a_restart_is_processed() -> None:
    one = state()
    one.received()
    one.diagnose(0x04, b"\x00\x00")
    for sub_code in (0x00, 0x02, 0x03, 0x0A, 0x0B, 0x14):
        with pytest.raises(Refusal):
            one.diagnose(sub_code, b"\x3b\x00")
    assert counters(one)
    assert one.ascii_delimiter == 0x0A


# Functions 11 and 12.


@pytest.mark.clause("A23")
def test_the_status_is_ffff_while_a_program_command_runs() -> None:
    one = state()
    assert one.event_counter() == (0, 0)
    one.program_command_running = True
    assert one.event_counter() == (0xFFFF, 0)
    assert one.event_log()[0] == 0xFFFF


@pytest.mark.clause("A23")
@pytest.mark.parametrize(
    ("exception", "event"),
    [(1, 0x41), (2, 0x41), (3, 0x41), (4, 0x42), (5, 0x44), (6, 0x44), (7, 0x48), (8, 0x40), (11, 0x40)],
)
def test_a_send_event_shows_the_kind_of_exception(exception: int, event: int) -> None:
    one = state()
    one.answered(exception=exception)
    assert log(one) == bytes((event,))


@pytest.mark.clause("A23")
def test_an_answer_to_a_poll_is_an_event_of_the_log_but_not_of_the_counter() -> None:
    one = state()
    one.answered(counts=False)
    assert (one.event_count, log(one)) == (0, b"\x40")


@pytest.mark.clause("A23")
def test_the_log_holds_the_64_newest_events_newest_first() -> None:
    one = state()
    for _ in range(40):
        one.received()
        one.answered()
    one.answered(exception=7)
    assert len(log(one)) == EVENT_LOG_SIZE == 64
    assert log(one)[:3] == b"\x48\x40\x80"
