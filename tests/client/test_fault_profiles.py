"""What the client does with every device that misbehaves: right data or the right error, and back in step by itself.

Each test holds for the blocking and for the asyncio client. Devices hold their address in every register, so data that
belongs to another request is known at once.
"""

from pathlib import Path

import pytest
from client_kinds import CLIENT_KINDS, AnyUnit, ClientKind

import busway
from busway.session.tcp_client import _STEP
from busway.testing import FAULT_PROFILES, Carrier, FakeClock, Schedule, faulty_server

TIMEOUT = 0.06
"""Seconds that a test waits for a reply that does not come."""
AMPLE = 5.0
"""Seconds in which a reply comes that does."""

pytestmark = [pytest.mark.clause("A21"), pytest.mark.clause("T25")]


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ClientKind:
    # A blocking link looks whether its peer has closed only after a pause: here, always.
    monkeypatch.setattr("busway.client.blocking_link._IDLE_SECONDS", 0.0)
    _number_from(monkeypatch, 0x1000)  # far from what the fault profiles answer with
    found: ClientKind = request.param
    return found


def _number_from(monkeypatch: pytest.MonkeyPatch, first: int) -> None:
    """Give the links of a test transaction identifiers after ``first``, where each link draws its own otherwise."""
    monkeypatch.setattr("busway.client.sessions.random.getrandbits", lambda bits: first)


def _device() -> busway.Device:
    return busway.Device(holding_registers=list(range(1000)), input_registers=1000, coils=1000)


def _try(unit: AnyUnit, address: int, count: int = 2, **call: object) -> None:
    """Read registers that hold their address, with the timeout of the link; whatever comes must be theirs."""
    values = unit.read_holding_registers(address, count=count, **call)
    assert values == list(range(address, address + count)), "data of another request was delivered"


def _read(unit: AnyUnit, address: int, count: int = 2) -> None:
    """The same where an answer must come, however busy the machine is."""
    _try(unit, address, count, timeout=AMPLE)


def _is_answered(unit: AnyUnit, address: int) -> bool:
    """Whether a read brings its data in time."""
    try:
        _try(unit, address)
    except busway.NoReply:
        return False
    return True


# --- timing --------------------------------------------------------------------------------------


def test_late_names_the_slow_device_and_its_delay_and_is_back_in_step_by_itself(via: ClientKind) -> None:
    clock = FakeClock()
    with (
        faulty_server(_device(), clock=clock) as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0) as link,
    ):
        late = server.add("late", delay=1.5)
        unit = link.unit(1)
        with pytest.raises(busway.NoReply) as caught:
            _try(unit, 10)
        assert caught.value.kind == "nothing"
        clock.advance(1.5)  # now the reply to the first request leaves
        with pytest.raises(busway.NoReply) as caught:
            _try(unit, 20)
        error = caught.value
        assert error.kind == "late"
        assert error.observed_delay is not None
        assert error.observed_delay >= TIMEOUT
        assert "slow" in str(error)
        assert (error.endpoint, error.unit, error.function, error.address) == (server.endpoint, 1, 3, 20)
        late.off()
        clock.advance(1.5)
        _read(unit, 30)
        assert link.counters.late_replies == 2
        assert link.counters.connections == 1
        assert link.counters.foreign_replies == link.counters.bad_replies == 0


def test_late_is_served_with_a_longer_timeout(via: ClientKind) -> None:
    with faulty_server(_device(), "late", delay=0.1) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        _read(link.unit(1), 10)
        assert link.counters.timeouts == 0


def test_queue_lag_is_never_delivered_and_ends_with_a_new_connection(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "queue-lag", connections=1) as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0, recycle_after_timeouts=2) as link,
    ):
        unit = link.unit(1)
        answered = [_is_answered(unit, address) for address in range(0, 60, 10)]
        assert answered == [False, False, False, False, True, True]
        assert link.counters.late_replies == 3
        assert link.counters.recycled == 1
        assert link.counters.connections == 2


def test_queue_lag_under_the_identifier_of_the_next_request_is_refused_where_it_does_not_fit(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "queue-lag", stamped=True) as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0) as link,
    ):
        unit = link.unit(1)
        assert not _is_answered(unit, 10)
        with pytest.raises(busway.BadReply) as caught:
            _read(unit, 20, count=5)
        assert caught.value.raw[9:] == bytes.fromhex("000A 000B")


