"""Counters, event log, listen-only mode and restart of the units of a line or listener."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from busway.codes import DiagnosticCode
from busway.pdu.device_interface import Refusal
from busway.session.diagnostic_counters import (
    EVENT_LOG_SIZE,
    CommunicationState,
    DiagnosticCounters,
    HeardCounters,
    LineDiagnostics,
)

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
    return LineDiagnostics(changes_allowed=changes_allowed).of(1)


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
    one.line.received_foreign()
    assert counters(one) == {"bus_message_count": 1}
    assert log(one) == b""


@pytest.mark.clause("S16")
def test_a_damaged_frame_is_a_communication_error_and_an_overrun_is_counted_too() -> None:
    one = state()
    one.line.received_damaged()
    one.line.received_damaged(overrun=True)
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
    one.line.received_broadcast([1])
    one.kept_silent()
    assert counters(one) == {"bus_message_count": 1, "server_message_count": 1, "server_no_response_count": 1}
    assert log(one) == b"\x40\xc0"


@pytest.mark.clause("S16")
def test_exchanges_that_are_added_in_passing_count_like_single_ones() -> None:
    for number in (1, 5, 40, 100):
        summed, single = state(), state()
        for one in (summed, single):
            one.received()
            one.answered(exception=2)
        summed.line.exchanged[1] += number
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
    if name in {"bus_message_count", "bus_communication_error_count", "bus_character_overrun_count"}:
        one.line.heard = HeardCounters(0x1_2345, 0x1_2345, 0x1_2345)
    else:
        setattr(one.own, name, 0x1_2345)
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
    one.line.exchanged[1] += 3
    one.line.received_damaged()
    assert one.diagnose(0x0A, b"\x00\x00") == b"\x00\x00"
    assert one.counters == DiagnosticCounters()
    assert (one.event_count, one.message_count, one.diagnostic_register) == (0, 0, 0)
    assert len(log(one)) == 7


@pytest.mark.clause("S17")
def test_14_clears_the_overrun_counter_alone() -> None:
    one = state()
    one.line.received_damaged(overrun=True)
    one.diagnose(0x14, b"\x00\x00")
    assert counters(one) == {"bus_communication_error_count": 1}


@pytest.mark.clause("S12")
def test_03_changes_the_delimiter() -> None:
    one = state()
    assert one.line.ascii_delimiter == 0x0A
    assert one.diagnose(0x03, b"\x3b\x00") == b"\x3b\x00"
    assert one.line.ascii_delimiter == 0x3B


@pytest.mark.clause("S17")
@pytest.mark.parametrize("sub_code", CHANGES)
def test_what_changes_the_listener_is_refused_where_it_is_not_allowed(sub_code: int) -> None:
    one = state(changes_allowed=False)
    one.received()
    with pytest.raises(Refusal) as caught:
        one.diagnose(sub_code, b"\x00\x00")
    assert caught.value.code == 1
    assert (one.listen_only, one.line.ascii_delimiter) == (False, 0x0A)
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
    one.line.exchanged[1] += 1
    one.received()
    assert one.diagnose(0x01, data) == data
    assert one.message_count == 2, "not before the answer"
    one.answered()
    assert one.counters == DiagnosticCounters()
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
    assert log(one) == b"\x60\x04\x80"
    one.received()
    assert log(one)[:1] == b"\xa0", "received in listen-only mode"
    one.diagnose(0x01, b"\x00\x00")
    one.kept_silent()
    assert not one.listen_only
    assert log(one)[:3] == b"\x00\x60\xa0"
    assert one.counters == DiagnosticCounters()


@pytest.mark.clause("S17")
def test_in_listen_only_mode_only_a_restart_is_processed() -> None:
    one = state()
    one.received()
    one.diagnose(0x04, b"\x00\x00")
    for sub_code in (0x00, 0x02, 0x03, 0x0A, 0x0B, 0x14):
        with pytest.raises(Refusal):
            one.diagnose(sub_code, b"\x3b\x00")
    assert counters(one)
    assert one.line.ascii_delimiter == 0x0A


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


# Each bit of the event bytes, as §6.10 has them: what happens → the bytes, the newest first.

READ_EXCEPTION, ABORT, BUSY, NAK, WRITE_TIMEOUT, LISTEN_ONLY_SENT = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
COMMUNICATION_ERROR, OVERRUN, LISTEN_ONLY_RECEIVED, BROADCAST = 0x02, 0x10, 0x20, 0x40
RECEIVE, SEND = 0x80, 0x40


def _request(one: CommunicationState) -> None:
    one.received()


def _answer(exception: int | None) -> Callable[[CommunicationState], None]:
    return lambda one: one.answered(exception=exception)


def _silence(one: CommunicationState) -> None:
    one.kept_silent()


def _unwritten(one: CommunicationState) -> None:
    one.kept_silent(write_failed=True)


def _broadcast(one: CommunicationState) -> None:
    one.line.received_broadcast([1])


def _damage(*, overrun: bool) -> Callable[[CommunicationState], None]:
    return lambda one: one.line.received_damaged(overrun=overrun)


def _mute(one: CommunicationState) -> None:
    one.received()
    one.diagnose(0x04, b"\x00\x00")
    one.kept_silent()


def _restart(data: bytes) -> Callable[[CommunicationState], None]:
    def ask(one: CommunicationState) -> None:
        muted = one.listen_only
        one.received()
        one.diagnose(0x01, data)
        one.kept_silent() if muted else one.answered()

    return ask


MUTED = [SEND | LISTEN_ONLY_SENT, 0x04, RECEIVE]
EVENT_BYTES = {
    "receive, bit 7: a query message is received": ([_request], [RECEIVE]),
    "receive, bit 1: communication error": ([_damage(overrun=False)], [RECEIVE | COMMUNICATION_ERROR]),
    "receive, bit 4: character overrun": ([_damage(overrun=True)], [RECEIVE | COMMUNICATION_ERROR | OVERRUN]),
    "receive, bit 5: currently in listen only mode": ([_mute, _request], [RECEIVE | LISTEN_ONLY_RECEIVED, *MUTED]),
    "receive, bit 5, of a damaged one": (
        [_mute, _damage(overrun=False)],
        [RECEIVE | COMMUNICATION_ERROR | LISTEN_ONLY_RECEIVED, *MUTED],
    ),
    "receive, bit 6: broadcast received": ([_broadcast], [RECEIVE | BROADCAST]),
    "receive, bits 5 and 6": ([_mute, _broadcast], [RECEIVE | BROADCAST | LISTEN_ONLY_RECEIVED, *MUTED]),
    "send, bit 6: a normal response": ([_request, _answer(None)], [SEND, RECEIVE]),
    "send, bit 6: no response": ([_request, _silence], [SEND, RECEIVE]),
    "send, bit 6: no response to a broadcast": ([_broadcast, _silence], [SEND, RECEIVE | BROADCAST]),
    **{f"send, bit 0: exception {code}": ([_answer(code)], [SEND | READ_EXCEPTION]) for code in (1, 2, 3)},
    "send, bit 1: server abort exception, 4": ([_answer(4)], [SEND | ABORT]),
    **{f"send, bit 2: server busy exception, {code}": ([_answer(code)], [SEND | BUSY]) for code in (5, 6)},
    "send, bit 3: server program NAK exception, 7": ([_answer(7)], [SEND | NAK]),
    **{f"send, no bit: exception {code}": ([_answer(code)], [SEND]) for code in (8, 10, 11)},
    "send, bit 4: write timeout error": ([_request, _unwritten], [SEND | WRITE_TIMEOUT, RECEIVE]),
    "send, bit 5: currently in listen only mode": (
        [_mute, _request, _silence],
        [SEND | LISTEN_ONLY_SENT, RECEIVE | LISTEN_ONLY_RECEIVED, *MUTED],
    ),
    "entered listen only mode": ([_mute], MUTED),
    "restart, the log goes on": ([_request, _silence, _restart(b"\x00\x00")], [0x00, SEND, RECEIVE, SEND, RECEIVE]),
    "restart, the rest of the log is cleared": ([_request, _silence, _restart(b"\xff\x00")], [0x00]),
    "restart in listen only mode": (
        [_mute, _restart(b"\x00\x00")],
        [0x00, SEND | LISTEN_ONLY_SENT, RECEIVE | LISTEN_ONLY_RECEIVED, *MUTED],
    ),
}


@pytest.mark.clause("A23")
@pytest.mark.parametrize(("steps", "expected"), EVENT_BYTES.values(), ids=EVENT_BYTES.keys())
def test_event_bytes_are_those_of_the_specification(
    steps: list[Callable[[CommunicationState], None]], expected: list[int]
) -> None:
    one = state()
    for step in steps:
        step(one)
    assert log(one).hex(" ") == bytes(expected).hex(" ")


@pytest.mark.clause("A23")
def test_message_count_of_function_12_is_the_bus_message_count_of_08_0b() -> None:
    one = state()
    one.received()
    one.answered(exception=2)
    one.line.received_foreign()
    one.line.received_broadcast([1])
    one.kept_silent(executed=True)
    one.line.received_damaged()
    one.line.exchanged[1] += 2
    assert one.event_log()[2] == int.from_bytes(one.diagnose(0x0B, b"\x00\x00"), "big") == 5
    assert one.event_log()[1] == one.event_counter()[1] == 3, "the successful ones"
    one.diagnose(0x0A, b"\x00\x00")
    assert one.event_log()[:3] == (0, 0, 0)


# Units of one line.


@pytest.mark.clause("S16")
def test_each_unit_of_a_line_counts_what_is_for_it_and_all_hear_the_same() -> None:
    line = LineDiagnostics(changes_allowed=True)
    one, other = line.of(1), line.of(3)
    one.received()
    one.answered(exception=6)
    line.received_damaged(overrun=True)
    line.received_foreign()
    assert one.counters == DiagnosticCounters(2, 1, 0, 1, 0, 0, 1, 1)
    assert other.counters == DiagnosticCounters(2, 1, 0, 0, 0, 0, 0, 1)
    assert line.counters == DiagnosticCounters(2, 1, 0, 1, 0, 0, 1, 1), "what is heard is not summed up"
    assert log(one) == b"\x92\x44\x80"
    assert log(other) == log(line.of(9)) == b"\x92", "a unit that nothing was sent to has heard it too"
    assert line.of(9).counters == other.counters


@pytest.mark.clause("S16")
@pytest.mark.clause("S17")
@pytest.mark.parametrize("sub_code", [0x01, 0x0A, 0x14])
def test_restart_and_clear_concern_the_unit_addressed(sub_code: int) -> None:
    line = LineDiagnostics(changes_allowed=True)
    for unit in (1, 3):
        line.of(unit).received()
        line.of(unit).answered(exception=2)
    line.received_damaged(overrun=True)
    before = line.of(1).counters
    line.of(3).diagnose(sub_code, b"\x00\x00")
    if sub_code == 0x01:
        line.of(3).answered()
    assert line.of(1).counters == before
    cleared = replace(before, bus_character_overrun_count=0) if sub_code == 0x14 else DiagnosticCounters()
    assert line.of(3).counters == cleared
    line.received_foreign()
    assert line.of(3).counters.bus_message_count == cleared.bus_message_count + 1


def test_requests_of_a_line_are_counted_whatever_a_unit_clears() -> None:
    line = LineDiagnostics(changes_allowed=True)
    line.of(1).received()
    line.received_foreign()
    line.received_broadcast([1, 3])
    line.exchanged[3] += 2
    line.of(1).diagnose(0x0A, b"\x00\x00")
    assert line.requests == 4


@pytest.mark.clause("S17")
def test_listen_only_mode_is_that_of_one_unit() -> None:
    line = LineDiagnostics(changes_allowed=True)
    line.of(3).received()
    line.of(3).diagnose(0x04, b"\x00\x00")
    line.of(3).kept_silent()
    assert (line.of(1).listen_only, line.of(3).listen_only, line.listen_only) == (False, True, True)
    line.of(1).received()
    assert log(line.of(1)) == b"\x80"
    assert line.of(1).diagnose(0x00, b"\x12\x34") == b"\x12\x34"
    line.of(3).restart()
    assert not line.listen_only


@pytest.mark.clause("S16")
def test_device_that_answers_as_several_units_has_one_state() -> None:
    line = LineDiagnostics(listed_unit=lambda unit: 1 if unit in (0, 255) else unit)
    assert line.of(255) is line.of(1) is line.of(0) is not line.of(2)
    line.exchanged[255] += 2
    line.exchanged[1] += 1
    assert line.of(1).counters.server_message_count == line.counters.server_message_count == 3
    assert line.event_count == 3
