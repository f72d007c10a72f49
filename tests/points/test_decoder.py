"""What a reply says: every type and order against an independent decoder, whatever else stands in the read."""

import math
import struct
from fractions import Fraction
from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.points import Conversion, Linear, Point, Quality, Reason
from busway.points.decoder import ReadDecoder, decode_point
from busway.values import ORDERS, value_type

HOLDING = Table.HOLDING_REGISTERS
LETTERS = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
LETTERS |= {"float16": "e", "float32": "f", "float64": "d"}
NUMBERS = (*LETTERS, "int48", "uint48")


def slow(data: bytes, name: str, order: str) -> Any:
    """One number, byte by byte from the letters of the order; nothing here comes from the package."""
    size = len(order)
    value = bytearray(size)
    for place, letter in enumerate(order):
        value["ABCDEFGH".index(letter)] = data[place]
    if name.endswith("48"):
        return int.from_bytes(value, "big", signed=name.startswith("int"))
    return struct.unpack(">" + LETTERS[name], value)[0]


@st.composite
def layouts(draw: st.DrawFn) -> tuple[list[Point], int, int, bytes, bool]:
    """Points of all types and orders in one read, with gaps, or on top of each other; and what the reply holds."""
    start, overlapping = draw(st.integers(0, 500)), draw(st.booleans())
    points, at, end = [], start, start
    for index in range(draw(st.integers(1, 12))):
        name = draw(st.sampled_from(NUMBERS))
        form = value_type(name, draw(st.sampled_from(ORDERS[int(name[-2:])])))
        where = start + draw(st.integers(0, 40)) if overlapping else at + draw(st.sampled_from([0, 0, 1, 5]))
        points.append(Point(f"p{index}", HOLDING, where, form))
        at = where + form.registers
        end = max(end, at)
    count = end - start + draw(st.integers(0, 3))
    data = draw(st.binary(min_size=2 * count, max_size=2 * count))
    shuffled = draw(st.booleans())
    return (draw(st.permutations(points)) if shuffled else points), start, count, data, overlapping


@settings(max_examples=examples(300), deadline=None)
@given(layouts())
def test_a_read_gives_what_an_independent_decoder_gives(drawn: tuple[list[Point], int, int, bytes, bool]) -> None:
    points, start, count, data, _ = drawn
    found = ReadDecoder(points, HOLDING, start, count).decode(data)
    for place, point in enumerate(points):
        assert point.form is not None
        first = 2 * (point.start - start)
        wanted = slow(data[first : first + 2 * point.width], point.form.name, point.form.order)
        if wanted != wanted:
            assert found.values[place] is None
            assert found.flaws[place] == Reason.NOT_A_NUMBER
        else:
            assert found.values[place] == wanted
            assert type(found.values[place]) is type(wanted)
            assert place not in found.flaws


@pytest.mark.parametrize("name", NUMBERS)
@given(data=st.data())
@settings(max_examples=examples(40), deadline=None)
def test_what_was_encoded_is_decoded_in_every_order(name: str, data: st.DataObject) -> None:
    form = value_type(name, data.draw(st.sampled_from(ORDERS[int(name[-2:])])))
    if name.startswith("float"):
        value: Any = data.draw(st.floats(width=int(name[5:]), allow_nan=False))  # type: ignore[arg-type]
    else:
        low, high = (0, 1) if name.startswith("u") else (-1, 1)
        bits = int(name[-2:]) - (low < 0)
        value = data.draw(st.integers(low * 2**bits, high * 2**bits - 1))
    point = Point("p", HOLDING, 7, form)
    wire = point.encode(value)
    assert slow(wire, name, form.order) == value
    assert decode_point(point, wire).value == value