def test_mute_after_connect_is_waited_for_with_connect_delay(via: ClientKind) -> None:
    with faulty_server(_device(), "mute-after-connect", seconds=0.1) as server:
        with via.link(server.endpoint, timeout=TIMEOUT, retries=0) as link:
            assert not _is_answered(link.unit(1), 10)
        with via.link(server.endpoint, timeout=TIMEOUT, retries=0, connect_delay=0.15) as link:
            _read(link.unit(1), 20)
            assert link.counters.timeouts == 0


def test_wedged_gets_a_new_connection_after_some_timeouts_in_a_row(via: ClientKind) -> None:
    with (
        faulty_server(_device()) as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0, recycle_after_timeouts=2) as link,
    ):
        unit = link.unit(1)
        _read(unit, 10)
        wedged = server.add("wedged")
        assert not _is_answered(unit, 20)
        assert link.counters.recycled == 0
        assert not _is_answered(unit, 30)
        assert (link.counters.recycled, link.counters.timeouts) == (1, 2)
        wedged.off()
        _read(unit, 40)
        assert link.counters.connections == server.accepted == 2


def test_read_that_is_not_heard_is_repeated_and_a_write_is_not(via: ClientKind) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=TIMEOUT, retries=2) as link:
        unit = link.unit(1)
        server.add("wedged", functions={3}, schedule=Schedule(times=2))
        _try(unit, 10)
        assert link.counters.retries == 2
        server.add("wedged", functions={6})
        with pytest.raises(busway.WriteOutcomeUnknown) as caught:
            unit.write_single_register(5, 1)
        assert isinstance(caught.value.__cause__, busway.NoReply)
        assert (caught.value.function, caught.value.address, caught.value.attempt) == (6, 5, 1)
        assert [one.function for one in server.requests] == [3, 3, 3, 6]


def test_min_gap_is_kept_by_request_gap(via: ClientKind) -> None:
    with faulty_server(_device(), "min-gap", seconds=0.03) as server:
        with via.link(server.endpoint, timeout=TIMEOUT, retries=0) as link:
            _read(link.unit(1), 10)
            assert not _is_answered(link.unit(1), 20)
        with via.link(server.endpoint, timeout=AMPLE, retries=0, request_gap=0.05) as link:
            for address in (10, 20, 30, 40):
                _read(link.unit(1), address)
            assert link.counters.timeouts == 0


def test_unit_switch_is_met_by_asking_again(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "unit-switch") as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=100, open_after=0) as link,
    ):
        for number in (1, 2, 1, 1):
            _try(link.unit(number), 10)
        assert link.counters.retries >= 2


# --- identifiers ---------------------------------------------------------------------------------


def test_foreign_transaction_is_dropped_and_counted(via: ClientKind) -> None:
    with faulty_server(_device(), "foreign-transaction") as server, via.link(server.endpoint, timeout=AMPLE) as link:
        for address in range(0, 400, 20):
            _read(link.unit(1), address)
        assert link.counters.foreign_replies == 20
        assert link.counters.recycled == 0


def test_foreign_transactions_alone_end_with_a_new_connection(via: ClientKind) -> None:
    with (
        faulty_server(_device()) as server,
        via.link(
            server.endpoint, timeout=TIMEOUT, retries=0, recycle_after_foreign=3, recycle_after_timeouts=100
        ) as link,
    ):
        unit = link.unit(1)
        foreign = server.add("foreign-transaction", instead=True)
        assert not _is_answered(unit, 10)
        assert not _is_answered(unit, 20)
        with pytest.raises((busway.NoReply, busway.LinkDown)):
            _try(unit, 30)
        assert (link.counters.foreign_replies, link.counters.recycled) == (3, 1)
        foreign.off()
        _read(unit, 40)
        assert link.counters.connections == 2


@pytest.mark.parametrize("fault_profile", ["transaction+1", "transaction=0", "transaction=random"])
def test_identifier_that_is_not_echoed_is_dropped_under_the_policy_strict(via: ClientKind, fault_profile: str) -> None:
    with faulty_server(_device(), fault_profile) as server, via.link(server.endpoint, timeout=TIMEOUT) as link:
        with pytest.raises(busway.NoReply):
            _try(link.unit(1), 10)
        assert link.counters.foreign_replies == 2  # the read and its repetition


