"""Turns the reply to a read request into the values of all points in it, by one compiled function.

Knows points and the bytes of a reply; knows no request and no clock.

1. All numbers of a read are unpacked by one ``struct`` call. If ``struct`` cannot unpack the bytes as they lie (another
   order, points that overlap), the registers are first rearranged, all in one step.
2. Everything else that a point needs (a scale, a comparison, a bit) is code in one generated function, as for the
   messages in `pdu`. Texts and the like are decoded by their value type.
3. Good values cost nothing beside their value: only values that are not good have an entry in ``flaws``.
4. Points may overlap. A register that several points use is unpacked once.
"""

import math
import operator
import struct
from array import array
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from ..codes import Table
from ..errors import BadReply, InvalidRequest
from ..values.counts import counted
from ..values.orders import BytesLike, byte_order
from .conversion import LARGEST_EXPONENT, signed_number, size_in_bits
from .point import Point
from .quality import Reading, Reason

_LETTERS: Final = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int48": "q",
    "uint48": "Q",
    "int64": "q",
    "uint64": "Q",
    "float16": "e",
    "float32": "f",
    "float64": "d",
}
_NO_FLAWS: Final[Mapping[int, int]] = {}
_BITS: Final = tuple(tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256))
_POWERS: Final = tuple(10.0**exponent for exponent in range(LARGEST_EXPONENT + 1))


@dataclass(frozen=True, slots=True)
class DecodedRead:
    """The values of all points in one reply, and the reasons why some of them are not good.

    Attributes:
        values: the value of each point, in the order of the decoder's points; None for a point without a value.
        flaws: the reason (`Reason`) by position of the point, only for values that are not good.
    """

    values: list[Any]  # what the points' types say
    flaws: Mapping[int, int]


class ReadDecoder:
    """Turns the replies to one particular read request into the values of its points.

    Args:
        points: the points in the range that is read, in the order in which their values are wanted.
        table: the table that is read.
        start: the offset of the first item that is read.
        count: number of items that are read.

    Attributes:
        points, table, start, count: as given.
        size: number of data bytes in each reply.

    Raises:
        InvalidRequest: a point does not lie within the read.
    """

    def __init__(self, points: Sequence[Point], table: Table, start: int, count: int) -> None:
        for point in points:
            if point.table is not table or point.formula or point.start < start or point.end > start + count:
                raise InvalidRequest(f"{point.name} does not lie within {counted(count, table.label)} from {start} on")
        self.points: tuple[Point, ...] = tuple(points)
        self.table = table
        self.start = start
        self.count = count
        self.size: int = (count + 7) // 8 if table.holds_bits else 2 * count
        decode = _bits_decoder if table.holds_bits else _registers_decoder
        self._decode = decode(self.points, start, count)

    def decode(self, data: BytesLike, known: MutableMapping[str, int] | None = None) -> DecodedRead:
        """Return the values of all points in a reply to the read.

        Args:
            data: registers in wire order, or bits as in a reply, the first in the lowest bit.
            known: exponents for ``scale_from``, by name of the point that holds them. It is changed: exponents found in
                this reply are set in it and used at once, those without a value in this reply are removed. None if no
                point needs any.

        Raises:
            InvalidRequest: the length of ``data`` is not that of a reply to this read.
        """
        if len(data) != self.size:
            raise InvalidRequest(
                f"{counted(len(data), 'byte')}, but {self.size} are needed for {counted(self.count, self.table.label)}"
            )
        values, flaws = self._decode(data, {} if known is None else known)
        return DecodedRead(values, flaws or _NO_FLAWS)


@lru_cache(maxsize=4096)
def _alone(point: Point) -> ReadDecoder:
    """Return the decoder of a read request for one point only; compiled once and cached."""
    return ReadDecoder([point], point.table, point.start, point.width)


def decode_point(point: Point, data: BytesLike, known: Mapping[str, int] | None = None) -> Reading:
    """Return the value and quality of one point from its own registers or bit.

    Args:
        point: the point.
        data: its registers in wire order; for a coil or discrete input a byte whose lowest bit is its state.
        known: exponents for ``scale_from``, by name of the point that holds them; not changed.

    Raises:
        InvalidRequest: the length of ``data`` is not that of the point, or the point is computed.
    """
    found = _alone(point).decode(data, dict(known or {}))
    return Reading(found.values[0], found.flaws.get(0, Reason.NONE))


