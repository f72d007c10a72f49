"""Values of points → requests: the function, the bits, the read before and after; and what an answer says."""

from typing import Any

import pytest

from busway.apps.collector.commands.command import CommandState
from busway.apps.collector.commands.point_write import judged, point_write, was_not_sent
from busway.codes import Table
from busway.errors import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkClosed,
    LinkDown,
    ModbusError,
    NoReply,
    Overloaded,
    UnitSuspended,
    WriteOutcomeUnknown,
)
from busway.points import Conversion, Linear, Point, ReadRules, WriteRule
from busway.points.point_rules import ItemRange
from busway.values import parse_address, value_type

H, COILS = Table.HOLDING_REGISTERS, Table.COILS
RULE = WriteRule()


def register(form: str = "uint16", *, start: int = 4, **more: Any) -> Point:
    return Point("p", H, start, value_type(form), **{"writing": RULE, **more})


@pytest.mark.parametrize(
    ("point", "value", "pdu"),
    [
        (register(), 5, "06 0004 0005"),
        (register(writing=WriteRule(function=16)), 5, "10 0004 0001 02 0005"),
        (register("uint32"), 5, "10 0004 0002 04 00000005"),
        (register("int16", conversion=Conversion(scale=0.1)), -2.5, "06 0004 ffe7"),
        (Point("c", COILS, 7, writing=RULE), True, "05 0007 ff00"),
        (Point("c", COILS, 7, writing=WriteRule(function=15)), True, "0f 0007 0001 01 01"),
        (register("bit:3", writing=WriteRule(function=22)), True, "16 0004 fff7 0008"),
        (register("bit:3", writing=WriteRule(function=22)), False, "16 0004 fff7 0000"),
        (register("field:4-7", writing=WriteRule(function=22)), 9, "16 0004 ff0f 0090"),
        (register("uint16", writing=WriteRule(function=22)), 9, "16 0004 0000 0009"),
        (register(conversion=Conversion(names={"off": 0, "auto": 4})), "auto", "06 0004 0004"),
        (register(conversion=Conversion(flags={"a": 0, "b": 15})), ["a", "b"], "06 0004 8001"),
        (register(conversion=Conversion(linear=Linear((0, 27648), (0.0, 100.0), True))), 50, "06 0004 3600"),
    ],
)
def test_a_value_becomes_the_request_that_its_rule_says(point: Point, value: Any, pdu: str) -> None:
    write = point_write(point, value, {})
    assert write.request().encode() == bytes.fromhex(pdu)
    assert (write.before, write.shown) == (None, None)


def test_a_part_of_a_register_is_written_into_what_it_holds() -> None:
    write = point_write(register("field:4-7"), 9, {})
    assert write.before is not None
    assert write.before.request.encode() == bytes.fromhex("03 0004 0001")
    assert write.request(bytes.fromhex("1234")).encode() == bytes.fromhex("06 0004 1294")
    assert write.held_value(bytes.fromhex("1234")) == 3


def test_a_scale_that_the_device_says_holds_for_what_is_written() -> None:
    point = register("int16", conversion=Conversion(scale_from="exponent"))
    assert point_write(point, 12.5, {"exponent": -1}).request().encode() == bytes.fromhex("06 0004 007d")
    with pytest.raises(InvalidRequest, match="has not been read yet"):
        point_write(point, 12.5, {})