@pytest.mark.parametrize("policy", ["automatic", "ignore"])
@pytest.mark.parametrize("fault_profile", ["transaction+1", "transaction=0", "transaction=random"])
def test_identifier_that_is_not_echoed_is_taken_by_policy(via: ClientKind, fault_profile: str, policy: str) -> None:
    with (
        faulty_server(_device(), fault_profile) as server,
        via.link(server.endpoint, timeout=AMPLE, transaction_policy=policy) as link,
    ):
        unit = link.unit(1)
        for address in (10, 20, 30):
            _read(unit, address)
        unit.write_single_register(0, 7)
        with pytest.raises(busway.ExceptionReply):
            unit.read_holding_registers(1000, count=1)
        assert link.counters.tolerated_replies == 5


@pytest.mark.parametrize("fault_profile", ["transaction+1", "transaction=0", "transaction=random"])
def test_identifier_that_is_not_echoed_is_never_taken_while_several_requests_are_in_flight(
    via: ClientKind, fault_profile: str
) -> None:
    requests = [busway.ReadHoldingRegisters(10 * number, 2) for number in range(8)]
    with (
        faulty_server(_device(), fault_profile) as server,
        via.link(
            server.endpoint, timeout=TIMEOUT, retries=0, max_transactions=8, transaction_policy="automatic"
        ) as link,
    ):
        outcomes = link.unit(1).execute_many(requests, return_errors=True)
        for request, outcome in zip(requests, outcomes, strict=True):
            if isinstance(outcome, busway.ReadHoldingRegisters.Reply):
                assert outcome.registers == [request.address, request.address + 1]
            else:
                assert isinstance(outcome, busway.NoReply | busway.LinkDown)
        assert link.counters.foreign_replies == 8


def test_identifier_that_equals_another_in_flight_by_chance_cannot_be_told_from_its_reply(
    via: ClientKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    _number_from(monkeypatch, -2 * _STEP & 0xFFFF)  # the second request of the link has the identifier 0
    requests = [busway.ReadHoldingRegisters(10 * number, 2) for number in range(8)]
    with (
        faulty_server(_device(), "transaction=0") as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0, max_transactions=8) as link,
    ):
        outcomes = link.unit(1).execute_many(requests, return_errors=True)
        (taken,) = [number for number, outcome in enumerate(outcomes) if not isinstance(outcome, busway.ModbusError)]
        assert taken == 1
        assert outcomes[taken].registers == [0, 1]  # of the first request: the limit that the documentation states
        assert link.counters.foreign_replies == 7


def test_identifier_that_equals_another_in_flight_is_a_bad_reply_where_the_lengths_differ(
    via: ClientKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    _number_from(monkeypatch, -2 * _STEP & 0xFFFF)
    requests = [busway.ReadHoldingRegisters(10 * number, 1 + number) for number in range(8)]
    with (
        faulty_server(_device(), "transaction=0") as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0, max_transactions=8) as link,
    ):
        outcomes = link.unit(1).execute_many(requests, return_errors=True)
        assert isinstance(outcomes[1], busway.BadReply)
        assert all(isinstance(outcome, busway.ModbusError) for outcome in outcomes)


def test_timeout_ends_the_connection_where_replies_do_not_name_their_request(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "transaction=0") as server,
        via.link(server.endpoint, timeout=TIMEOUT, retries=0, transaction_policy="automatic") as link,
    ):
        unit = link.unit(1)
        late = server.add("late", delay=1.5 * TIMEOUT)
        for address in (10, 20):
            assert not _is_answered(unit, address)
        late.off()
        _read(unit, 30)
        assert link.counters.recycled == 2
        assert link.counters.connections == 3


@pytest.mark.parametrize(("fault_profile", "answers_as"), [("unit=255", 255), ("unit=0", 0), ("unit=1", 1)])
def test_foreign_unit_is_a_broken_reply_under_the_policy_strict(
    via: ClientKind, fault_profile: str, answers_as: int
) -> None:
    with faulty_server(_device(), fault_profile) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        with pytest.raises(busway.BadReply) as caught:
            _read(link.unit(17), 10)
        assert caught.value.raw[6] == answers_as
        assert caught.value.reason == f"unit {answers_as} answered where 17 was asked"
        assert (caught.value.unit, caught.value.address) == (17, 10)
        assert link.counters.bad_replies == 1


