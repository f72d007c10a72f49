"""What leaves a server that misbehaves, byte by byte and second by second, without a socket or a clock."""

from typing import Any

import pytest

import busway
from busway.framing.ascii import encode_ascii
from busway.framing.rtu import encode_rtu
from busway.options.server import UnitPolicy
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.message import Message
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import RequestContext
from busway.testing import (
    FAULT_PROFILES,
    Carrier,
    Contact,
    Exchange,
    Fault,
    Faults,
    FaultyConversation,
    Schedule,
    Selection,
    golden_adu,
)

READ = "03 0005 0002"
REPLY = bytes.fromhex("03 04 0005 0006")


class Said:
    """A conversation with one fault profile, and a clock."""

    def __init__(
        self,
        name: str = "",
        *,
        others: int = 0,
        device: busway.Device | None = None,
        framing: str = "mbap",
        gap: float = 0.0,
        **options: Any,
    ) -> None:
        self.faults = Faults()
        if name:
            self.faults.add(FAULT_PROFILES[name](**options))
        self.device = device or busway.Device(holding_registers=list(range(1000)), coils=100)
        self._handler = DeviceResponder({1: self.device}, unit_policy=UnitPolicy.ANY)
        self.heard: list[int] = []
        carriers = frozenset({Carrier.TCP, Carrier.CONNECTION} if framing == "mbap" else {Carrier.SERIAL})
        self.talk = FaultyConversation(self.faults, Contact(0.0, others, carriers=carriers), framing, gap=gap)

    def at(
        self, now: float, *pdus: str, unit: int = 1, transaction: int = 1, is_broadcast: bool = False
    ) -> list[bytes]:
        """Ask at ``now``, and what is written then."""
        for number, pdu in enumerate(pdus):
            self._ask(bytes.fromhex(pdu), unit, transaction + number, now, is_broadcast)
        return self.talk.tick(now)

    def _ask(self, pdu: bytes, unit: int, transaction: int, now: float, is_broadcast: bool) -> None:
        talk = self.talk
        self.heard.append(pdu[0])
        request = self._handler.functions.decode_request(pdu)
        adu = talk.frame(transaction, unit, pdu)
        exchange = Exchange(talk.contact, transaction, unit, pdu, request, now, adu=adu, is_broadcast=is_broadcast)
        struck = talk.strike(exchange)
        answer = talk.asked(struck)
        if answer is None:
            context = RequestContext(unit=unit, function=pdu[0], diagnostics=CommunicationState())
            try:
                outcome = self._handler.answer(context, request)
            except busway.Refusal as refusal:
                outcome = ExceptionResponse(pdu[0], refusal.code)
            assert isinstance(outcome, Message)
            answer = outcome.encode()
        talk.answered(exchange, struck, answer, now)


def _adu(pdu: bytes = REPLY, transaction: int = 1, unit: int = 1) -> bytes:
    return golden_adu(pdu, transaction=transaction, unit=unit)


def test_without_a_fault_the_device_is_heard() -> None:
    said = Said()
    assert said.at(0, READ) == [_adu()]
    assert said.at(1, "41 00") == [_adu(b"\xc1\x01")]
    assert said.talk.deadline(2) is None
    assert not said.talk.has_unsent


def test_answer_leaves_after_the_silence_that_its_line_needs_and_counts_as_late_from_there() -> None:
    said = Said("late", framing="rtu", gap=0.004, delay=1.0)
    assert said.at(0, READ) == []
    assert said.talk.has_unsent
    assert said.talk.deadline(0) == pytest.approx(1.004)
    assert said.talk.tick(1.004) == [encode_rtu(1, REPLY)]
    assert not said.talk.has_unsent


def test_late() -> None:
    said = Said("late", delay=1.5)
    assert said.at(0, READ) == []
    assert said.talk.deadline(0) == 1.5
    assert said.at(1, READ, transaction=2) == []
    assert said.talk.tick(1.5) == [_adu()]
    assert said.talk.tick(9.0) == [_adu(transaction=2)]


