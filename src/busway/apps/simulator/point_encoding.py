"""The place of a point in the memory of its device, and the encoding of its values there.

Knows sections of points and runs of items; knows no behaviour and no time.

1. Every value of a behaviour is changed to a value that the registers can hold: for whole numbers it is rounded, and a
   value outside the range of the point or of its type becomes the nearest end of that range. If it is NaN, as from a
   formula that divides by zero, a float becomes NaN, and a point of another type keeps its value. The range of a point
   with ``scale_from`` does not count, because a behaviour knows no exponent.
2. The encoding is prepared once for each point: at each moment a number is packed by one call of a compiled ``struct``.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from ...codes import Table
from ...config.files.simulation import SimulatedPointSection
from ...server.device import Device
from ...server.memory_runs import BitRun, RegisterRun
from ...values import ValueType

PutNumber = Callable[[bytearray, int, Any], object]
"""Function that writes a number of the point's type, or a ``bool``, into the memory of a device.

Its arguments: the memory, the offset of the point in it in bytes (for one bit: in bits), and the number.
"""
Quantise = Callable[[float], Any]
"""Function that takes a value in the unit of measure, and returns the nearest number that the registers can hold.

Returns None if the value is NaN and the type cannot hold NaN.
"""

_LETTERS: Final = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float16": "e",
    "float32": "f",
    "float64": "d",
}
_LARGEST: Final = {"float16": 65504.0, "float32": 3.4028234663852886e38, "float64": 1.7976931348623157e308}


@dataclass(frozen=True, slots=True)
class PointForm:
    """The encoding of a point's value in registers, computed once for all units that have the point.

    Attributes:
        section: the declaration of the point in its file.
        table: table of the point.
        address: address of the point's first item, 0-based.
        bit: number of the bit in its register, 0…15; None for whole items.
        form: value type of the registers; None for one bit.
        size: number of items that the point takes.
        put: writes a number, as the registers hold it, into the memory of a device.
        quantise: returns the number in the registers for a value in the unit of measure.
        factors: scale and offset: value in the unit of measure = number in the registers × scale + offset.
    """

    section: SimulatedPointSection
    table: Table
    address: int
    bit: int | None
    form: ValueType[Any] | None
    size: int
    put: PutNumber
    quantise: Quantise
    factors: tuple[float, float] = (1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a point in the memory of one device.

    Attributes:
        memory: the block of memory that has the point.
        offset: offset of the point in the block, in bytes (for one bit: in bits).
    """

    memory: RegisterRun | BitRun
    offset: int


def form_of(section: SimulatedPointSection) -> PointForm:
    """Return the encoding of a declared point's value in registers."""
    place, form = section.place, section.form
    return PointForm(
        section,
        section.table,
        place.offset,
        place.bit,
        form,
        section.size,
        _put_bit if form is None else _putter(form),
        _quantise_bit if form is None else _quantiser(section, form),
        _factors(section),
    )


def _factors(section: SimulatedPointSection) -> tuple[float, float]:
    scale, offset = section.conversion.factors()
    return float(scale), float(offset)


def place_of(form: PointForm, device: Device) -> Place:
    """Return the place of a point in the memory of a device, which must have the items of the point."""
    run = device.find_run(form.table, form.address, form.size)
    assert run is not None  # the device was built of these declarations
    position = form.address - run.first
    if form.bit is not None:
        # As bits of the bytes: bit 0 of a register is the lowest of its second byte.
        return Place(run.memory, 16 * position + (8 + form.bit if form.bit < 8 else form.bit - 8))
    return Place(run.memory, position if form.form is None else 2 * position)


def _put_bit(data: bytearray, offset: int, on: bool) -> None:
    mask = 1 << (offset & 7)
    if on:
        data[offset >> 3] |= mask
    else:
        data[offset >> 3] &= 255 - mask


def _putter(form: ValueType[Any]) -> PutNumber:
    """Return a function that writes a number of a value type into memory; a faster one for common byte orders."""
    letter = _LETTERS.get(form.name)
    if letter is not None and form.order == "ABCDEFGH"[: 2 * form.registers]:
        return struct.Struct(f">{letter}").pack_into
    if letter is not None and form.order == "HGFEDCBA"[-2 * form.registers :]:
        return struct.Struct(f"<{letter}").pack_into
    if letter is not None and form.order == "CDAB":
        return _putter_low_word_first(letter)
    size, encode = 2 * form.registers, form.encode
    if form.is_part:
        return lambda data, offset, number: _merge(form, data, offset, number)

    def put(data: bytearray, offset: int, number: Any) -> None:
        data[offset : offset + size] = encode([number])

    return put


def _merge(form: ValueType[Any], data: bytearray, offset: int, number: Any) -> None:
    size = 2 * form.registers
    data[offset : offset + size] = form.merge(number, data[offset : offset + size])