@pytest.mark.parametrize("policy", ["automatic", "ignore"])
@pytest.mark.parametrize("fault_profile", ["unit=255", "unit=0", "unit=1"])
def test_foreign_unit_is_taken_by_policy(via: ClientKind, fault_profile: str, policy: str) -> None:
    with (
        faulty_server(_device(), fault_profile) as server,
        via.link(server.endpoint, timeout=AMPLE, unit_policy=policy) as link,
    ):
        for address in (10, 20):
            _read(link.unit(17), address)


@pytest.mark.clause("T24")
@pytest.mark.parametrize("asked", [0, 255])
@pytest.mark.parametrize("fault_profile", ["unit=255", "unit=0", "unit=1"])
def test_unit_of_the_reply_says_nothing_where_the_device_itself_was_asked(
    via: ClientKind, fault_profile: str, asked: int
) -> None:
    with faulty_server(_device(), fault_profile) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        _read(link.unit(asked), 10)


# --- connections ---------------------------------------------------------------------------------


def test_close_if_silent_is_met_by_connecting_at_the_first_need(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "close-if-silent", seconds=0.05) as server,
        via.link(server.endpoint, timeout=AMPLE) as link,
    ):
        assert server.accepted == 0
        _read(link.unit(1), 10)
        assert server.accepted == 1


def test_close_if_silent_after_a_connection_made_too_early_costs_no_request(via: ClientKind) -> None:
    with (
        faulty_server(_device(), "close-if-silent", seconds=0.02) as server,
        via.link(server.endpoint, timeout=AMPLE, retries=0) as link,
    ):
        link.connect()
        server.wait_until(lambda: server.accepted == 1 and server.connections == 0)
        link.breathe()
        _read(link.unit(1), 10)
        assert server.accepted == 2


@pytest.mark.clause("T8")
@pytest.mark.parametrize("starve", [False, True])
def test_single_client_is_met_by_sharing_one_connection(via: ClientKind, starve: bool) -> None:
    with (
        faulty_server(_device(), "single-client", starve=starve) as server,
        via.link(server.endpoint, timeout=AMPLE) as link,
    ):
        units = [link.unit(1), link.unit(2)]
        for unit in units:
            _read(unit, 10)
        assert server.accepted == 1


@pytest.mark.parametrize(("starve", "error"), [(False, busway.LinkDown), (True, busway.NoReply)])
def test_single_client_refuses_or_starves_a_second_connection(
    via: ClientKind, starve: bool, error: type[busway.ModbusError]
) -> None:
    with (
        faulty_server(_device(), "single-client", starve=starve) as server,
        via.link(server.endpoint, timeout=AMPLE) as link,
    ):
        _read(link.unit(1), 10)
        with via.link(server.endpoint, shared=False, timeout=TIMEOUT, retries=0) as second, pytest.raises(error):
            _try(second.unit(1), 10)
        _read(link.unit(1), 20)


@pytest.mark.clause("T7")
@pytest.mark.parametrize("write", [False, True])
def test_idle_close_is_reopened_in_silence(via: ClientKind, write: bool) -> None:
    clock = FakeClock()
    with (
        faulty_server(_device(), "idle-close", clock=clock, seconds=30) as server,
        via.link(server.endpoint, timeout=AMPLE, retries=0) as link,
    ):
        unit = link.unit(1)
        _read(unit, 10)
        clock.advance(30)
        server.wait_until(lambda: server.connections == 0)
        link.breathe()
        if write:
            unit.write_single_register(0, 7)
        else:
            _read(unit, 20)
        assert server.accepted == link.counters.connections == 2


def test_execute_then_drop_ends_as_outcome_unknown_and_is_executed_once(via: ClientKind) -> None:
    device = _device()
    executed: list[list[int]] = []
    device.on_write("holding_registers", lambda change: executed.append(change.new))
    with (
        faulty_server(device, "execute-then-drop") as server,
        via.link(server.endpoint, timeout=AMPLE, retries=3) as link,
    ):
        unit = link.unit(1)
        with pytest.raises(busway.WriteOutcomeUnknown) as caught:
            unit.write_multiple_registers(5, [7, 8])
        assert isinstance(caught.value.__cause__, busway.LinkDown)
        assert caught.value.__cause__.sent
        assert executed == [[7, 8]]
        assert unit.read_holding_registers(5, count=2) == [7, 8]
        assert server.accepted == 2