@pytest.mark.parametrize(
    ("point", "value", "sentence"),
    [
        (register(writing=None), 1, "is only read"),
        (Point("f", H, 0, formula="a + b"), 1, "is only read"),
        (Point("i", Table.INPUT_REGISTERS, 0, value_type("uint16"), writing=RULE), 1, "Modbus cannot write"),
        (register(writing=WriteRule(function=5)), 1, "function 5 does not write"),
        (register("uint32", writing=WriteRule(function=6)), 1, "function 6 writes one"),
        (register(), 1.5, "does not fit"),
        (register(), True, "does not fit"),
        (register(), "1", "does not fit"),
        (register("int16", conversion=Conversion(invalid=(-32768,))), -32768, "stands for no value"),
        (register(conversion=Conversion(linear=Linear((0, 27648), (0.0, 100.0), True))), 125, "must be 0…100"),
        (register(conversion=Conversion(flags={"a": 0})), ["c"], "no flag"),
        (register(writing=WriteRule(on=170, off=85)), 170, "is a switch"),
        (register(writing=WriteRule(minimum=10, step=5)), 12, "steps of 5"),
        (register(writing=WriteRule(minimum=10, step=5)), 5, "must be"),
        (register("string:2"), "abc", "at most 2 bytes"),
    ],
)
def test_what_is_against_the_rule_is_no_request(point: Point, value: Any, sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        point_write(point, value, {})


def test_a_block_that_is_read_whole_is_read_whole_to_confirm_a_value() -> None:
    rules = ReadRules(exact={H: [ItemRange(0, 10)]})
    write = point_write(register("uint32", writing=WriteRule(verify="read-back")), 7, {}, rules)
    assert write.shown is not None
    assert write.shown.request.encode() == bytes.fromhex("03 0000 000a")
    reply = bytes(8) + bytes.fromhex("00000007") + bytes(8)
    assert write.shows(write.shown.own(reply))[0]
    with pytest.raises(InvalidRequest, match="4 bytes came where 20"):
        write.shown.own(bytes(4))
    coil = Point("c", COILS, 12, writing=WriteRule(verify="read-back"))
    write = point_write(coil, True, {}, ReadRules(exact={COILS: [ItemRange(0, 16)]}))
    assert write.shown is not None
    assert write.shows(write.shown.own(bytes.fromhex("0010")))[0]


@pytest.mark.parametrize("form", ["uint16", "bit:2"])
def test_what_no_read_may_touch_is_not_read_to_write_it(form: str) -> None:
    point = register(form, writing=WriteRule(verify="read-back"))
    with pytest.raises(InvalidRequest, match="no read may touch it"):
        point_write(point, True if form == "bit:2" else 1, {}, ReadRules(forbidden={H: [ItemRange(0, 5)]}))
    assert point_write(register(), 1, {}, ReadRules(forbidden={H: [ItemRange(0, 5)]})).shown is None


def test_a_value_is_looked_for_where_the_rule_says() -> None:
    point = register("float32", writing=WriteRule(verify=parse_address("3x11")))
    write = point_write(point, 21.4, {})
    assert write.shown is not None
    assert write.shown.request.encode() == bytes.fromhex("04 000a 0002")
    data = value_type("float32").encode([21.4])
    shown, found = write.shows(data)
    assert shown
    assert found.value == pytest.approx(21.4)
    switch = register(writing=WriteRule(on=170, off=85, verify=parse_address("1x3")))
    write = point_write(switch, True, {})
    assert [write.shows(bytes([bit]))[0] for bit in (1, 0)] == [True, False]


@pytest.mark.parametrize(
    ("outcome", "state", "sent"),
    [
        (object(), CommandState.DONE, True),
        (ExceptionReply(5), CommandState.DONE, True),
        (ExceptionReply(2), CommandState.FAILED, True),
        (ExceptionReply(6), CommandState.FAILED, True),
        (ExceptionReply(0x0A), CommandState.FAILED, True),
        (ExceptionReply(0x0B), CommandState.UNKNOWN, True),
        (WriteOutcomeUnknown("no answer"), CommandState.UNKNOWN, True),
        (BadReply("an echo of something else"), CommandState.UNKNOWN, True),
        (LinkDown("lost", sent=True), CommandState.UNKNOWN, True),
        (ModbusError("something else"), CommandState.UNKNOWN, True),
        (LinkDown("refused", sent=False), CommandState.FAILED, False),
        (LinkClosed("closed"), CommandState.FAILED, False),
        (NoReply("the deadline passed in the queue; nothing was sent"), CommandState.FAILED, False),
        (UnitSuspended("not asked", next_probe=1.0), CommandState.FAILED, False),
        (Overloaded("full"), CommandState.FAILED, False),
        (InvalidRequest("no such unit"), CommandState.FAILED, False),
        (ConfigError("no port"), CommandState.FAILED, False),
    ],
)
def test_only_a_reply_says_that_a_write_was_executed(outcome: object, state: CommandState, sent: bool) -> None:
    found, reason = judged(outcome)
    assert found is state
    assert ("nothing was sent" in reason) is not sent
    if isinstance(outcome, ModbusError) and not isinstance(outcome, ExceptionReply):
        assert was_not_sent(outcome) is not sent