@given(
    raw=st.integers(-32768, 32767),
    scale=st.sampled_from([0.1, 0.01, 0.001, 0.5, 2.0, 10.0, -0.1, 0.25, 1e-6]),
    offset=st.sampled_from([0.0, -40.0, 273.15, 0.1]),
)
@settings(deadline=None)
def test_a_scaled_value_is_the_nearest_float_to_the_exact_decimal_and_comes_back(
    raw: int, scale: float, offset: float
) -> None:
    point = Point("p", HOLDING, 0, value_type("int16"), Conversion(scale, offset))
    wire = raw.to_bytes(2, "big", signed=True)
    value = decode_point(point, wire).value
    exact = raw * Fraction(repr(scale)) + Fraction(repr(offset))
    assert value == exact.numerator / exact.denominator == point.value(raw)
    assert point.encode(value) == wire


def test_183_tenths_are_18_3_and_nothing_beside_it() -> None:
    point = Point("p", HOLDING, 0, value_type("uint16"), Conversion(0.1))
    assert repr(decode_point(point, b"\x00\xb7").value) == "18.3"


def test_a_linear_range_is_mapped_and_clamped() -> None:
    linear = Linear((0, 27_648), (0.0, 100.0), clamp=True)
    point = Point("p", HOLDING, 0, value_type("int16"), Conversion(linear=linear))
    values = [decode_point(point, raw.to_bytes(2, "big", signed=True)).value for raw in (0, 13_824, 27_648, 30_000, -5)]
    assert values == [0.0, 50.0, 100.0, 100.0, 0.0]
    assert point.encode(50.0) == (13_824).to_bytes(2, "big")
    with pytest.raises(InvalidRequest, match="no whole number of steps"):
        point.encode(50.001)


def test_a_pattern_that_stands_for_no_value_is_bad_of_signed_types_too() -> None:
    form = value_type("int16")
    for written in (0x8000, -32768):
        point = Point("p", HOLDING, 0, form, Conversion(0.1, invalid=(written,)))
        found = decode_point(point, b"\x80\x00")
        assert (found.value, found.quality, found.reason) == (None, Quality.BAD, Reason.NO_VALUE)
        assert decode_point(point, b"\x80\x01").value == -3276.7
    several = Point("p", HOLDING, 0, value_type("uint16"), Conversion(invalid=(0xFFFF, 0xFFFE)))
    assert [decode_point(several, each).value for each in (b"\xff\xff", b"\xff\xfe", b"\xff\xfd")] == [
        None,
        None,
        65533,
    ]


def test_a_float_that_stands_for_no_value_is_met_as_near_as_its_type_comes() -> None:
    point = Point("p", HOLDING, 0, value_type("float32"), Conversion(invalid=(-9999.9,)))
    assert decode_point(point, struct.pack(">f", -9999.9)).quality is Quality.BAD
    assert decode_point(point, struct.pack(">f", math.nan)).reason == Reason.NOT_A_NUMBER
    assert decode_point(point, struct.pack(">f", math.inf)).value == math.inf


def test_a_value_outside_its_valid_range_is_kept_and_uncertain() -> None:
    point = Point("p", HOLDING, 0, value_type("int16"), Conversion(0.1, valid=(-40.0, 85.0)))
    found = [decode_point(point, raw.to_bytes(2, "big", signed=True)) for raw in (-401, -400, 850, 851)]
    assert [(each.value, each.quality.label) for each in found] == [
        (-40.1, "uncertain"),
        (-40.0, "good"),
        (85.0, "good"),
        (85.1, "uncertain"),
    ]
    assert found[0].reason == Reason.OUT_OF_RANGE


def test_a_scale_factor_of_the_same_read_holds_whether_it_comes_before_or_after() -> None:
    power = Point("W", HOLDING, 0, value_type("int16"), Conversion(scale_from="W_SF"))
    factor = Point("W_SF", HOLDING, 1, value_type("int16"), Conversion(invalid=(0x8000,)))
    decoder = ReadDecoder([power, factor], HOLDING, 0, 2)
    known: dict[str, int] = {}
    assert decoder.decode(bytes.fromhex("04d2 ffff"), known).values == [123.4, -1]
    assert known == {"W_SF": -1}
    assert decoder.decode(bytes.fromhex("04d2 0002"), known).values == [123_400.0, 2]
    bad = decoder.decode(bytes.fromhex("04d2 8000"), known)
    assert bad.values == [None, None]
    assert bad.flaws == {0: Reason.NO_SCALE_FACTOR, 1: Reason.NO_VALUE}
    assert known == {}