_Decode = Callable[[BytesLike, MutableMapping[str, int]], tuple[list[Any], dict[int, int] | None]]


def _bits_decoder(points: Sequence[Point], start: int, count: int) -> _Decode:
    places = [point.start - start for point in points]
    first, last = (min(places) // 8, max(places) // 8) if places else (0, 0)
    places = [place - 8 * first for place in places]
    if len(places) == 1:
        (only,) = places
        return lambda data, known: ([_BITS[data[first + only // 8]][only & 7]], None)
    take = operator.itemgetter(*places) if places else lambda bits: ()

    def decode(data: BytesLike, known: MutableMapping[str, int]) -> tuple[list[Any], None]:
        bits: list[bool] = []
        for byte in data[first : last + 1]:
            bits += _BITS[byte]
        return list(take(bits)), None

    return decode


@dataclass(frozen=True, slots=True)
class _Number:
    """How the number of a point is unpacked from a reply.

    Attributes:
        registers: positions of its registers in the reply, the most significant first; -1 for a register of zeros.
        swapped: whether the two bytes of each register are swapped.
        letter: format character of `struct`.
    """

    registers: tuple[int, ...]
    swapped: bool
    letter: str

    @property
    def is_plain(self) -> bool:
        """Whether ``struct`` can unpack the number directly, without moving its registers."""
        first = self.registers[0]
        return first >= 0 and not self.swapped and self.registers == tuple(range(first, first + len(self.registers)))


def _number_of(point: Point, start: int) -> _Number | None:
    """Return how the number of a point is unpacked by ``struct``; None if only its value type can do it."""
    form, first = point.form, point.start - start
    assert form is not None  # it is in registers
    name = form.name
    if name.startswith(("bit:", "field:", "int8:", "uint8:")):
        return _Number((first,), byte_order(form.order, 2).mask & 1 == 1, "H")
    letter = _LETTERS.get(name)
    if letter is None:
        return None
    order = byte_order(form.order, 2 * form.registers)
    registers = tuple(first + place for place in order.registers)
    if name == "uint48":
        registers = (-1, *registers)
    elif name == "int48":
        registers = (*registers, -1)  # shifted down again, with its sign
    return _Number(registers, bool(order.mask & 1), letter)


def _registers_decoder(points: Sequence[Point], start: int, count: int) -> _Decode:
    writer = _Source(points, start, count)
    namespace: dict[str, Any] = writer.namespace
    exec(compile(writer.text(), "<decoder of a read>", "exec"), namespace)
    decode: _Decode = namespace["decode"]
    return decode


class _Source:
    """Writes the Python source of the function that decodes the registers of one read request."""

    def __init__(self, points: Sequence[Point], start: int, count: int) -> None:
        self._points = points
        self._start = start
        self._count = count
        self._numbers: dict[_Number, str] = {}
        self._lines: list[str] = []
        self.namespace: dict[str, Any] = {"inf": math.inf, "nan": math.nan}

    def text(self) -> str:
        """Return the source code of the function ``decode(data, known)``, which returns values and flaws."""
        for point in self._points:
            number = _number_of(point, self._start)
            if number is not None and number not in self._numbers:
                self._numbers[number] = f"n{len(self._numbers)}"
        needed = {point.conversion.scale_from for point in self._points} - {""}
        needed |= {point.name for point in self._points if point.is_exponent}
        for place in sorted(range(len(self._points)), key=lambda each: self._points[each].name not in needed):
            self._point(place, self._points[place], is_exponent=self._points[place].name in needed)
        values = ", ".join(f"v{place}" for place in range(len(self._points)))
        body = [*self._unpacking(), "flaws = None", *self._lines, f"return [{values}], flaws"]
        return "def decode(data, known):\n" + "\n".join(f"    {line}" for line in body) + "\n"

    def _unpacking(self) -> list[str]:
        if not self._numbers:
            return []
        names = "".join(f"{name}, " for name in self._numbers.values())
        plain = sorted(self._numbers, key=lambda each: each.registers[0])
        ends = [each.registers[0] + len(each.registers) for each in plain]
        disjoint = all(end <= after.registers[0] for end, after in zip(ends, plain[1:], strict=False))
        if disjoint and all(each.is_plain for each in plain):
            self.namespace["unpack"] = struct.Struct(_padded(plain, self._count)).unpack
            return [f"{''.join(f'{self._numbers[each]}, ' for each in plain)}= unpack(data)"]
        picks = [
            2 * self._count if register < 0 else register + self._count * each.swapped
            for each in self._numbers
            for register in each.registers
        ]
        pick: Callable[[Any], Iterable[int]] = operator.itemgetter(*picks, 2 * self._count)
        swaps = any(each.swapped for each in self._numbers)
        self.namespace |= {
            "unpack": struct.Struct(">" + "".join(each.letter for each in self._numbers) + "2x").unpack,
            "gather": _gatherer(pick, self._count, swaps=swaps),
        }
        return [f"{names}= unpack(gather(data))"]

    def _point(self, place: int, point: Point, *, is_exponent: bool) -> None:
        number = _number_of(point, self._start)
        if number is None:
            self._typed(place, point)
        else:
            raw = self._raw(self._numbers[number], point)
            self._lines += self._converted(place, point, raw, self._tests(place, point, raw))
        if is_exponent:
            self._lines += [
                f"if v{place} is None:",
                f"    known.pop({point.name!r}, None)",
                "else:",
                f"    known[{point.name!r}] = v{place}",
            ]

    def _raw(self, name: str, point: Point) -> str:
        assert point.form is not None
        kind, _, rest = point.form.name.partition(":")
        if kind == "bit":
            return f"{name} & {1 << int(rest)} != 0"
        if kind == "int48":
            return f"({name} >> 16)"
        if kind in ("int8", "uint8", "field"):
            bits = {"low": "0-7", "high": "8-15"}.get(rest, rest).partition(":")[0]
            low, high = (int(each) for each in bits.split("-"))
            sign = 1 << high - low if kind == "int8" or rest.endswith(":signed") else 0
            field = f"({name} >> {low} & {(1 << high - low + 1) - 1})"
            return f"(({field} ^ {sign}) - {sign})" if sign else field
        return name

    def _tests(self, place: int, point: Point, raw: str) -> list[tuple[str, Reason]]:
        """Return the tests for raw numbers that mean "no value": the source of each condition, and the reason."""
        if point.type == "bit":
            return []
        tests = [] if point.is_whole else [(f"{raw} != {raw}", Reason.NOT_A_NUMBER)]
        invalid = _invalid_of(point)
        if len(invalid) == 1:
            tests.append((f"{raw} == {invalid[0]!r}", Reason.NO_VALUE))
        elif invalid:
            self.namespace[f"invalid{place}"] = frozenset(invalid)
            tests.append((f"{raw} in invalid{place}", Reason.NO_VALUE))
        return tests

    def _converted(self, place: int, point: Point, raw: str, tests: list[tuple[str, Reason]]) -> list[str]:
        """Return the code that sets the value of a point: converted from the raw number, or None if a test is true.

        With None, the code sets the reason of that test. It tests for a missing exponent and for validity too.
        """
        word, conversion = "if", point.conversion
        if point.type == "bit" or not point.is_number:
            return [f"v{place} = {raw}"]
        found = []
        for condition, reason in tests:
            found += [f"{word} {condition}:", f"    v{place} = None", f"    {self._flaw(place, reason)}"]
            word = "elif"
        scaled = conversion.scale_from
        if scaled:
            self.namespace["powers"] = _POWERS
            found += [
                f"{word} not -{LARGEST_EXPONENT} <= known.get({scaled!r}, 99) <= {LARGEST_EXPONENT}:",
                f"    v{place} = None",
                f"    {self._flaw(place, Reason.NO_SCALE_FACTOR)}",
            ]
            word = "elif"
        lines = [f"v{place} = {conversion.source(raw, whole=point.is_whole)}"]
        if scaled:
            lines += [
                f"exponent = known[{scaled!r}]",
                f"v{place} = v{place} * powers[exponent] if exponent >= 0 else v{place} / powers[-exponent]",
            ]
        if conversion.valid is not None:
            lines += self._validity(place, *conversion.valid)
        return [*found, *(lines if word == "if" else ["else:", *(f"    {line}" for line in lines)])]

    def _validity(self, place: int, low: float | None, high: float | None) -> list[str]:
        tests = [f"v{place} {sign} {end!r}" for end, sign in ((low, "<"), (high, ">")) if end is not None]
        return [f"if {' or '.join(tests)}:", f"    {self._flaw(place, Reason.OUT_OF_RANGE)}"] if tests else []

    def _flaw(self, place: int, reason: Reason) -> str:
        self.namespace["noted"] = _noted
        return f"flaws = noted(flaws, {place}, {int(reason)})"

    def _typed(self, place: int, point: Point) -> None:
        """Append the code for a point that ``struct`` cannot unpack; the generated function calls its value type."""
        first = 2 * (point.start - self._start)
        self.namespace |= {f"read{place}": _reader(point), "noted": _noted}
        self._lines += [
            f"v{place}, reason = read{place}(data[{first}:{first + 2 * point.width}])",
            f"if reason: flaws = noted(flaws, {place}, reason)",
        ]
        conversion = point.conversion
        if point.is_number and (conversion.changes or conversion.scale_from or conversion.valid):
            lines = self._converted(place, point, f"v{place}", [])
            self._lines += ["else:", *(f"    {line}" for line in lines)]


def _noted(flaws: dict[int, int] | None, place: int, reason: int) -> dict[int, int]:
    """Set ``flaws[place]``, the reason of the point at that position, and return ``flaws``; None: a new dictionary."""
    if flaws is None:
        return {place: reason}
    flaws[place] = reason
    return flaws


def _padded(numbers: Sequence[_Number], count: int) -> str:
    """Return the ``struct`` format for numbers in their order, with padding for the gaps between them."""
    text, at = ">", 0
    for each in numbers:
        gap = each.registers[0] - at
        text += f"{2 * gap}x" if gap else ""
        text += each.letter
        at = each.registers[0] + len(each.registers)
    return text + (f"{2 * (count - at)}x" if count > at else "")


def _gatherer(pick: Callable[[Any], Iterable[int]], count: int, *, swaps: bool) -> "Callable[[BytesLike], array[int]]":
    """Return a function that copies the registers of a reply into the order in which ``struct`` unpacks them.

    Args:
        pick: selects from an array of all registers, then (if ``swaps``) all of them byte-swapped, then zeros.
        count: number of registers in a reply.
        swaps: whether byte-swapped registers are needed.
    """
    rest = array("H", [0] if swaps else [0] * (count + 1))

    def gather(data: BytesLike) -> "array[int]":
        registers = array("H")
        registers.frombytes(data)
        if swaps:
            other = registers[:]
            other.byteswap()
            registers += other
        registers += rest
        return array("H", pick(registers))

    return gather


def _invalid_of(point: Point) -> list[float]:
    """Return the raw numbers that mean "no value" for a point, in the form in which its numbers are unpacked.

    A float is rounded to the type's precision, a bit pattern of a signed type becomes a negative number.
    """
    form = point.form
    assert form is not None
    name = form.name
    if name.startswith("float"):
        found = []
        for each in point.conversion.invalid:
            found += form.decode(form.encode([float(each)]))  # as near to it as the type comes
        return found
    bits, signed = size_in_bits(form)
    return [signed_number(each, bits=bits, signed=signed) for each in point.conversion.invalid]


def _reader(point: Point) -> Callable[[BytesLike], tuple[Any, int]]:
    """Return a function that decodes one point by its value type; a number is not converted yet.

    The function takes the bytes of the point, and returns its value and 0, or None and the reason for no value.
    """
    form = point.form
    assert form is not None
    invalid = frozenset(point.conversion.invalid)

    def read(data: BytesLike) -> tuple[Any, int]:
        try:
            raw = form.decode(data)[0]
        except BadReply:
            return None, Reason.MEANINGLESS
        if invalid and raw in invalid:
            return None, Reason.NO_VALUE
        return raw, Reason.NONE

    return read
