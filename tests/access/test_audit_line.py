"""Lines of the audit log: valid JSON for every kind of request, whatever names peers and rules have."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import any_request

from busway.access.audit_line import audit_line, outcome_of
from busway.access.audit_log import WallClock
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.file_records import FileData, FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.functions import STANDARD
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteSingleCoil,
)
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import SILENCE, ClientIdentity, Judged, RequestContext


def line(request, replaced=None, *, outcome="done", code=None, rule="default", who=("10.0.0.7:1", None, "")):
    function = request.code if hasattr(request, "code") and isinstance(request.code, int) else 0
    peer, role, listener = who
    client = ClientIdentity(peer=peer, role=role, listener=listener)
    context = RequestContext(unit=5, function=function, diagnostics=CommunicationState(), client=client)
    context.judged = Judged(rule)
    context.judged.replaced = replaced
    text = audit_line(context, request, "now", outcome, code)
    assert text.endswith("}\n")
    assert text.isascii()
    assert text.count("\n") == 1
    return json.loads(text)


@pytest.mark.parametrize(
    ("request_", "replaced", "facts"),
    [
        (WriteSingleCoil(7, 0xFF00), (b"\x00",), {"function": 5, "address": 7, "count": 1, "old": [0], "new": [1]}),
        (
            WriteMultipleCoils.of(0, [True, False, True]),
            (b"\x02",),
            {"function": 15, "count": 3, "old": [0, 1, 0], "new": [1, 0, 1]},
        ),
        (
            ReadWriteMultipleRegisters.of(9, 5, 2, [8, 9]),
            (b"\x00\x01\x00\x02",),
            {"function": 23, "address": 2, "count": 2, "old": [1, 2], "new": [8, 9]},
        ),
        (
            MaskWriteRegister(4, 0xFF00, 0x0012),
            (b"\xab\xcd",),
            {"old": [0xABCD], "new": [0xAB12], "masks": [0xFF00, 0x12]},
        ),
        (MaskWriteRegister(4, 0xFF00, 0x0012), None, {"old": None, "new": None, "masks": [0xFF00, 0x12]}),
        (
            WriteFileRecord((FileData(4, 1, b"\x00\x01"), FileData(5, 0, b"\x00\x02\x00\x03"))),
            (b"\x00\x07", b"\x00\x08\x00\x09"),
            {"records": [[4, 1, 1], [5, 0, 2]], "count": 3, "old": [7, 8, 9], "new": [1, 2, 3]},
        ),
        (
            WriteFileRecord((FileData(4, 1, b"\x00\x01"), FileData(5, 0, b"\x00\x02"))),
            (b"\x00\x07", None),
            {"old": None, "new": [1, 2]},
        ),
        (ReadFileRecord((FileReference(4, 1, 2),)), None, {"function": 20, "records": [[4, 1, 2]], "new": None}),
        (STANDARD.decode_request(b"\x08\x00\x0a\x00\x00"), (), {"function": 8, "sub_function": 10, "data": "0000"}),
        (STANDARD.decode_request(b"\x64\x01\x02"), None, {"function": 100, "data": "0102", "address": None}),
        (STANDARD.decode_request(b"\x06\x01"), None, {"function": 6, "data": "01", "new": None}),
    ],
)
def test_a_line_says_what_was_written_where(request_, replaced, facts):
    found = line(request_, replaced)
    assert {key: found[key] for key in facts} == facts


@given(any_request())
def test_every_request_gives_a_valid_line(request_):
    found = line(request_)
    assert found["function"] == request_.encode()[0]


@given(st.text(), st.one_of(st.none(), st.text()), st.text(), st.text())
def test_no_name_breaks_a_line(peer, role, listener, rule):
    found = line(WriteSingleCoil(7, 0), who=(peer, role, listener), rule=rule)
    assert (found["peer"], found["role"], found["listener"], found["rule"]) == (peer, role, listener, rule)


def test_outcomes():
    assert outcome_of(ExceptionResponse(6, 2)) == ("exception", 2)
    assert outcome_of(WriteSingleCoil(7, 0)) == ("done", None)
    assert outcome_of(SILENCE) == ("no answer", None)
    assert outcome_of(None) == ("no answer", None)


def test_the_clock_keeps_its_text_for_a_second_and_no_longer():
    now = [1_772_366_399.999]
    clock = WallClock(lambda: now[0])
    first = clock()
    now[0] += 0.001
    assert (first, clock()) == ("2026-03-01T11:59:59.999Z", "2026-03-01T12:00:00.000Z")


@given(
    st.lists(
        st.one_of(
            st.floats(1_772_366_399.99, 1_772_366_400.01),
            st.integers(-5000, 5000).map(lambda microseconds: 1_772_366_400 + microseconds / 1e6),
            st.integers(-50, 50).map(lambda milliseconds: 1_772_366_400 + milliseconds / 1000),
        ),
        max_size=30,
    )
)
def test_the_clock_says_of_each_time_what_a_new_one_would_say_forwards_and_backwards(times):
    now = [0.0]
    clock = WallClock(lambda: now[0])
    for now[0] in times:
        assert clock() == WallClock(lambda: now[0])()


@given(st.data())
def test_bits_are_told_one_by_one_as_far_as_there_are_any(data):
    bits = data.draw(st.lists(st.booleans(), min_size=1, max_size=40))
    packed = WriteMultipleCoils.of(0, bits).data
    found = line(WriteMultipleCoils.of(0, bits), (packed,))
    assert found["old"] == found["new"] == [int(bit) for bit in bits]