def test_a_scale_factor_of_another_read_holds_from_then_on_and_absurd_ones_do_not() -> None:
    power = Point("W", HOLDING, 0, value_type("int16"), Conversion(scale_from="W_SF"))
    decoder = ReadDecoder([power], HOLDING, 0, 1)
    assert decoder.decode(b"\x00\x07").flaws == {0: Reason.NO_SCALE_FACTOR}
    assert decoder.decode(b"\x00\x07", {"W_SF": 3}).values == [7000.0]
    assert decoder.decode(b"\x00\x07", {"W_SF": 11}).values == [None]


def test_a_scale_factor_that_another_read_needs_is_remembered() -> None:
    factor = Point("W_SF", HOLDING, 1, value_type("int16"), is_exponent=True)
    known: dict[str, int] = {}
    ReadDecoder([factor], HOLDING, 1, 1).decode(b"\xff\xfe", known)
    assert known == {"W_SF": -2}


def test_bits_and_fields_of_one_register_and_points_on_top_of_each_other() -> None:
    forms = {
        "word": "uint16",
        "b3": "bit:3",
        "b15": "bit:15",
        "mid": "field:4-7",
        "low": "int8:low",
        "high": "uint8:high",
    }
    points = [Point(name, HOLDING, 10, value_type(form)) for name, form in forms.items()]
    points += [
        Point("both", HOLDING, 10, value_type("uint32")),
        Point("swapped", HOLDING, 10, value_type("bit:3", "BA")),
    ]
    found = ReadDecoder(points, HOLDING, 10, 2).decode(bytes.fromhex("88F8 0001"))
    assert found.values == [0x88F8, True, True, 0xF, -8, 0x88, 0x88F80001, True]
    assert [type(each) for each in found.values[1:3]] == [bool, bool]


@given(data=st.binary(min_size=9, max_size=9), places=st.lists(st.integers(0, 65), max_size=70))
def test_bits_of_a_reply_are_those_that_the_specification_counts(data: bytes, places: list[int]) -> None:
    points = [Point(f"p{index}", Table.COILS, 100 + place) for index, place in enumerate(places)]
    found = ReadDecoder(points, Table.COILS, 100, 66).decode(data)
    number = int.from_bytes(data, "little")
    assert found.values == [bool(number >> place & 1) for place in places]


@pytest.mark.parametrize(
    ("type", "value"),
    [
        ("string:6", "abc"),
        ("string:5:low", "abc"),
        ("string:5:high", "abc"),
        ("bcd32", 12345678),
        ("ipv4", "192.168.1.20"),
        ("ipv6", "2001:db8::1"),
        ("eui48", "00:1B:44:11:3A:B7"),
        ("eui64", "00:1B:44:FF:FE:11:3A:B7"),
        ("custom:>hHl", (-1, 2, -3)),
        ("bits", (True,) + (False,) * 15),
    ],
)
def test_types_without_a_letter_of_struct_come_back_beside_numbers(type: str, value: object) -> None:
    form = value_type(type)
    points = [Point("before", HOLDING, 0), Point("it", HOLDING, 1, form), Point("after", HOLDING, 1 + form.registers)]
    points = [
        point if point.form else Point(point.name, HOLDING, point.start, value_type("uint16")) for point in points
    ]
    wire = b"\x00\x01" + points[1].encode(value) + b"\x00\x02"
    assert ReadDecoder(points, HOLDING, 0, 2 + form.registers).decode(wire).values == [1, value, 2]


