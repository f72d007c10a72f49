"""Reads that a handler hands on: the stream is cut as ever, each has its slot, and each is answered once."""

import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.framing.mbap import MbapReceiver, encode_mbap
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.forwarded_reads import ForwardedReads, PreparedForward, PreparedForwards, ReadForwarder
from busway.session.responder import ClientIdentity, RequestContext, ResponderAnswer, ServedUnit
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

UNITS = 3
NOT_HANDED_ON = 100
"""Reads of this address go the generic path."""


def data_of(unit: int, address: int, count: int) -> bytes:
    return struct.pack(f">{count}H", *(unit * 1000 + address + n for n in range(count)))


class Target:
    """Where the reads of a unit go: nowhere, until the test answers them."""

    def __init__(self, unit: int) -> None:
        self.unit = unit
        self.asked: list[tuple[ForwardedReads, bytes, PreparedForward]] = []
        self.batch_sizes: list[int] = []
        self.gone: list[ForwardedReads] = []

    def ask(self, asker: ForwardedReads, transactions: Sequence[bytes], forwards: Sequence[PreparedForward]) -> None:
        self.batch_sizes.append(len(forwards))
        self.asked += [(asker, *read) for read in zip(transactions, forwards, strict=True)]
        asker.batches[self] = None

    def owed(self, asker: ForwardedReads) -> list[PreparedForward]:
        return [forward for one, _, forward in self.asked if one is asker]

    def asker_gone(self, asker: ForwardedReads) -> None:
        self.gone.append(asker)

    def answer(self) -> None:
        askers = dict.fromkeys(asker for asker, _, _ in self.asked)
        for asker in askers:
            transactions = [transaction for one, transaction, _ in self.asked if one is asker]
            forwards = self.owed(asker)
            requests: list[Any] = [forward.requests[0] for forward in forwards]
            asker.answer(transactions, forwards, [data_of(self.unit, one.address, one.count) for one in requests])
            asker.send()
        self.asked.clear()


class GenericPathOnly:
    """Answers everything at once, or what it is told to only later."""

    functions = STANDARD
    generation = 0

    def __init__(self) -> None:
        self.handled: list[int] = []
        self.later: list[RequestContext] = []

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        self.handled.append(context.function)
        if isinstance(request, ReadHoldingRegisters):
            return request.Reply(data_of(context.unit, request.address, request.count))
        return ExceptionResponse(context.function, 1)


class HandingOn(GenericPathOnly):
    """Hands on reads of holding registers."""

    def __init__(self) -> None:
        super().__init__()
        self.targets = {unit: Target(unit) for unit in range(1, UNITS + 1)}
        self.prepared = 0

    def prepared_forward(self, context: RequestContext, pdu: bytes) -> PreparedForward | None:
        self.prepared += 1
        request = STANDARD.decode_request(pdu)
        if not isinstance(request, ReadHoldingRegisters) or request.address == NOT_HANDED_ON:
            return None
        request.prepare()
        return PreparedForward(self.targets[context.unit], context.unit, request)

    def give(self) -> None:
        for target in self.targets.values():
            target.answer()


class Client:
    def __init__(self, handler: GenericPathOnly, slots: int = 16) -> None:
        self.slots = ServerTransactionSlots(slots)
        self.diagnostics = LineDiagnostics()
        self.out: list[bytes] = []
        self.session = TcpServerSession(
            RequestPipeline(handler),
            diagnostics=self.diagnostics,
            slots=self.slots,
            deliver=self.out.append,
            client=ClientIdentity(peer="client"),
        )

    def send(self, stream: bytes) -> None:
        self.out += self.session.receive(bytearray(stream), len(stream))

    def got(self) -> dict[int, bytes]:
        frames = MbapReceiver().receive(b"".join(self.out))
        self.out.clear()
        found = {frame.transaction: bytes((frame.unit,)) + frame.pdu for frame in frames}
        assert len(found) == len(frames)
        return found


def read(transaction: int, address: int = 0, count: int = 1, unit: int = 1) -> bytes:
    return encode_mbap(transaction, unit, struct.pack(">BHH", 3, address, count))


FRAMES = st.one_of(
    st.builds(
        lambda address, count, unit: (unit, struct.pack(">BHH", 3, address, count)),
        st.sampled_from([0, 1, 2, NOT_HANDED_ON]),
        st.sampled_from([0, 1, 2, 125, 126]),
        st.integers(1, UNITS),
    ),
    st.builds(
        lambda pdu: (1, pdu), st.sampled_from([b"\x06\0\1\0\2", b"\x03\0", b"\x03\0\0\0\1\0", b"\x41ab", b"\x83\2"])
    ),
)


class HandingOnSome(HandingOn):
    """Has a device of its own beside those that reads are handed on to."""

    own = DeviceResponder({UNITS + 1: Device(holding_registers=[7])})

    def serves(self, unit: int) -> ServedUnit | None:
        return self.own.serves(unit) if unit == UNITS + 1 else ServedUnit(unit)


def test_reads_that_are_prepared_and_reads_that_are_handed_on_are_answered_once_whichever_come_first() -> None:
    handler = HandingOnSome()
    client = Client(handler)
    units = (UNITS + 1, 1)
    for first in (0, 1, 0, 1):  # once they are met for the first time, then they are known
        client.send(read(10, unit=units[first]) + read(11, unit=units[1 - first]))
        handler.give()
        own = b"\x04\x03\x02\0\x07"
        assert client.got() == {10 + first: own, 11 - first: b"\x01\x03\x02" + data_of(1, 0, 1)}
    assert client.session.requests == client.diagnostics.counters.server_message_count == 8