def test_execute_then_drop_is_repeated_only_where_the_caller_says_that_it_may_be(via: ClientKind) -> None:
    device = _device()
    executed: list[list[int]] = []
    device.on_write("holding_registers", lambda change: executed.append(change.new))
    with faulty_server(device) as server, via.link(server.endpoint, timeout=AMPLE, retries=1) as link:
        server.add("execute-then-drop", schedule=Schedule(times=1))
        link.unit(1).write_single_register(5, 7, idempotent=True)
        assert executed == [[7], [7]]


# --- refusals ------------------------------------------------------------------------------------


def test_max_block_is_passed_on_and_a_read_is_split_only_where_that_is_asked_for(via: ClientKind) -> None:
    with faulty_server(_device(), "max-block", items=125) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        unit = link.unit(1)
        limit = server.add("max-block", items=50)
        with pytest.raises(busway.ExceptionReply) as caught:
            _read(unit, 10, count=51)
        assert caught.value.code == 3
        assert len(server.requests) == 1
        limit.off()
        assert unit.read("4x11", count=300, split=True) == list(range(10, 310))
        with pytest.raises(busway.InvalidRequest):
            unit.read("4x11", count=300)


def test_hole_fails_the_block_that_touches_it_and_no_other(via: ClientKind) -> None:
    with faulty_server(_device(), "hole", address=15) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        unit = link.unit(1)
        with pytest.raises(busway.ExceptionReply) as caught:
            _read(unit, 10, count=10)
        assert (caught.value.code, caught.value.address) == (2, 10)
        _read(unit, 10, count=5)
        _read(unit, 16, count=5)


def test_busy_is_passed_on_and_other_units_are_served(via: ClientKind) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=AMPLE, retries=3) as link:
        busy = server.add("busy", units={1})
        with pytest.raises(busway.ExceptionReply) as caught:
            _read(link.unit(1), 10)
        assert caught.value.code == 6
        assert busy.struck == 1  # the application decides on asking again
        _read(link.unit(2), 10)
        busy.off()
        _read(link.unit(1), 10)


@pytest.mark.clause("A20")
@pytest.mark.parametrize("code", [0x00, 0x09, 0x0C, 0x63, 0xFF])
def test_unknown_exception_code_is_reported_as_it_came(via: ClientKind, code: int) -> None:
    with faulty_server(_device(), "odd-exception", code=code) as server, via.link(server.endpoint) as link:
        with pytest.raises(busway.ExceptionReply) as caught:
            _read(link.unit(1), 10)
        assert caught.value.code == code
        assert f"{code:02X}" in str(caught.value)
        with pytest.raises(busway.ExceptionReply):
            link.unit(1).write_single_register(1, 1)


@pytest.mark.parametrize("size", [1, 3, 4, 200])
def test_exception_of_a_wrong_length_is_a_broken_reply(via: ClientKind, size: int) -> None:
    with faulty_server(_device(), "odd-exception", code=2, size=size) as server, via.link(server.endpoint) as link:
        with pytest.raises(busway.BadReply) as caught:
            _read(link.unit(1), 10)
        assert len(caught.value.raw) == 7 + size
        with pytest.raises(busway.WriteOutcomeUnknown):
            link.unit(1).write_single_register(1, 1)
        assert link.counters.bad_replies == 2


@pytest.mark.parametrize(
    ("fault_profile", "function", "lost"), [("fc6-only", "single", 16), ("fc16-only", "multiple", 6)]
)
def test_device_with_one_write_function_is_written_with_that_one(
    via: ClientKind, fault_profile: str, function: str, lost: int
) -> None:
    device = _device()
    with faulty_server(device, fault_profile) as server, via.link(server.endpoint, timeout=TIMEOUT) as link:
        unit = link.unit(1)
        unit.write("4x6", 77, function=function)
        unit.write("0x6", True, function=function)
        assert device.holding_registers[5] == 77
        assert device.coils[5]
        other = {"single": "multiple", "multiple": "single"}[function]
        with pytest.raises(busway.WriteOutcomeUnknown) as caught:
            unit.write("4x7", 78, function=other)
        assert caught.value.function == lost
        assert device.holding_registers[6] == 6