def _putter_low_word_first(letter: str) -> PutNumber:
    pack = struct.Struct(f">{letter}").pack

    def put(data: bytearray, offset: int, number: Any) -> None:
        packed = pack(number)
        data[offset : offset + 4] = packed[2:] + packed[:2]

    return put


def _quantise_bit(value: float) -> bool | None:
    return None if value != value else value >= 0.5


def _quantiser(section: SimulatedPointSection, form: ValueType[Any]) -> Quantise:
    scale, offset = _factors(section)
    low, high = _range_of_type(form)
    if form.name.startswith("float"):
        return _float_quantiser(section, low, high)
    # The ends of the range in steps of the scale, inwards: 0.25 at a scale of 0.1 is step 3 as a minimum.
    minimum, maximum = limits_of(section)
    ends = (minimum, maximum) if scale > 0 else (maximum, minimum)
    inward_low = low if ends[0] is None else (ends[0] - offset) / scale
    inward_high = high if ends[1] is None else (ends[1] - offset) / scale
    least = max(int(low), math.ceil(inward_low - _ROUNDING))
    most = max(least, min(int(high), math.floor(inward_high + _ROUNDING)))
    return _whole_quantiser(scale, offset, least, most)


_ROUNDING: Final = 1e-9
"""Error that a division may have because its operands are rounded to binary fractions."""


def _whole_quantiser(scale: float, offset: float, least: int, most: int) -> Quantise:
    def quantise(value: float) -> int | None:
        try:
            number = round((value - offset) / scale)
        except (ValueError, OverflowError):
            return None if value != value else most if (value > 0) == (scale > 0) else least
        return least if number < least else most if number > most else number

    return quantise


def _float_quantiser(section: SimulatedPointSection, low: float, high: float) -> Quantise:
    scale, offset = _factors(section)
    least, most = limits_of(section)
    minimum = -math.inf if least is None else least
    maximum = math.inf if most is None else most

    def quantise(value: float) -> float:
        if value < minimum:
            value = minimum
        elif value > maximum:
            value = maximum
        number = (value - offset) / scale
        return low if number < low else high if number > high else number

    return quantise


def limits_of(section: SimulatedPointSection) -> tuple[float | None, float | None]:
    """Return the smallest and the largest value that a behaviour may give a point; None for no limit (rule 1)."""
    return (None, None) if section.scale_from else (section.minimum, section.maximum)


def _range_of_type(form: ValueType[Any]) -> tuple[float, float]:
    """Return the smallest and the largest number that a value type can hold."""
    if form.name in _LARGEST:
        return -_LARGEST[form.name], _LARGEST[form.name]
    bits = 16 * form.registers
    if form.name.startswith("field:"):
        first, last = form.name.split(":")[1].split("-")
        bits = int(last) - int(first) + 1
    elif form.is_part:
        bits = 8
    if form.name.startswith("bcd"):
        return 0, 10 ** (bits // 4) - 1
    if form.name.startswith("uint") or (form.name.startswith("field") and not form.name.endswith("signed")):
        return 0, (1 << bits) - 1
    return -(1 << bits - 1), (1 << bits - 1) - 1


def largest_of(form: PointForm) -> float | None:
    """Return the value at which a counter in this point starts again from `begin_of`, in its unit of measure.

    This is the point's ``rollover`` if that is a number, else the first value that is too large for the registers. None
    for bits and floats: never. A ``rollover`` of the behaviour itself has priority over this result.
    """
    if form.form is None or form.form.name.startswith("float"):
        return None
    if not isinstance(form.section.rollover, bool):
        return form.section.rollover
    scale = form.factors[0]
    low, high = _range_of_type(form.form)
    most = -low if scale < 0 and low < 0 else high  # how far the numbers go in the direction of larger values
    return begin_of(form) + (int(most) + 1) * abs(scale)


def begin_of(form: PointForm) -> float:
    """Return the value with which a counter in this point starts again, in its unit of measure.

    This is 0 for bits, and if ``rollover`` is a number. With ``true`` or ``false`` it is the value of 0 in the
    registers, that is ``offset``. With a negative scale and an unsigned type it is the value of the largest number in
    the registers, which is the smallest value.
    """
    if form.form is None or not isinstance(form.section.rollover, bool):
        return 0.0
    scale, offset = form.factors
    low, high = _range_of_type(form.form)
    return offset if scale > 0 or low < 0 else offset + high * scale


def goes_below_begin(form: PointForm) -> bool:
    """Whether a counter in this point goes on below `begin_of`: its type has a sign, and the point no ``rollover``."""
    return form.form is not None and isinstance(form.section.rollover, bool) and _range_of_type(form.form)[0] < 0
