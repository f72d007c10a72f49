"""Conversion between the raw number in a point's registers and its value in the unit of measure, such as kW.

Knows numbers; knows no register, type or point.

1. All conversions of a point are one: ``value = raw · scale + offset``. A linear range is the same with other words.
2. For whole raw numbers it is computed as ``(raw · a + b) / c`` with whole a, b, c of the decimal numbers that were
   written, and rounded once: 183 at a scale of 0.1 is 18.3, not 18.3000000000000007.
3. A value that is no whole number of steps is refused where the raw number is whole; it is never rounded.
4. Order: raw → invalid? → scale, offset, ``scale_from`` → clamp → valid?
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from ..errors import InvalidRequest
from ..values.refusal import shown

_MOST_STEPS_OFF: Final = 1e-6
"""How far from a whole number of steps a value may be: what binary fractions cost."""
LARGEST_EXPONENT: Final = 10
"""Scale factors lie in -10…10 (SunSpec Device Information Model Specification, sunssf)."""


@dataclass(frozen=True, slots=True)
class Linear:
    """A linear scale of a point: a range of raw numbers that corresponds to a range of values.

    Attributes:
        raw: the two ends of the range as raw numbers.
        value: the values at these ends.
        clamp: whether values beyond the ends become the ends.
    """

    raw: tuple[float, float]
    value: tuple[float, float]
    clamp: bool = False


@dataclass(frozen=True, slots=True)
class Conversion:
    """How the raw numbers of a point become values: scale, offset, linear range, or a power of ten from another point.

    Attributes:
        scale, offset: ``value = raw · scale + offset``.
        scale_from: the name of a point whose value is the exponent of ten that the value is multiplied with.
        linear: instead of scale and offset.
        invalid: raw numbers that stand for no value. Of signed types also as the pattern of bits: ``0x8000``.
        valid: values outside these ends are uncertain.
        names: names of numbers, number by name.
        flags: names of the bits of a whole number, bit by name.
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
        """Whether the values of the point differ from its raw numbers."""
        return self.scale != 1.0 or self.offset != 0.0 or self.linear is not None

    def factors(self) -> tuple[Fraction, Fraction]:
        """Scale and offset of the point as exact fractions."""
        if self.linear is None:
            return _exact(self.scale), _exact(self.offset)
        low, high = _exact(self.linear.raw[0]), _exact(self.linear.raw[1])
        least, most = _exact(self.linear.value[0]), _exact(self.linear.value[1])
        scale = (most - least) / (high - low)
        return scale, least - low * scale

    def source(self, raw: str, *, whole: bool) -> str:
        """Return a Python expression for the value, given an expression for the raw number; for compiled decoders.

        Args:
            raw: the name.
            whole: whether raw numbers are whole.
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
        """Return the raw number to write for a value of the point.

        Args:
            value: in the unit of measure.
            whole: whether raw numbers are whole.
            exponent: what the point of ``scale_from`` holds.

        Raises:
            InvalidRequest: it is no number, or no whole number of steps.
        """
        if not self.changes and not exponent:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InvalidRequest(f"a number is needed where there is a scale, not {shown(value)}")
        if not math.isfinite(value):
            if whole:
                raise InvalidRequest(f"{shown(value)} is no whole number of steps of {self.scale:g}")
            return value
        scale, offset = self.factors()
        steps = (_exact(value) / Fraction(10) ** exponent - offset) / scale
        if not whole:
            return float(steps)
        nearest = round(steps)
        if abs(steps) >= 1 << 64 or abs(steps - nearest) > max(_MOST_STEPS_OFF, _MOST_STEPS_OFF * float(abs(steps))):
            raise InvalidRequest(f"{shown(value)} is no whole number of steps of {float(scale):g}")
        return nearest


def _exact(number: float) -> Fraction:
    """Return a float as the decimal fraction it was written as: 1/10 for 0.1."""
    return Fraction(number) if isinstance(number, int) else Fraction(repr(float(number)))


def pattern(number: float, *, bits: int, signed: bool) -> float:
    """Return a raw number; a bit pattern becomes the signed number that it means: 0x8000 is -32768 in 16 bits with a
    sign.
    """
    if signed and isinstance(number, int) and 1 << bits - 1 <= number < 1 << bits:
        return number - (1 << bits)
    return number


def converter(conversion: Conversion, *, whole: bool) -> Callable[[float], float]:
    """Return a compiled function from raw numbers to values of a point, faster than `value_of`."""
    convert: Callable[[float], float] = eval(f"lambda raw: {conversion.source('raw', whole=whole)}")
    return convert


def value_of(conversion: Conversion, raw: float, *, whole: bool) -> float:
    """Return the value for one raw number of a point, without ``scale_from``; slower than compiled decoders."""
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