# --- contents ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [4, 8, 12])
def test_wide_register_is_a_broken_reply(via: ClientKind, size: int) -> None:
    with (
        faulty_server(_device(), "wide-register", size=size) as server,
        via.link(server.endpoint, timeout=AMPLE) as link,
    ):
        with pytest.raises(busway.BadReply) as caught:
            _read(link.unit(1), 10)
        assert caught.value.raw[8] == 2 * size
        assert link.counters.connections == 1


@pytest.mark.parametrize("size", [4, 6, 8, 10, 12])
def test_wide_register_is_read_where_the_link_is_told_its_width(via: ClientKind, size: int) -> None:
    device = _device()
    device.holding_registers[500] = 0xFFFF
    with (
        faulty_server(device, "wide-register", size=size) as server,
        via.link(f"{server.endpoint}?register_width={size}", timeout=AMPLE) as link,
    ):
        unit = link.unit(1)
        _read(unit, 10, count=20)
        assert unit.read_input_registers(0, count=3) == [0, 0, 0]
        assert unit.read("4x501", "int16") == -1  # a value narrower than its register is its last bytes
        assert unit.read("4x11", "uint16", count=100, split=True) == list(range(10, 110))
        assert unit.read_coils(0, count=3) == [False] * 3
        with pytest.raises(busway.InvalidRequest, match=f"1…{250 // size}"):
            unit.read_holding_registers(0, count=250 // size + 1)
        with pytest.raises(busway.BadReply):
            unit.execute(busway.ReadHoldingRegisters(10, 2))  # a request says itself what its reply is
        assert link.counters.connections == 1


@pytest.mark.parametrize(("size", "kind"), [(4, "uint32"), (8, "uint64")])
def test_wide_register_is_a_number_of_its_width_where_no_type_is_named(via: ClientKind, size: int, kind: str) -> None:
    with (
        faulty_server(_device(), "wide-register", size=size) as server,
        via.link(server.endpoint, register_width=size, timeout=AMPLE) as link,
    ):
        unit = link.unit(1)
        assert unit.read("4x8") == unit.read("4x8", kind) == 7
        assert unit.read("4x8", count=3) == [7, 8, 9]
        assert server.requests[-1].pdu == bytes.fromhex("03 0007 0003")


def test_wide_register_of_an_odd_size_needs_a_type_and_a_narrow_device_a_link_that_is_not_told_so(
    via: ClientKind,
) -> None:
    with faulty_server(_device()) as server:
        with via.link(server.endpoint, register_width=6, timeout=AMPLE) as link:
            with pytest.raises(busway.InvalidRequest, match="name a type"):
                link.unit(1).read("4x8")
            assert not server.requests
            with pytest.raises(busway.BadReply):
                link.unit(1).read("4x8", "uint16")
        for width in ("1", "3", "14"):
            with pytest.raises(busway.ConfigError), via.link(server.endpoint, register_width=width):
                raise AssertionError("the link was made")


@pytest.mark.parametrize("missing", [1, 2, 4, 5])
def test_short_reply_is_broken_and_shows_its_bytes(via: ClientKind, missing: int) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        short = server.add("short", missing=missing)
        with pytest.raises(busway.BadReply) as caught:
            _read(link.unit(1), 10)
        assert caught.value.raw[7:] == bytes.fromhex("03 04 000A 000B")[: 6 - missing]
        short.off()
        _read(link.unit(1), 20)
        assert link.counters.connections == 1


def test_short_reply_whose_header_promises_more_is_partial_and_ends_with_a_new_connection(via: ClientKind) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=TIMEOUT, retries=0) as link:
        short = server.add("short", missing=2, header=True)
        with pytest.raises(busway.NoReply) as caught:
            _try(link.unit(1), 10)
        assert caught.value.kind == "partial"
        assert caught.value.raw[7:] == bytes.fromhex("03 04 000A")
        short.off()
        _read(link.unit(1), 20)
        assert link.counters.connections == 2


@pytest.mark.parametrize("extra", [1, 2, 100])
def test_long_reply_is_broken_and_shows_its_bytes(via: ClientKind, extra: int) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        long = server.add("long", extra=extra)
        with pytest.raises(busway.BadReply) as caught:
            _read(link.unit(1), 10)
        assert caught.value.raw[7:] == bytes.fromhex("03 04 000A 000B") + bytes(extra)
        long.off()
        _read(link.unit(1), 20)
        assert link.counters.connections == 1