def test_queue_lag() -> None:
    said = Said("queue-lag", behind=2)
    assert [said.at(0, READ, transaction=number) for number in (1, 2, 3, 4)] == [
        [],
        [],
        [_adu()],
        [_adu(transaction=2)],
    ]
    stamped = Said("queue-lag", stamped=True)
    assert stamped.at(0, READ, "03 0007 0001") == [_adu(transaction=2)]
    spared = Said("queue-lag", connections=0)
    assert spared.at(0, READ) == [_adu()]


def test_foreign_transaction() -> None:
    assert Said("foreign-transaction", distance=5).at(0, READ) == [_adu(transaction=6), _adu()]
    assert Said("foreign-transaction", distance=5, instead=True).at(0, READ) == [_adu(transaction=6)]


def test_identifiers() -> None:
    assert Said("transaction+1").at(0, READ, transaction=0xFFFF) == [_adu(transaction=0)]
    assert Said("transaction=0").at(0, READ, transaction=7) == [_adu(transaction=0)]
    random = [Said("transaction=random").at(0, READ, transaction=7)[0] for _ in range(2)]
    assert random[0] == random[1]  # chance comes from the seed alone
    assert random[0][2:] == _adu()[2:]
    for number in (255, 0, 1):
        assert Said(f"unit={number}").at(0, READ, unit=9) == [_adu(unit=number)]


def test_mute_after_connect() -> None:
    said = Said("mute-after-connect", seconds=2)
    assert said.at(1.9, READ) == []
    assert said.at(2.0, READ) == [_adu()]


def test_close_if_silent() -> None:
    said = Said("close-if-silent", seconds=1)
    assert said.talk.deadline(0) == 1
    assert said.at(0.5, READ) == [_adu()]
    assert said.talk.deadline(0.5) is None
    silent = Said("close-if-silent", seconds=1)
    assert silent.talk.tick(1) == []
    assert silent.talk.closed


def test_single_client() -> None:
    assert not Said("single-client").talk.closed
    assert Said("single-client", others=1).talk.closed
    starved = Said("single-client", others=1, starve=True)
    assert not starved.talk.closed
    assert starved.at(0, READ) == []
    assert Said("single-client", starve=True).at(0, READ) == [_adu()]


def test_idle_close() -> None:
    said = Said("idle-close", seconds=30)
    assert said.at(10, READ) == [_adu()]
    assert said.talk.deadline(10) == 40
    said.talk.tick(40)
    assert said.talk.closed


def test_idle_close_that_begins_later() -> None:
    said = Said()
    schedule = Schedule(after=1.0, lasts=0.5, every=10.0)
    said.faults.add(FAULT_PROFILES["idle-close"](seconds=0.3), Selection(schedule=schedule))
    assert said.at(0, READ) == [_adu()]
    assert said.talk.deadline(0) == 1.0
    assert said.at(0.9, READ) == [_adu()]
    said.talk.tick(1.0)
    assert not said.talk.closed
    assert said.talk.deadline(1.0) == pytest.approx(1.2)
    assert said.at(1.1, READ) == [_adu()]
    assert said.at(1.4, READ) == [_adu()]
    said.talk.tick(1.6)
    assert said.talk.deadline(1.6) == 11.0
    said.talk.tick(11.0)
    assert said.talk.closed


def test_request_counts_once_for_a_fault_that_answers_it_and_changes_the_answer() -> None:
    said = Said()
    both = said.faults.add(
        Fault("both", asked=lambda exchange: bytes((0x83, 6)), answered=lambda exchange, emissions: 2 * emissions)
    )
    for number in range(1, 4):
        assert said.at(number, READ) == 2 * [_adu(bytes((0x83, 6)))]
        assert both.struck == number


def test_wedged() -> None:
    said = Said("wedged")
    assert said.at(0, READ, "06 0001 0009") == []
    assert said.device.holding_registers[1] == 1


def test_min_gap() -> None:
    said = Said("min-gap", seconds=0.5)
    assert said.at(0, READ) == [_adu()]
    assert said.at(0.4, READ) == []
    assert said.at(0.5, READ) == [_adu()]


def test_unit_switch() -> None:
    said = Said("unit-switch")
    heard = [bool(said.at(0, READ, unit=unit)) for unit in (1, 1, 2, 2, 1, 2, 2)]
    assert heard == [True, True, False, True, False, False, True]


