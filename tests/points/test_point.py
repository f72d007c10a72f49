"""What a point is, encodes and calls its values; the rules for writing, reporting, alarms."""

import math

import pytest

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.points import AlarmRule, Conversion, Point, ReportRule, WriteRule
from busway.points.decoder import decode_point
from busway.values import value_type

HOLDING = Table.HOLDING_REGISTERS


def test_a_part_of_a_register_is_written_without_touching_the_rest() -> None:
    held = bytes.fromhex("ABCD")
    for form, value, wanted in [
        ("bit:0", False, "ABCC"),
        ("bit:15", False, "2BCD"),
        ("field:4-7", 0, "AB0D"),
        ("int8:low", -1, "ABFF"),
        ("uint8:high", 1, "01CD"),
    ]:
        point = Point("p", HOLDING, 0, value_type(form))
        wire = point.encode(value, held)
        assert wire == bytes.fromhex(wanted)
        assert decode_point(point, wire).value == value
    with pytest.raises(InvalidRequest, match="16 does not fit field:4-7, which takes a whole number 0…15"):
        Point("p", HOLDING, 0, value_type("field:4-7")).encode(16, held)


def test_names_stand_for_numbers_and_flags_for_bits() -> None:
    mode = Point("mode", HOLDING, 0, value_type("uint16"), Conversion(names={"off": 0, "auto": 1}))
    assert mode.encode("auto") == b"\x00\x01"
    assert (mode.label(1), mode.label(7)) == ("auto", "")
    with pytest.raises(InvalidRequest, match="there is no 'on'; there are off, auto"):
        mode.encode("on")
    with pytest.raises(InvalidRequest, match=r"must be off \(0\), auto \(1\), not 3"):
        mode.encode(3)
    events = Point("events", HOLDING, 0, value_type("int16"), Conversion(flags={"hot": 0, "door": 15}))
    assert events.encode(["hot", "door"]) == b"\x80\x01"
    assert events.label(decode_point(events, b"\x80\x01").value) == "hot, door"


def test_a_coil_holds_a_state_and_a_computed_point_nothing() -> None:
    coil = Point("c", Table.COILS, 3)
    assert (coil.encode(True), decode_point(coil, b"\x01").value, coil.type, str(coil.address)) == (
        b"\x01",
        True,
        "bit",
        "0x4",
    )
    with pytest.raises(InvalidRequest, match="one bit is true or false, not 1"):
        coil.encode(1)
    computed = Point("sum", HOLDING, 0, formula="a + b")
    assert computed.width == 0
    with pytest.raises(InvalidRequest, match="sum is computed"):
        computed.encode(1.0)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_what_is_no_number_is_refused_where_raw_numbers_are_whole(value: float) -> None:
    with pytest.raises(InvalidRequest):
        Point("p", HOLDING, 0, value_type("int16"), Conversion(0.1)).encode(value)


@pytest.mark.parametrize("name", ["int16", "float32", "float64"])
def test_a_number_of_hundreds_of_digits_is_refused_where_there_is_a_scale(name: str) -> None:
    with pytest.raises(InvalidRequest, match=r"^1000.*…"):
        Point("p", HOLDING, 0, value_type(name), Conversion(0.1)).encode(10**400)


def test_a_write_keeps_to_its_range_and_its_steps() -> None:
    rule = WriteRule(minimum=5.0, maximum=30.0, step=0.5)
    for value in (5.0, 21.5, 30.0):
        rule.check(value)
    with pytest.raises(InvalidRequest, match=r"must be 5…30, not 30\.5"):
        rule.check(30.5)
    with pytest.raises(InvalidRequest, match=r"must be a whole number of steps of 0\.5 from 5 on, not 21\.3"):
        rule.check(21.3)
    with pytest.raises(InvalidRequest):
        rule.check(math.nan)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_finite_number_is_no_number_of_steps(value: float) -> None:
    with pytest.raises(InvalidRequest, match=f"must be a whole number of steps of 0.5 from 0 on, not {value}"):
        WriteRule(step=0.5).check(value)


@pytest.mark.parametrize(
    ("value", "step", "low"),
    [
        (1_000_000.5, 1, None),  # half a step, also where a share of all steps is more than that
        (8_388_607.5, 1, None),  # a number of 32 bits, as are the next two
        (2_000_000.25, 0.5, None),
        (-524_288.03125, 0.0625, None),
        (2**60 + 1, 2, None),  # floats do not tell it from 2**60
        (float(2**52 + 1), 2, None),
        (1_000_000_000.5, 1, 1_000_000_000),
    ],
)
def test_a_value_between_two_steps_is_refused_however_large_it_is(value: float, step: float, low: float | None) -> None:
    with pytest.raises(InvalidRequest, match="must be a whole number of steps"):
        WriteRule(minimum=low, step=step).check(value)


@pytest.mark.parametrize("value", [0.1 + 0.2, 0.30000001192092896, 1e6, 123456.7, 1e15 + 0.1, 1e300, -0.7])
def test_the_error_of_a_binary_fraction_is_no_part_of_a_step(value: float) -> None:
    WriteRule(step=0.1).check(value)


@pytest.mark.parametrize(
    ("value", "scale"), [(100_000.05, 0.1), (1234.5009, 0.1), (2**30 + 1, 2.0), (150_000.75, 0.5), (9_000_000.05, 0.1)]
)
def test_a_value_between_two_raw_numbers_is_refused_however_large_it_is(value: float, scale: float) -> None:
    with pytest.raises(InvalidRequest, match="is no whole number of steps"):
        Point("p", HOLDING, 0, value_type("int64"), Conversion(scale)).encode(value)


@pytest.mark.parametrize(("value", "raw"), [(0.1 + 0.2, 3), (18.299999237060547, 183), (1e15 + 0.1, 10**16 + 1)])
def test_the_error_of_a_binary_fraction_changes_no_raw_number(value: float, raw: int) -> None:
    assert Point("p", HOLDING, 0, value_type("int64"), Conversion(0.1)).encode(value) == raw.to_bytes(8, "big")


def test_reports_follow_the_deadband_and_end_a_silence() -> None:
    change = ReportRule("change", deadband=0.5)
    assert [change.is_due(10.0, now, 1e9) for now in (10.5, 10.6, 9.4)] == [False, True, True]
    percent = ReportRule("change", deadband=10.0, percent=True, max_silence=60.0)
    assert [percent.is_due(-200.0, now, 0.0) for now in (-219.0, -221.0)] == [False, True]
    assert (percent.is_due(5.0, 5.0, 59.0), percent.is_due(5.0, 5.0, 60.0)) == (False, True)
    assert percent.is_due(5.0, 5.0, -3600.0), "the clock was set back: how long it was silent is not known"
    assert not change.is_due(5.0, 5.0, -3600.0)
    assert change.is_due(False, True, 0.0)
    assert change.is_due(1.0, math.nan, 0.0)
    assert change.is_due("a", "b", 0.0)
    either = ReportRule("change_or_period", period=10.0)
    assert (either.is_due(1, 1, 9.9), either.is_due(1, 1, 10.0), either.is_due(1, 2, 0.0)) == (False, True, True)


def test_an_alarm_ends_where_its_hysteresis_says() -> None:
    high, low = AlarmRule("H", 80.0, hysteresis=5.0), AlarmRule("LL", 2.0, hysteresis=1.0)
    assert [high.is_beyond(each, active=False) for each in (80.0, 80.1)] == [False, True]
    assert [high.is_beyond(each, active=True) for each in (75.1, 75.0)] == [True, False]
    assert [low.is_beyond(each, active=True) for each in (2.9, 3.0)] == [True, False]
