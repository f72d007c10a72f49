"""Conversion between the raw number in a point's registers and its value in the unit of measure, such as kW.

Knows numbers; knows no register, type or point.

1. Every conversion is ``value = raw · scale + offset``. A linear range is converted to a scale and an offset.
2. For whole raw numbers it is computed as ``(raw · a + b) / c`` with whole a, b, c of the decimal numbers that were
   written, and rounded once: 183 at a scale of 0.1 is 18.3, not 18.3000000000000007.
3. A value that is no whole number of steps is refused where the raw number is whole; it is never rounded.
4. Steps of decoding: test the raw number for "no value"; apply scale, offset and ``scale_from``; clamp; test whether
   the value is valid.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Final

from ..errors import InvalidRequest
from ..values import ValueType
from ..values.unfit_values import shown

_MOST_STEPS_OFF: Final = Fraction(1, 1_000_000)
"""How far a value may always be from a whole number of steps to count as one, in steps."""
_MOST_STEPS_OFF_OF_ALL: Final = Fraction(1, 10)
"""How far even the largest values, whose rounding errors are large, may be from a whole number of steps, in steps.

It is below one half, so half a step never counts as a whole one.
"""
ROUNDING: Final = Fraction(1, 1 << 49)
"""Largest relative error of a float that was computed in a few steps: eight times its last bit."""
_ROUNDING_OF_FLOAT32: Final = Fraction(1, 1 << 24)
"""Largest relative error of a number that was rounded to a float of 32 bits."""
LARGEST_EXPONENT: Final = 10
"""Largest absolute value of an exponent for ``scale_from`` (SunSpec Device Information Model Specification, sunssf)."""


@dataclass(frozen=True, slots=True)
class Linear:
    """A linear scale of a point: a range of raw numbers and the range of values that it corresponds to.

    Attributes:
        raw: the two ends of the range as raw numbers.
        value: the values at these ends.
        clamp: whether values beyond an end are replaced by the value at that end.
    """

    raw: tuple[float, float]
    value: tuple[float, float]
    clamp: bool = False


@dataclass(frozen=True, slots=True)
class Conversion:
    """How the raw numbers of a point become values: scale, offset, linear range, or a power of ten from another point.

    Attributes:
        scale, offset: ``value = raw · scale + offset``.
        scale_from: name of a point whose value is an exponent: the value is multiplied by ten to that power. Empty for
            none.
        linear: a linear range that replaces scale and offset; None without one.
        invalid: raw numbers that mean "no value". For signed types also as a bit pattern: ``0x8000``.
        valid: smallest and largest valid value; values beyond them are uncertain. None for no limit at that end, or
            for none at both.
        names: numbers of the named values, by name: ``{"off": 0, "auto": 1}``.
        flags: positions of the named bits of a whole number, from 0 for the lowest on, by name.
    """

    scale: float = 1.0
    offset: float = 0.0
    scale_from: str = ""
    linear: Linear | None = None
    invalid: tuple[float, ...] = ()
    valid: tuple[float | None, float | None] | None = None
    names: Mapping[str, int] = field(default_factory=dict)
    flags: Mapping[str, int] = field(default_factory=dict)

    @property
    def changes(self) -> bool:
        """Whether scale, offset or linear range change raw numbers to other values; ``scale_from`` does not count."""
        return self.scale != 1.0 or self.offset != 0.0 or self.linear is not None

    def factors(self) -> tuple[Fraction, Fraction]:
        """Return scale and offset as exact fractions; those of the linear range if there is one."""
        if self.linear is None:
            return exact(self.scale), exact(self.offset)
        low, high = exact(self.linear.raw[0]), exact(self.linear.raw[1])
        least, most = exact(self.linear.value[0]), exact(self.linear.value[1])
        scale = (most - least) / (high - low)
        return scale, least - low * scale

    def source(self, raw: str, *, whole: bool) -> str:
        """Return the text of a Python expression that computes the value from a raw number, for generated decoders.

        ``scale_from`` is not applied by the expression.

        Args:
            raw: the expression for the raw number, such as a variable's name.
            whole: whether raw numbers are integers.
        """
        text = raw
        if self.changes:
            scale, offset = self.factors()
            if whole:
                bottom = math.lcm(scale.denominator, offset.denominator)
                times, plus = int(scale * bottom), int(offset * bottom)
                text = raw if times == 1 else f"{raw} * {times}"
                text += f" + {plus}" if plus > 0 else f" - {-plus}" if plus else ""
                text = f"({text}) / {bottom}" if plus or times != 1 else f"{raw} / {bottom}"
            else:
                text = raw if scale == 1 else f"{raw} * {float(scale)!r}"
                text += f" + {float(offset)!r}" if offset else ""
        if self.linear is not None and self.linear.clamp:
            low, high = sorted(self.linear.value)
            text = f"max({float(low)!r}, min({float(high)!r}, {text}))"
        return text

    def raw(self, value: float, *, whole: bool, exponent: int = 0) -> float:
        """Return the raw number to write for a value of the point. Limits and ``clamp`` are not applied.

        Without a conversion (not `changes`, and ``exponent`` 0) the value is returned unchecked. Where raw numbers are
        floats, so are NaN and infinity.

        Args:
            value: the value in the unit of measure.
            whole: whether raw numbers are integers.
            exponent: the value of the point that ``scale_from`` names; 0 without one.

        Raises:
            InvalidRequest: the value to be converted is no number, or too large, or no whole number of steps where raw
                numbers are integers.
        """
        if not self.changes and not exponent:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InvalidRequest(f"a number is needed where there is a scale, not {shown(value)}")
        if isinstance(value, float) and not math.isfinite(value):
            if whole:
                raise InvalidRequest(f"{shown(value)} is no whole number of steps of {self.scale:g}")
            return value
        scale, offset = self.factors()
        steps = (exact(value) / Fraction(10) ** exponent - offset) / scale
        if not whole:
            try:
                return float(steps)
            except OverflowError:
                raise InvalidRequest(f"{shown(value)} is too large") from None
        if abs(steps) >= 1 << 64 or not is_whole(steps, value, scale * Fraction(10) ** exponent):
            raise InvalidRequest(f"{shown(value)} is no whole number of steps of {float(scale):g}")
        return round(steps)


def is_whole(steps: Fraction, value: float, step: Fraction) -> bool:
    """Whether a number of steps is whole, apart from the rounding error of the float that it was computed from.

    Args:
        steps: the number of steps.
        value: the value that they make, in the unit of measure.
        step: the size of a step, in the unit of measure.
    """
    error = Fraction(0)
    if not isinstance(value, int):
        error = abs(exact(value) / step) * (_ROUNDING_OF_FLOAT32 if is_float32(value) else ROUNDING)
    return abs(steps - round(steps)) <= max(_MOST_STEPS_OFF, min(error, _MOST_STEPS_OFF_OF_ALL))


def is_float32(value: float) -> bool:
    """Whether a float of 32 bits can hold exactly this value; False for NaN."""
    try:
        return bool(struct.unpack("<f", struct.pack("<f", value))[0] == value)
    except OverflowError:
        return False


def exact(number: float) -> Fraction:
    """Return a number as the exact decimal fraction that its text shows: 1/10 for 0.1.

    `ValueError` for NaN and infinity.
    """
    return Fraction(number) if isinstance(number, int) else Fraction(repr(float(number)))


def size_in_bits(form: ValueType[Any]) -> tuple[int, bool]:  # Any: a number
    """Return the number of bits of a type for whole numbers, and whether it has a sign."""
    bits = 16 * form.registers
    if form.name.startswith(("int8", "uint8")):
        bits = 8
    elif form.name.startswith("field:"):
        low, high = form.name.split(":")[1].split("-")
        bits = int(high) - int(low) + 1
    return bits, form.name.startswith("int") or form.name.endswith(":signed")


def signed_number(number: float, *, bits: int, signed: bool) -> float:
    """Return the signed number that a bit pattern stands for: 0x8000 is -32768 in 16 bits with a sign.

    Args:
        number: an int whose sign bit is set becomes negative; any other number, a float too, is returned unchanged.
        bits: size of the type in bits.
        signed: whether the type has a sign.
    """
    if signed and isinstance(number, int) and 1 << bits - 1 <= number < 1 << bits:
        return number - (1 << bits)
    return number


def converter(conversion: Conversion, *, whole: bool) -> Callable[[float], float]:
    """Return a compiled function that converts raw numbers of a point to values, faster than `value_of`.

    Args:
        conversion: the conversion of the point; its ``scale_from`` is not applied.
        whole: whether raw numbers are integers.
    """
    convert: Callable[[float], float] = eval(f"lambda raw: {conversion.source('raw', whole=whole)}")
    return convert


def value_of(conversion: Conversion, raw: float, *, whole: bool) -> float:
    """Return the value for one raw number of a point, in the unit of measure; slower than a compiled `converter`.

    Args:
        conversion: the conversion of the point; its ``scale_from`` is not applied.
        raw: the raw number.
        whole: whether raw numbers are integers.
    """
    if not conversion.changes:
        return raw
    scale, offset = conversion.factors()
    value: float
    if whole:
        exact = Fraction(raw) * scale + offset
        value = exact.numerator / exact.denominator
    else:
        value = raw * float(scale) + float(offset)
    if conversion.linear is not None and conversion.linear.clamp:
        ends = conversion.linear.value
        return max(float(min(ends)), min(float(max(ends)), value))
    return value