def test_max_block() -> None:
    said = Said("max-block", items=10)
    assert said.at(0, "03 0000 000A")[0][7] == 3
    assert said.at(0, "03 0000 000B") == [_adu(b"\x83\x03")]
    assert said.at(0, "10 0000 000B 16" + 11 * "0001") == [_adu(b"\x90\x03")]


def test_hole() -> None:
    said = Said("hole", address=6)
    assert said.at(0, READ) == [_adu(b"\x83\x02")]
    assert said.at(0, "03 0007 0001") == [_adu(b"\x03\x02\x00\x07")]


def test_wide_register() -> None:
    assert Said("wide-register", size=4).at(0, READ) == [_adu(bytes.fromhex("03 08 00000005 00000006"))]
    said = Said("wide-register", size=12)
    (reply,) = said.at(0, "03 0000 007D")
    assert reply[8] == len(reply) - 9 == 252
    assert said.at(0, "03 1388 0001") == [_adu(b"\x83\x02")]
    assert said.at(0, "06 0001 0002") == [_adu(bytes.fromhex("06 0001 0002"))]


def test_short_and_long() -> None:
    assert Said("short", missing=1).at(0, READ) == [_adu(REPLY[:-1])]
    assert Said("short", missing=99).at(0, READ) == [_adu(REPLY[:1])]
    assert Said("short", missing=1, header=True).at(0, READ) == [_adu()[:-1]]
    assert Said("long", extra=2).at(0, READ) == [_adu(REPLY + b"\x00\x00")]
    assert Said("long", extra=2, header=False).at(0, READ) == [_adu() + b"\x00\x00"]


def test_dribble() -> None:
    said = Said("dribble", piece=5, pause=0.5)
    assert said.at(0, READ) == [_adu()[:5]]
    assert said.talk.tick(0.5) == [_adu()[5:10]]
    assert said.talk.tick(0.9) == []
    assert said.talk.tick(1.0) == [_adu()[10:]]
    at_once = Said("dribble", pause=0.0)
    assert at_once.at(0, READ) == [bytes((byte,)) for byte in _adu()]


def test_glue() -> None:
    said = Said("glue", window=1.0)
    assert said.at(0.2, READ) == []
    assert said.at(0.7, READ, transaction=2) == []
    assert said.talk.tick(1.0) == [_adu() + _adu(transaction=2)]
    assert said.at(1.1, READ, transaction=3) == []
    assert said.talk.tick(2.0) == [_adu(transaction=3)]


def test_busy() -> None:
    said = Said("busy", seconds=60)
    assert said.at(5, READ) == [_adu(b"\x83\x06")]
    assert said.at(64.9, READ) == [_adu(b"\x83\x06")]
    assert said.at(65, READ) == [_adu()]
    assert Said("busy", seconds=None).at(1e9, READ) == [_adu(b"\x83\x06")]


def test_execute_then_drop() -> None:
    said = Said("execute-then-drop")
    assert said.at(0, READ) == [_adu()]
    assert not said.talk.closed
    assert said.at(0, "06 0001 0009") == []
    assert said.talk.closed
    assert said.device.holding_registers[1] == 9


def test_wrong_echo() -> None:
    said = Said("wrong-echo")
    assert said.at(0, "06 0001 0002") == [_adu(bytes.fromhex("06 0001 0003"))]
    assert said.at(0, "06 1388 0002") == [_adu(b"\x86\x02")]
    assert said.at(0, READ) == [_adu()]


def test_odd_exception() -> None:
    assert Said("odd-exception", code=0x63).at(0, READ) == [_adu(b"\x83\x63")]
    assert Said("odd-exception", size=1).at(0, READ) == [_adu(b"\x83")]
    assert Said("odd-exception", code=2, size=4).at(0, READ) == [_adu(b"\x83\x02\x00\x00")]


def test_one_write_function_only() -> None:
    single, multiple = "06 0001 0002", "10 0001 0001 02 0002"
    assert Said("fc6-only").at(0, single) == [_adu(bytes.fromhex(single))]
    assert Said("fc6-only").at(0, multiple) == []
    assert Said("fc16-only").at(0, multiple) == [_adu(bytes.fromhex(multiple)[:5])]
    assert Said("fc16-only").at(0, single) == []
    assert Said("fc16-only", refuses=True).at(0, single) == [_adu(b"\x86\x01")]