@pytest.mark.parametrize(
    ("type", "registers", "value"),
    [
        ("ipv4", "C000 0201", "192.0.2.1"),  # RFC 791: the first number is the high octet
        ("ipv4", "0000 0000", "0.0.0.0"),
        ("ipv6", "2001 0DB8 0000 0000 0000 0000 0000 0001", "2001:db8::1"),  # RFC 4291 §2.2: each group is 16 bits
        ("ipv6", "FE80 0000 0000 0000 021B 44FF FE11 3AB7", "fe80::21b:44ff:fe11:3ab7"),
        ("eui48", "001B 4411 3AB7", "00:1B:44:11:3A:B7"),  # IEEE 802: octets as they are written, the OUI first
        ("eui64", "001B 44FF FE11 3AB7", "00:1B:44:FF:FE:11:3A:B7"),
    ],
)
def test_addresses_of_networks_have_the_octets_of_their_definition(type: str, registers: str, value: str) -> None:
    point = Point("it", HOLDING, 0, value_type(type))
    wire = bytes.fromhex(registers)
    assert point.encode(value) == wire
    assert ReadDecoder([point], HOLDING, 0, len(wire) // 2).decode(wire).values == [value]


def test_a_number_in_bcd_is_an_exponent_for_others_and_is_scaled_by_them() -> None:
    points = [
        Point("power", HOLDING, 0, value_type("bcd16"), Conversion(scale_from="factor", valid=(0, 100))),
        Point("factor", HOLDING, 1, value_type("bcd16"), is_exponent=True),
    ]
    decoder = ReadDecoder(points, HOLDING, 0, 2)
    known: dict[str, int] = {}
    found = decoder.decode(bytes.fromhex("0055 0001"), known)
    assert (found.values, found.flaws, known) == ([550.0, 1], {0: Reason.OUT_OF_RANGE}, {"factor": 1})
    found = decoder.decode(bytes.fromhex("0055 00FA"), known)
    assert (found.values, known) == ([None, None], {})
    assert found.flaws == {0: Reason.NO_SCALE_FACTOR, 1: Reason.MEANINGLESS}


def test_bytes_that_mean_nothing_in_a_type_spoil_that_point_alone() -> None:
    points = [Point("a", HOLDING, 0, value_type("bcd16")), Point("b", HOLDING, 1, value_type("uint16"))]
    found = ReadDecoder(points, HOLDING, 0, 2).decode(bytes.fromhex("00FA 0007"))
    assert found.values == [None, 7]
    assert found.flaws == {0: Reason.MEANINGLESS}


def test_a_reply_of_another_length_and_a_point_outside_the_read_are_refused() -> None:
    point = Point("level", HOLDING, 5, value_type("float32"))
    for start, count in ((6, 3), (0, 6)):
        with pytest.raises(
            InvalidRequest, match=f"level does not lie within {count} holding registers from {start} on"
        ):
            ReadDecoder([point], HOLDING, start, count)
    with pytest.raises(InvalidRequest, match="8 bytes, but 6 are needed for 3 holding registers"):
        ReadDecoder([point], HOLDING, 4, 3).decode(bytes(8))


def test_names_of_points_are_never_source() -> None:
    """Names come from files of others: a decoder is generated, and must not run what stands in them."""
    name = 'x"] or __import__("os").abort() or known["'
    points = [
        Point("v", HOLDING, 0, value_type("int16"), Conversion(scale_from=name)),
        Point(name, HOLDING, 1, value_type("int16")),
    ]
    assert ReadDecoder(points, HOLDING, 0, 2).decode(bytes.fromhex("0001 0001")).values == [10.0, 1]


def slowly(conversion: Conversion, raw: int | float, whole: bool, known: dict[str, int]) -> tuple[Any, int]:
    """Value and reason of a raw number, rule by rule, in exact fractions; nothing is shared with the decoder."""
    if raw != raw:
        return None, Reason.NOT_A_NUMBER
    patterns = set(conversion.invalid) | {each - 65536 for each in conversion.invalid if whole and each >= 0x8000}
    if (raw in patterns and whole) or raw in conversion.invalid:
        return None, Reason.NO_VALUE
    if conversion.scale_from and not -10 <= known.get(conversion.scale_from, 99) <= 10:
        return None, Reason.NO_SCALE_FACTOR
    scale, offset = Fraction(repr(conversion.scale)), Fraction(repr(conversion.offset))
    value: Any = raw
    if conversion.linear is not None:
        (r0, r1), (v0, v1) = conversion.linear.raw, conversion.linear.value
        scale = (Fraction(repr(v1)) - Fraction(repr(v0))) / (Fraction(r1) - Fraction(r0))
        offset = Fraction(repr(v0)) - Fraction(r0) * scale
    if scale != 1 or offset or conversion.linear is not None:
        exact = raw * scale + offset if whole else None
        value = exact.numerator / exact.denominator if exact is not None else raw * float(scale) + float(offset)
    if conversion.linear is not None and conversion.linear.clamp:
        value = min(max(value, min(conversion.linear.value)), max(conversion.linear.value))
    if conversion.scale_from:
        power = known[conversion.scale_from]
        value = value * 10.0**power if power >= 0 else value / 10.0**-power
    low, high = conversion.valid or (None, None)
    outside = (low is not None and value < low) or (high is not None and value > high)
    return value, Reason.OUT_OF_RANGE if outside else Reason.NONE


@st.composite
def conversions(draw: st.DrawFn) -> Conversion:
    keys: dict[str, Any] = {}
    kind = draw(st.sampled_from(["plain", "scale", "linear", "factor"]))
    if kind == "scale":
        keys = {
            "scale": draw(st.sampled_from([0.1, 0.05, -0.01, 2.5, 1000.0, 1.0])),
            "offset": draw(st.sampled_from([0.0, -40.0, 0.3])),
        }
    elif kind == "linear":
        ends = draw(st.sampled_from([((0, 27_648), (0.0, 100.0)), ((6400, 32_000), (150.0, -50.0))]))
        keys = {"linear": Linear(*ends, clamp=draw(st.booleans()))}
    elif kind == "factor":
        keys = {"scale_from": draw(st.sampled_from(["known", "unknown", "absurd"]))}
    keys["invalid"] = tuple(draw(st.lists(st.sampled_from([0x8000, 0xFFFF, 0, 7, -1]), max_size=3, unique=True)))
    keys["valid"] = draw(st.sampled_from([None, (-10.0, 10.0), (None, 0.0), (5.0, None), (-math.inf, math.inf)]))
    return Conversion(**keys)


@settings(max_examples=examples(300), deadline=None)
@given(
    given=st.lists(
        st.tuples(conversions(), st.sampled_from(["int16", "uint16", "float32", "bcd32"])), min_size=1, max_size=8
    ),
    data=st.data(),
)
def test_conversions_of_many_points_are_those_that_the_rules_give_one_by_one(
    given: list[tuple[Conversion, str]], data: st.DataObject
) -> None:
    points, at = [], 0
    for index, (conversion, name) in enumerate(given):
        points.append(Point(f"p{index}", HOLDING, at, value_type(name, "CDAB"), conversion))
        at += points[-1].width
    raws: list[Any] = []
    for point in points:
        if point.type == "float32":
            raws.append(data.draw(st.sampled_from([0.0, 7.0, -1.0, 1.5, -11.25, math.nan, math.inf])))
        elif point.type == "bcd32":
            raws.append(data.draw(st.integers(0, 99_999_999) | st.sampled_from([0, 7, 0x8000, 0xFFFF])))
        else:
            low = 0 if point.type == "uint16" else -32768
            raws.append(data.draw(st.integers(low, low + 65535) | st.sampled_from([low, 0, 7, low + 65535])))
    wire = b"".join(value_type(point.type, "CDAB").encode([raw]) for point, raw in zip(points, raws, strict=True))
    known = {"known": -2, "absurd": 11}
    found = ReadDecoder(points, HOLDING, 0, at).decode(wire, dict(known))
    for place, (point, raw) in enumerate(zip(points, raws, strict=True)):
        expected = point.conversion
        if point.type in (
            "uint16",
            "bcd32",
        ):  # the pattern of a negative number is not looked for in types without a sign
            signless = tuple(each for each in expected.invalid if each >= 0)
            expected = Conversion(expected.scale, expected.offset, expected.scale_from, expected.linear,
                                  tuple(each for each in signless), expected.valid)  # fmt: skip
        value, reason = slowly(expected, raw, point.is_whole, known)
        if value is None or value == value:
            assert found.values[place] == value, (point, raw)
        assert found.flaws.get(place, 0) == reason, (point, raw)
