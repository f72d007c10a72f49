"""Keys of decisions: what has the same key is decided alike."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import any_request

from busway.access.decisions import decision_key
from busway.access.question import Question
from busway.pdu.file_records import FileReference, ReadFileRecord
from busway.pdu.functions import STANDARD
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)

near = st.integers(0, 1)
requests = st.one_of(
    st.builds(ReadCoils, near, st.integers(1, 2)),
    st.builds(ReadHoldingRegisters, near, st.integers(1, 2)),
    st.builds(WriteSingleCoil, near, st.sampled_from([0, 0xFF00])),
    st.builds(WriteSingleRegister, near, near),
    st.builds(WriteMultipleCoils.of, near, st.lists(st.booleans(), min_size=1, max_size=2)),
    st.builds(WriteMultipleRegisters.of, near, st.lists(near, min_size=1, max_size=2)),
    st.builds(MaskWriteRegister, near, near, near),
    st.builds(ReadWriteMultipleRegisters.of, near, st.integers(1, 2), near, st.lists(near, min_size=1, max_size=2)),
    any_request(),
)


@given(requests, requests, near, near, st.booleans())
def test_requests_of_one_key_ask_the_same_question(one, other, unit, second, limits):
    key = decision_key(one, unit, None, limits=limits)
    same = decision_key(other, second, None, limits=limits)
    if key is None or key != same:
        return
    asked, again = Question.of(one, unit=unit), Question.of(other, unit=second)
    assert asked.unit == again.unit
    assert (asked.function, asked.sub_function, asked.pieces) == (again.function, again.sub_function, again.pieces)
    if limits:
        assert (asked.written, asked.masks) == (again.written, again.masks) == (None, None)


@pytest.mark.parametrize(
    "request_",
    [WriteSingleRegister(1, 2), WriteMultipleRegisters.of(1, [2]), MaskWriteRegister(1, 2, 3)],
)
def test_where_there_are_limits_what_writes_registers_is_decided_each_time(request_):
    assert decision_key(request_, 1, None, limits=True) is None
    assert decision_key(request_, 1, None, limits=False) is not None
    assert decision_key(request_, 1, None, limits=False) != decision_key(request_, 1, 3, limits=False)


@pytest.mark.parametrize(
    "request_",
    [
        ReadFileRecord((FileReference(4, 1, 2),)),
        STANDARD.decode_request(b"\x06\x01"),
        STANDARD.decode_request(b"\x64\x01"),
        STANDARD.decode_request(b"\x08\x00\x0a\x00\x00"),
    ],
)
def test_what_is_rare_or_not_understood_is_decided_each_time(request_):
    assert decision_key(request_, 1, None, limits=False) is None