# --- lines -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("framing", "encode"), [("rtu", encode_rtu), ("ascii", encode_ascii)])
def test_frames_of_lines_have_right_checks_whatever_they_say(framing: str, encode: Any) -> None:
    assert Said(framing=framing).at(0, READ) == [encode(1, REPLY)]
    assert Said("unit=255", framing=framing).at(0, READ) == [encode(255, REPLY)]
    assert Said("short", missing=2, framing=framing).at(0, READ) == [encode(1, REPLY[:-2])]
    assert Said("long", extra=1, framing=framing).at(0, READ) == [encode(1, REPLY + b"\x00")]


def test_leading_zero() -> None:
    assert Said("leading-zero", framing="rtu").at(0, READ) == [b"\x00" + encode_rtu(1, REPLY)]
    assert Said("leading-zero", framing="rtu", zeros=3).at(0, READ) == [bytes(3) + encode_rtu(1, REPLY)]


def test_noise() -> None:
    frame = encode_rtu(1, REPLY)
    (noisy,) = Said("noise", framing="rtu", size=4).at(0, READ)
    assert (len(noisy), noisy[4:-4]) == (len(frame) + 8, frame)
    assert Said("noise", framing="rtu", size=4).at(0, READ) == [noisy]  # chance comes from the seed alone
    (before,) = Said("noise", framing="rtu", size=4, after=False).at(0, READ)
    assert before[4:] == frame
    (after,) = Said("noise", framing="rtu", size=4, before=False).at(0, READ)
    assert after[:-4] == frame


def test_echo() -> None:
    assert Said("echo", framing="rtu").at(0, READ) == [encode_rtu(1, bytes.fromhex(READ)), encode_rtu(1, REPLY)]
    assert Said("echo", framing="ascii").at(0, READ)[0] == encode_ascii(1, bytes.fromhex(READ))


def test_broadcast_reply() -> None:
    one, several = "06 0001 0002", "10 0001 0001 02 0002"
    assert Said(framing="rtu").at(0, one, is_broadcast=True) == []
    said = Said("broadcast-reply", framing="rtu")
    assert said.at(0, one, is_broadcast=True) == [encode_rtu(1, bytes.fromhex(one))]
    assert said.at(0, several, is_broadcast=True) == [encode_rtu(1, bytes.fromhex(several)[:5])]
    file = "15 09 06 0001 0000 0001 1234"  # of 21 the reply is the whole request
    assert said.at(0, file, is_broadcast=True) == [encode_rtu(1, bytes.fromhex(file))]
    assert said.at(0, one) == [encode_rtu(1, bytes.fromhex(one))]
    assert said.device.holding_registers[1] == 2


@pytest.mark.parametrize(
    ("name", "framing"), [("echo", "mbap"), ("leading-zero", "mbap"), ("transaction+1", "rtu"), ("idle-close", "rtu")]
)
def test_fault_profile_strikes_only_where_it_can_be_met(name: str, framing: str) -> None:
    said = Said(name, framing=framing)
    plain = _adu() if framing == "mbap" else encode_rtu(1, REPLY)
    assert said.at(0, READ) == [plain]
    assert said.talk.deadline(0) is None
    (applied,) = said.faults
    assert applied.struck == 0


def test_fault_has_struck_what_went_otherwise_because_of_it() -> None:
    said = Said("max-block", items=10)
    for pdu in (READ, "03 0000 000B", READ, "10 0000 000B 16" + 11 * "0001"):
        said.at(0, pdu)
    (applied,) = said.faults
    assert applied.struck == 2
    late = Said("late", delay=0.0)
    late.at(0, READ)
    assert [one.struck for one in late.faults] == [0]  # a delay of nothing is no difference
    assert [one.struck for one in Said("single-client", others=1).faults] == [1]
    silent = Said("close-if-silent", seconds=1)
    silent.talk.tick(1)
    assert [one.struck for one in silent.faults] == [1]