@settings(max_examples=examples(150))
@given(st.lists(FRAMES, min_size=1, max_size=12), st.lists(st.integers(0, 200), max_size=5))
def test_however_the_stream_is_cut_the_answers_are_those_of_the_generic_path(
    frames: list[tuple[int, bytes]], cuts: list[int]
) -> None:
    stream = b"".join(encode_mbap(number, unit, pdu) for number, (unit, pdu) in enumerate(frames))
    found = []
    for handler in (GenericPathOnly(), HandingOn()):
        client = Client(handler)
        for _ in range(2):  # once they are met for the first time, then they are known
            edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
            for begin, end in pairwise(edges):
                client.send(stream[begin:end])
            if isinstance(handler, HandingOn):
                handler.give()
            found.append(client.got())
        counters = client.diagnostics.counters
        found.append((client.session.requests, client.session.discarded, counters))  # type: ignore[arg-type]
        assert (client.slots.used, client.session.waiting) == (0, 0)
    assert found[:3] == found[3:]


def test_reads_that_came_together_go_on_together_each_unit_by_itself() -> None:
    handler = HandingOn()
    client = Client(handler)
    stream = read(1) + read(2, 5) + read(3, unit=2) + read(4, 7) + read(5, unit=2)
    client.send(stream)
    handler.give()
    for target in handler.targets.values():
        target.batch_sizes.clear()
    client.send(stream)
    assert (handler.targets[1].batch_sizes, handler.targets[2].batch_sizes) == ([3], [2])
    assert client.session.waiting == client.slots.used == 5
    assert handler.prepared == 4


def test_reads_of_several_units_with_one_target_go_on_together_and_count_for_the_unit_that_was_named() -> None:
    handler = HandingOn()
    handler.targets = dict.fromkeys((1, 2, 3), handler.targets[1])
    client = Client(handler)
    stream = read(1) + read(2, unit=2) + read(3, unit=3) + read(4, unit=2)
    for _ in range(2):
        handler.targets[1].batch_sizes.clear()
        client.send(stream)
        handler.targets[1].answer()
    assert handler.targets[1].batch_sizes == [4]
    assert dict(client.diagnostics.arrived) == dict(client.diagnostics.departed) == {1: 2, 2: 4, 3: 2}


def test_what_is_no_read_to_hand_on_is_asked_about_once() -> None:
    handler = HandingOn()
    client = Client(handler)
    for number in range(3):
        client.send(read(number, NOT_HANDED_ON))
    assert (handler.prepared, handler.handled) == (1, [3, 3, 3])


def test_without_a_slot_a_read_takes_the_generic_path_which_says_06() -> None:
    handler = HandingOn()
    client = Client(handler, slots=2)
    client.send(read(1) + read(2) + read(3))
    assert client.got() == {3: bytes((1, 0x83, 6))}
    handler.give()
    assert list(client.got()) == [1, 2]
    assert client.session.refused_busy == 1


def test_a_refusal_names_function_and_unit_and_is_counted() -> None:
    handler = HandingOn()
    client = Client(handler)
    client.send(read(1, unit=2))
    ((asker, transaction, forward),) = handler.targets[2].asked
    asker.refuse(transaction, forward, 0x0B)
    asker.send()
    assert client.got() == {1: bytes((2, 0x83, 0x0B))}
    assert client.diagnostics.counters.bus_exception_error_count == 1
    assert (client.slots.used, client.session.waiting) == (0, 0)


def test_when_the_connection_ends_targets_that_work_for_it_are_informed_and_nothing_is_sent_any_more() -> None:
    handler = HandingOn()
    client = Client(handler)
    client.send(read(1) + read(2))
    client.session.close()
    target = handler.targets[1]
    assert target.gone == [target.asked[0][0]]
    assert (client.slots.used, client.session.waiting) == (0, 0)
    assert client.diagnostics.counters.server_no_response_count == 2
    handler.give()
    target.gone[0].refuse(b"\0\1", next(iter(client.session._fast.forwards.known.values())), 4)
    target.gone[0].send()
    assert not client.out


def test_a_new_generation_asks_anew_what_becomes_of_reads() -> None:
    handler = HandingOn()
    client = Client(handler)
    client.send(read(1))
    client.send(read(2))
    assert handler.prepared == 1
    handler.generation += 1
    client.send(read(3))
    assert handler.prepared == 2


@pytest.mark.parametrize("known", [True, False])
def test_what_is_kept_of_reads_is_bounded(known: bool) -> None:
    forwards = PreparedForwards()
    request = ReadHoldingRegisters(0, 1)
    request.prepare()
    forward = PreparedForward(Target(1), 1, request) if known else None
    for number in range(10_000):
        forwards.learn(number.to_bytes(10, "big"), forward)
    assert number.to_bytes(10, "big") in forwards
    assert len(forwards.known) + len(forwards.others) <= 4096


def test_who_hands_reads_on_is_told_from_who_does_not() -> None:
    assert isinstance(HandingOn(), ReadForwarder)
    assert not isinstance(GenericPathOnly(), ReadForwarder)