@pytest.mark.parametrize("extra", [1, 2, 7, 100])
def test_bytes_between_frames_cost_no_wrong_data_and_the_link_recovers(via: ClientKind, extra: int) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=TIMEOUT, retries=2) as link:
        long = server.add("long", extra=extra, header=False)
        unit = link.unit(1)
        for address in (10, 20, 30):
            _try(unit, address)
        long.off()
        _read(unit, 40)
        assert link.counters.recycled >= 2


def test_reply_longer_than_a_frame_can_be_is_a_broken_stream(via: ClientKind) -> None:
    with faulty_server(_device()) as server, via.link(server.endpoint, timeout=AMPLE, retries=0) as link:
        server.add("long", extra=300, schedule=Schedule(times=1))
        with pytest.raises(busway.BadReply, match="length field 307"):
            _read(link.unit(1), 10)
        _read(link.unit(1), 20)
        assert link.counters.connections == 2


def test_wrong_echo_leaves_the_outcome_unknown_and_shows_the_bytes(via: ClientKind) -> None:
    with faulty_server(_device(), "wrong-echo") as server, via.link(server.endpoint, timeout=AMPLE) as link:
        unit = link.unit(1)
        writes = (
            lambda: unit.write_single_register(5, 7),
            lambda: unit.write_single_coil(5, True),
            lambda: unit.write_multiple_registers(5, [7, 8]),
            lambda: unit.write_multiple_coils(5, [True, True]),
            lambda: unit.mask_write_register(5, and_mask=0, or_mask=7),
        )
        for number, write in enumerate(writes, 1):
            with pytest.raises(busway.WriteOutcomeUnknown) as caught:
                write()
            assert isinstance(caught.value.__cause__, busway.BadReply)
            assert caught.value.raw == caught.value.__cause__.raw != b""
            assert link.counters.bad_replies == len(server.requests) == number
        assert link.counters.connections == 1


def test_dribble_is_put_together(via: ClientKind) -> None:
    with faulty_server(_device(), "dribble") as server, via.link(server.endpoint, timeout=AMPLE) as link:
        for address in (10, 20):
            _read(link.unit(1), address, count=5)
        with pytest.raises(busway.ExceptionReply):
            _read(link.unit(1), 1000)
        assert link.counters.timeouts == link.counters.bad_replies == 0


@pytest.mark.clause("T9")
def test_glue_is_taken_apart(via: ClientKind) -> None:
    requests = [busway.ReadHoldingRegisters(10 * number, 1 + number) for number in range(16)]
    with (
        faulty_server(_device(), "glue") as server,
        via.link(server.endpoint, timeout=AMPLE, max_transactions=16) as link,
    ):
        replies = link.unit(1).execute_many(requests)
        for request, reply in zip(requests, replies, strict=True):
            assert reply.registers == list(range(request.address, request.address + request.count))
        assert link.counters.connections == 1


# --- together ------------------------------------------------------------------------------------


def test_several_faults_with_chance_never_bring_wrong_data(via: ClientKind) -> None:
    with (
        faulty_server(_device(), seed=7) as server,
        via.link(server.endpoint, timeout=0.03, retries=3, max_transactions=4) as link,
    ):
        for name, options in (
            ("foreign-transaction", {}),
            ("dribble", {"piece": 3}),
            ("short", {"missing": 1}),
            ("wedged", {}),
            ("late", {"delay": 0.04}),
            ("long", {"header": False}),
            ("transaction+1", {}),
        ):
            server.add(name, probability=0.06, **options)
        unit = link.unit(1)
        right = 0
        for address in range(150):
            try:
                _try(unit, address)
                right += 1
            except (busway.NoReply, busway.BadReply, busway.LinkDown):
                pass
        assert right >= 100
        for applied in server.faults:
            applied.off()
        _read(unit, 500)


def test_every_fault_profile_of_a_server_on_tcp_is_tested_here() -> None:
    source = Path(__file__).read_text(encoding="utf-8")
    on_tcp = [name for name, one in FAULT_PROFILES.items() if one.carriers != {Carrier.SERIAL}]
    assert [name for name in on_tcp if f'"{name}"' not in source] == []
