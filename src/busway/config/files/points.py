"""Keys of files for points: ``[[unit.point]]`` and ``[[unit.group]]``, the same in every file that has devices.

Knows what can be written and what fits together within a point or a group; what a point then does is known by
`busway.points`, and what fits together in a unit by `device`.

An example is in `docs/reference/device-file.md`.

Rules:

1. ``value`` is in the unit of measure: the registers hold ``(value - offset) / scale``, or what the line ``linear``
   gives. A value that does not fit is refused, never truncated.
2. A point has an address, or a formula; a computed point holds nothing and is not written.
3. A group is written once. Its points are named ``string.1.voltage`` … ``string.12.voltage``, and stand ``stride``
   items apart. Inside, names mean points of the same place in the group first, and then those around it.
4. All errors of a point are reported together, those between valid keys too.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import BeforeValidator, Field, ModelWrapValidatorHandler, ValidationError, model_validator

from ...codes import TABLE_SIZE, Table
from ...errors import ConfigError, InvalidRequest
from ...options.declaration import Name, Range
from ...points import AlarmRule, Conversion, Linear, Point, ReportRule, WriteRule
from ...points.conversion import converter, size_in_bits
from ...points.expression import Expression, parse_expression
from ...points.point_rules import ranged
from ...values import Address, ValueType, format_address, parse_address, value_type
from ...values.counts import counted
from ...values.unfit_values import shown
from .error_wording import faults_in
from .key_lines import KeyPath
from .section import NO_LIST, NO_TABLE, FileProblems, Section

Result = TypeVar("Result")
Finite = Annotated[float, Field(allow_inf_nan=False)]
MOST_REPEATED: Final = 10_000
"""Most points that the groups of one unit can have together; each repetition of a group counts its points again."""

_NUMBERS: Final = ("int", "uint", "float", "bcd", "field")
_WRITTEN_BY: Final = {True: (5, 15), False: (6, 16, 22)}
"""Codes of the functions that write a table, by whether it holds bits."""
_FIELD: Final = re.compile(r"(?P<register>.+)\.(?P<low>\d{1,2})-(?P<high>\d{1,2})")
_OF_A_READ: Final = (
    "address", "type", "order", "value", "scale", "offset", "scale_from", "linear", "invalid", "enumeration", "flags",
    "minimum", "maximum", "access", "rollover", "overlaps", "write",
)  # fmt: skip
"""Keys of points with an address; a computed point cannot have them."""
_DEADBAND: Final = re.compile(r"(\d+(?:\.\d+)?)\s*%")


# Points of large plants are many and alike: what they have in common is one object each.
_write_rule: Final = lru_cache(maxsize=4096)(WriteRule)
_report_rule: Final = lru_cache(maxsize=4096)(ReportRule)


@lru_cache(maxsize=4096)
def _conversion(
    scale: float,
    offset: float,
    scale_from: str,
    linear: Linear | None,
    invalid: tuple[float, ...],
    valid: tuple[float, float] | None,
    names: tuple[tuple[str, int], ...],
    flags: tuple[tuple[str, int], ...],
) -> Conversion:
    return Conversion(scale, offset, scale_from, linear, invalid, valid, dict(names), dict(flags))


def checked(key: str, make: Callable[[], Result]) -> Result:
    """Call ``make``, which checks the value of a key, and return its result.

    Raises:
        FileProblems: ``make`` has raised `InvalidRequest` or `ConfigError`; its message is reported at ``key``.
    """
    try:
        return make()
    except (InvalidRequest, ConfigError) as error:
        raise FileProblems([((key,), error.message)]) from None


class LinearSection(Section):
    """``linear = { raw = [0, 27648], value = [0.0, 100.0], clamp = true }``: a linear scale of a point."""

    raw: Annotated[list[Finite], Field(min_length=2, max_length=2), "two numbers as the registers hold them."]
    value: Annotated[list[Finite], Field(min_length=2, max_length=2), "the two values that belong to them."]
    clamp: Annotated[bool, "whether what lies beyond becomes the nearer end."] = False

    @model_validator(mode="after")
    def _check(self) -> "LinearSection":
        faults = [((key,), f"has the same number twice, {getattr(self, key)[0]:g}") for key in ("raw", "value")
                  if getattr(self, key)[0] == getattr(self, key)[1]]  # fmt: skip
        if faults:
            raise FileProblems(faults)
        return self

    def described(self) -> Linear:
        """Return the scale as a `Linear` conversion of `busway.points`."""
        return Linear((self.raw[0], self.raw[1]), (self.value[0], self.value[1]), self.clamp)


class WriteSection(Section):
    """``write`` of a point: how it is written, and how the write is verified."""

    function: Annotated[Literal[5, 6, 15, 16, 22] | None, "the code of the function; None: the one that fits."] = None
    verify: Annotated[str, "`none`, `read-back`, or the address where the device shows the value."] = "none"
    step: Annotated[
        Finite | None,
        Range(0, math.inf, above=True),
        "values are whole numbers of steps above the minimum, or 0; None: any.",
    ] = None
    on: Annotated[int | None, "what the register of a switch holds where it is on; there with `off`."] = None
    off: Annotated[int | None, "what it holds where it is off."] = None
    role: Annotated[Literal["operate", "configure"], "the role that a writer of a collector needs."] = "operate"
    armed: Annotated[bool, "whether a command of a collector must be armed, and then confirmed."] = False

    @property
    def place(self) -> Literal["none", "read-back"] | Address:
        """How a write is verified: ``none``, by reading the point back, or by reading another address.

        An address is returned parsed; a text that is none raises `InvalidRequest`.
        """
        if self.verify == "none":
            return "none"
        return "read-back" if self.verify == "read-back" else parse_address(self.verify)

    @model_validator(mode="after")
    def _check(self) -> "WriteSection":
        checked("verify", lambda: self.place)
        if (self.on is None) != (self.off is None):
            raise FileProblems([(("on" if self.on is None else "off",), "is missing: a switch has both")])
        return self


def _as_report(value: object) -> object:
    return {"when": value} if isinstance(value, str) else value


def _as_deadband(value: object) -> object:
    """Return a deadband unchanged if it is a number of at least 0 or a percentage: ``0.5``, ``"1 %"``.

    Raises `ValueError` for anything else.
    """
    if isinstance(value, str) and not _DEADBAND.fullmatch(value.strip()):
        raise ValueError(f'must be a number, or percent such as "1 %", not {shown(value)}')
    if not isinstance(value, str) and (isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0):
        raise ValueError(f'must be a number of at least 0, or percent such as "1 %", not {shown(value)}')
    return value


class ReportSection(Section):
    """``report`` or ``store_report`` of a point: which samples are passed on, such as only after a change."""

    when: Annotated[Literal["every", "change", "change_or_period"], "which samples are passed on."] = "every"
    period: Annotated[
        float | None, Range(0, 1e9, above=True), "seconds, for `change_or_period`, where it must be there."
    ] = None
    deadband: Annotated[
        float | str,
        BeforeValidator(_as_deadband),
        'a change is more than this: a number in the unit of measure, or `"1 %"` of the value passed on before.',
    ] = 0.0
    max_silence: Annotated[
        float | None, Range(0, 1e9, above=True), "seconds after which a sample is passed on in any case; None: never."
    ] = None

    @model_validator(mode="after")
    def _check(self) -> "ReportSection":
        if (self.period is None) == (self.when == "change_or_period"):
            wanted = "is missing" if self.period is None else "goes only with change_or_period"
            raise FileProblems([(("period",), wanted)])
        if self.deadband and self.when == "every":
            raise FileProblems([(("deadband",), "has no effect where every sample is reported")])
        return self

    def described(self) -> ReportRule:
        """Return the section as a `ReportRule` of `busway.points`."""
        percent = _DEADBAND.fullmatch(self.deadband.strip()) if isinstance(self.deadband, str) else None
        band = float(percent[1]) if percent else float(self.deadband)
        return _report_rule(self.when, self.period, band, percent is not None, self.max_silence)


Report = Annotated[ReportSection, BeforeValidator(_as_report, json_schema_input_type=str | ReportSection)]
"""Type of a key with a report rule: a word of ``when``, or a table."""


class AlarmSection(Section):
    """``alarm`` of a point: a limit of its value, or values that are an alarm."""

    kind: Annotated[Literal["HH", "H", "L", "LL", "state"], "what it is; a point has each at most once."]
    limit: Annotated[
        Finite | None, "in the unit of measure; H above it, L below. Must be there, but not with `state`."
    ] = None
    delay: Annotated[
        float, Range(0, 1e9), "seconds for which the value has to be beyond it, or in one of the states."
    ] = 0.0
    hysteresis: Annotated[Finite, Range(0, math.inf), "how far it has to come back."] = 0.0
    acknowledge: Annotated[bool, "whether a person has to acknowledge it."] = False
    states: Annotated[
        list[bool | str],
        "with `state`, where they must be there: names of the enumeration or flags that are an alarm; `true` or",
        "`false` of one bit.",
    ] = NO_LIST

    @model_validator(mode="after")
    def _check(self) -> "AlarmSection":
        wanted, other = ("states", "limit") if self.kind == "state" else ("limit", "states")
        if not self.states if self.kind == "state" else self.limit is None:
            raise FileProblems([((wanted,), f"is missing: {self.kind} needs it")])
        for key in (other, "hysteresis") if self.kind == "state" else (other,):
            if key in self.model_fields_set:
                raise FileProblems([((key,), f"does not go with {self.kind}")])
        return self

    def described(self, names: Mapping[str, int], flags: Mapping[str, int]) -> AlarmRule:
        """Return the section as an `AlarmRule` of `busway.points`.

        Args:
            names: ``enumeration`` of the point: the number of each named state.
            flags: ``flags`` of the point: the bit of each named flag.
        """
        states = tuple(("on" if each else "off") if isinstance(each, bool) else each for each in self.states)
        numbers = frozenset(int(each) if isinstance(each, bool) else names.get(each, 0) for each in self.states)
        bits = sum(1 << flags[each] for each in set(map(str, self.states)) & flags.keys())
        return AlarmRule(
            self.kind,
            self.limit or 0.0,
            self.delay,
            self.hysteresis,
            self.acknowledge,
            states,
            frozenset() if bits else numbers,
            bits,
        )


STAND_IN: Final = "0"
"""Formula of a point that replaces an invalid one, while the other points of its section are checked."""


class WholeSection(Section):
    """Base of file sections that report all errors at once: of single keys, and of keys that do not go together."""

    def faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys of this section that do not go together, each as path and sentence.

        Called when each key by itself is valid, or has been replaced by a valid value. Subclasses override it; here it
        yields nothing.
        """
        yield from ()

    @model_validator(mode="wrap")
    @classmethod
    def _all_at_once(cls, data: Any, handler: ModelWrapValidatorHandler[Any]) -> Any:  # Any: what TOML has
        try:
            section = handler(data)
        except ValidationError as error:
            found = faults_in(error, cls)
            raise FileProblems([*found, *cls._further(data, handler, found)]) from None
        faults = list(section.faults()) if isinstance(section, WholeSection) else []
        if faults:
            raise FileProblems(faults)
        return section

    @classmethod
    def _further(
        cls, data: Any, handler: ModelWrapValidatorHandler[Any], found: Sequence[tuple[KeyPath, str]]
    ) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys that do not go together, although other keys of the section are invalid.

        For this check the invalid keys, whose paths are in ``found``, are left out or replaced by valid values
        (`stand_ins`). Errors at the invalid keys themselves are not yielded again.
        """
        broken = {path[:2] if len(path) > 1 and isinstance(path[1], int) else path[:1] for path, _ in found if path}
        if not isinstance(data, dict) or not broken:
            return
        rest = {key: value for key, value in data.items() if (key,) not in broken}
        for key, index in (each for each in broken if len(each) == 2 and each[0] in rest):
            if isinstance(rest[key], list) and key in ("point", "group"):
                rest[key] = [cls._stand_in(one) if at == index else one for at, one in enumerate(rest[key])]
            else:
                del rest[key]
        try:
            section = handler({**cls.stand_ins(), **rest})
        except ValidationError:
            return
        for path, sentence in section.faults():
            if path[:1] not in broken and path[:2] not in broken:
                yield path, sentence

    @classmethod
    def _stand_in(cls, broken: Any) -> dict[str, Any]:  # Any: what TOML has
        """Return a valid point or group with the name of an invalid one, to check the others of the section with it."""
        name = broken.get("name") if isinstance(broken, dict) else None
        point = {"name": name if isinstance(name, str) and name else "?", "formula": STAND_IN}
        return {"name": "?", "point": [point]} if isinstance(broken, dict) and "point" in broken else point

    @classmethod
    def stand_ins(cls) -> dict[str, Any]:  # Any: what TOML has
        """Return valid values for keys without a default: they replace wrong ones while the rest is checked."""
        return {}


class PointSection(WholeSection):
    """``[[unit.point]]``: one named value of a device."""

    name: Annotated[str, Name("the name of a point"), "text, one of a kind in its unit."]
    address: Annotated[
        str,
        'a notation that names the table: `"4x1"`, `"holding:0"`, `"0x1"`; one bit of a register as `"4x1.3"`, some',
        'bits of it as `"4x1.4-7"`. Must be there, or `formula`.',
    ] = ""
    formula: Annotated[
        str, "instead of an address: an expression over other points of the unit, computed by what reads it."
    ] = ""
    type: Annotated[
        str | None,
        "type of the value; not for bits. A field of bits is `uint16`, or `int16` with a sign; None: `uint16`.",
    ] = None
    order: Annotated[str, "order of bytes and registers."] = "ABCD"
    # Any: what TOML has, here and in `meta`
    value: Annotated[
        Any,
        "the first value, in the unit of measure without `scale_from`; `true` or `false` for bits; left out: zero.",
    ] = None
    unit_of_measure: Annotated[str, 'text: `"m"`, `"°C"`.'] = ""
    scale: Annotated[float, "value = what the registers hold · scale + offset; a number other than 0."] = 1.0
    offset: Annotated[Finite, "see `scale`."] = 0.0
    scale_from: Annotated[
        str,
        "name of a point; the value is multiplied with ten to the power of what that holds, -10…10 (SunSpec's scale",
        "factors).",
    ] = ""
    linear: Annotated[
        LinearSection | None,
        "instead of them, two ends of a line: `{ raw = [0, 27648], value = [0.0, 100.0], clamp = true }`.",
    ] = None
    invalid: Annotated[
        list[int | float],
        "numbers as the registers hold them that stand for no value: `[0x8000]`; of types with a sign also as the",
        "pattern of bits. NaN never is a value.",
    ] = NO_LIST
    valid: Annotated[
        Annotated[list[float], Field(min_length=2, max_length=2)] | None,
        "`[low, high]` in the unit of measure: a value outside is kept and is *uncertain*; an end may be `inf` or",
        "`-inf`.",
    ] = None
    enumeration: Annotated[
        dict[str, int], "names of numbers: `{ off = 0, auto = 1 }`; other numbers cannot be written (04)."
    ] = NO_TABLE
    flags: Annotated[
        dict[str, Annotated[int, Field(ge=0, le=63)]],
        "names of bits of a whole number, 0 the least significant: `{ overload = 0, door = 5 }`.",
    ] = NO_TABLE
    minimum: Annotated[
        Finite | None,
        "the least that may be written, in the unit of measure; what lies outside is refused (04); None: that of the",
        "type.",
    ] = None
    maximum: Annotated[Finite | None, "the most that may be written."] = None
    access: Annotated[
        Literal["read", "read-write"] | None, "`read`: Modbus cannot write it; None: what its table allows."
    ] = None
    rollover: Annotated[
        bool | Annotated[float, Field(gt=0, allow_inf_nan=False)],
        "the number at which a counter begins again from 0, in the unit of measure, or `true`: where its type ends,",
        "32768 of `int16`. Totals of programs that read it go on, also where a type with a sign goes on from its least",
        "number.",
    ] = False
    overlaps: Annotated[bool, "whether it may share registers with other points."] = False
    poll_class: Annotated[str, "how often it is read, by name; left out: that of `read` of the unit."] = ""
    write: Annotated[WriteSection | None, "how it is written; None: by the function that fits."] = None
    report: Annotated[Report, "which of its samples are handed on to sinks: a word of `when`, or a table."] = (
        ReportSection()
    )
    store_report: Annotated[
        Report | None, "which of its samples the store keeps, as `report`; None: what the collector's file says."
    ] = None
    alarm: Annotated[list[AlarmSection], "limits and states that are an alarm."] = NO_LIST
    was: Annotated[str, "the name that it had before; its history goes on. Two points may exchange their names."] = ""
    description: Annotated[str, "text, for people."] = ""
    meta: Annotated[dict[str, Any], "table of your own."] = NO_TABLE

    @classmethod
    def stand_ins(cls) -> dict[str, Any]:
        """Return valid values for keys that a point must have: they replace wrong ones while the rest is checked."""
        return {"name": "?", "address": "4x1"}

    @property
    def is_computed(self) -> bool:
        """Whether the point is computed from others and has no address."""
        return bool(self.formula)

    @cached_property
    def expression(self) -> Expression:
        """The parsed formula of a computed point. Raises `ConfigError` for an invalid one, and without a formula."""
        return parse_expression(self.formula)

    @cached_property
    def place(self) -> Address:
        """The address of the point in its table; of a bit field, the address of its register.

        Raises `InvalidRequest` for a computed point and for a text that is no address.
        """
        return parse_address(self._bits[0])

    @cached_property
    def _bits(self) -> tuple[str, int, int]:
        """The address of the point's register, and first and last bit of its bit field: ``4x1``, 4, 7 of ``4x1.4-7``.

        -1 and -1 for a point that is no bit field.
        """
        match = _FIELD.fullmatch(self.address)
        return (self.address, -1, -1) if match is None else (match["register"], int(match["low"]), int(match["high"]))

    @cached_property
    def table(self) -> Table:
        """The table that the point is in; not for a computed point, which raises `InvalidRequest`."""
        table = self.place.table
        assert table is not None  # a text that names no table is refused
        return table

    @cached_property
    def form(self) -> ValueType[Any] | None:
        """The value type of the point's registers; None for a coil, a discrete input or one bit of a register.

        Raises `InvalidRequest` for an unknown type or order, and for a computed point.
        """
        if self.table.holds_bits or self.place.bit is not None:
            return None
        _, low, high = self._bits
        if low < 0:
            return value_type(self.type or "uint16", self.order)
        if self.type not in (None, "int16", "uint16"):
            raise InvalidRequest(f"bits of a register are int16 or uint16, not {shown(self.type)}")
        return value_type(f"field:{low}-{high}{':signed' if self.type == 'int16' else ''}", self.order)

    @cached_property
    def size(self) -> int:
        """Number of registers that the point occupies, also partly; 1 for a coil or discrete input.

        Only for a point with an address: a computed one raises `InvalidRequest`.
        """
        return 1 if self.form is None else self.form.registers

    @cached_property
    def taken_bits(self) -> range:
        """The bits that the point occupies in each of its registers, 0 the least significant.

        0…15 for whole registers, and for a coil or discrete input, which has no bits of its own.
        """
        if self.place.bit is not None:
            return range(self.place.bit, self.place.bit + 1)
        kind = "" if self.form is None else self.form.name
        _, low, high = self._bits
        if kind.endswith((":low", ":high")) and "int8" in kind:
            low, high = (0, 7) if kind.endswith("low") else (8, 15)
        return range(low, high + 1) if high >= 0 else range(16)

    @property
    def is_number(self) -> bool:
        """Whether the value type is one of integers, floats, BCD or bit fields; False for a text or a single bit.

        Only for a point with an address: a computed one raises `InvalidRequest`.
        """
        return self.form is not None and self.form.name.startswith(_NUMBERS)

    @property
    def is_whole(self) -> bool:
        """Whether the value type is one of integers, BCD or bit fields, without a fraction; False for all others.

        Only for a point with an address: a computed one raises `InvalidRequest`.
        """
        return self.is_number and self.form is not None and not self.form.name.startswith("float")

    @property
    def is_writable(self) -> bool:
        """Whether Modbus can write the point: it is in a writable table and its ``access`` is not ``read``.

        False for a computed point.
        """
        return not self.is_computed and self.table.is_writable and self.access != "read"

    @cached_property
    def conversion(self) -> Conversion:
        """The conversion between raw numbers and values in the unit of measure; equal ones are one object."""
        return _conversion(
            self.scale,
            self.offset,
            self.scale_from,
            None if self.linear is None else self.linear.described(),
            tuple(self.invalid),
            None if self.valid is None else (self.valid[0], self.valid[1]),
            tuple(self.enumeration.items()),
            tuple(self.flags.items()),
        )

    @cached_property
    def described(self) -> Point:
        """The point as a `busway.points.Point`, without what depends on its unit: groups, poll class of the unit.

        `UnitSection.described` adds that.
        """
        common: dict[str, Any] = {  # Any: arguments of different types
            "unit_of_measure": self.unit_of_measure,
            "poll_class": self.poll_class,
            "reporting": self.report.described(),
            "storing": None if self.store_report is None else self.store_report.described(),
            "alarms": tuple(each.described(self.enumeration, self.flags) for each in self.alarm),
            "was": self.was,
            "description": self.description,
            **({"meta": self.meta} if self.meta else {}),
            "conversion": self.conversion,
        }
        if self.is_computed:
            return Point(self.name, Table.HOLDING_REGISTERS, 0, formula=self.formula, **common)
        form = self.form
        if form is None and self.place.bit is not None:
            form = value_type(f"bit:{self.place.bit}", self.order)
        return Point(
            self.name,
            self.table,
            self.place.offset,
            form,
            rollover=self._rollover(),
            rollover_is_scaled=self.rollover is True and bool(self.scale_from),
            writing=self._writing() if self.is_writable else None,
            **common,
        )

    def _rollover(self) -> float | None:
        if not isinstance(self.rollover, bool):
            return self.rollover
        if not self.rollover or self.form is None:
            return None
        if self.form.name.startswith("bcd"):
            return abs(self.scale) * float(10 ** (4 * self.form.registers))
        bits, signed = size_in_bits(self.form)
        return abs(self.scale) * float(1 << (bits - 1 if signed else bits))

    def _writing(self) -> WriteRule:
        write = self.write or WriteSection()
        return _write_rule(
            write.function,
            write.place,
            self.minimum,
            self.maximum,
            write.step,
            write.on,
            write.off,
            write.role,
            write.armed,
        )

    def raw(self, value: Any) -> Any:
        """Return the raw number for a value in the unit of measure, for the name of a value, or for names of flags.

        Texts and bits are returned as the registers' type takes them. The power of ten of ``scale_from`` is not
        applied, and the range of a point with ``scale_from`` is not checked.

        Raises:
            InvalidRequest: the value does not fit the type, the scale, the names or the range, or the point is
                computed.
        """
        point = self.described
        raw = point.raw(value)
        if point.form is not None:
            point.form.merge(raw, bytes(2 * point.form.registers))
        physical = self.enumeration.get(value, value) if isinstance(value, str) else value
        if isinstance(physical, int | float) and not isinstance(physical, bool) and not self.scale_from:
            self.check_range(physical)
        return raw

    def physical(self, raw: Any) -> Any:
        """Return the value in the unit of measure for a raw number; what is no number stays unchanged.

        The power of ten of ``scale_from`` is not applied, and numbers are not replaced by their names. A computed point
        raises `InvalidRequest`.
        """
        if self._converter is None or isinstance(raw, bool):
            return raw
        return self._converter(raw)

    @cached_property
    def _converter(self) -> Callable[[float], float] | None:
        """Function that converts raw numbers to values of the point; None if values are the raw numbers."""
        if not self.is_number or not self.conversion.changes:
            return None
        return converter(self.conversion, whole=self.is_whole)

    def check_range(self, value: float, exponent: int = 0) -> None:
        """Raise `InvalidRequest` if a value, in the unit of measure, is below ``minimum`` or above ``maximum``, or NaN.

        NaN is accepted if the point has neither.

        Args:
            value: the value without the power of ten of ``scale_from``.
            exponent: the value of the point that ``scale_from`` names; 0 without one.
        """
        low, high = self.minimum, self.maximum
        if exponent:
            value = value * 10.0**exponent if exponent > 0 else value / 10.0**-exponent
        if (low is not None and not value >= low) or (high is not None and not value <= high):
            raise InvalidRequest(f"must be {ranged(low, high)}, not {shown(value)}")

    def names(self) -> str:
        """Return the names of the key ``enumeration`` as text, ``off (0), auto (1)``; empty if the point has none."""
        return self.described.choices()

    def faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys of this point that do not go together, each as path and sentence."""
        return self._computed_faults() if self.formula else self._stored_faults()

    def _computed_faults(self) -> Iterator[tuple[KeyPath, str]]:
        for key in _OF_A_READ:
            if key in self.model_fields_set:
                yield (key,), f"{shown(self.name)} is computed and has no {key}"
        try:
            parse_expression(self.formula)
        except ConfigError as error:
            yield ("formula",), error.message
        yield from self._valid_faults()

    def _stored_faults(self) -> Iterator[tuple[KeyPath, str]]:
        if not self.address:
            yield ("address",), "is missing"
            return
        try:
            place = self.place
        except InvalidRequest as error:
            yield ("address",), error.message
            return
        is_bit = place.bit is not None or (place.table is not None and place.table.holds_bits)
        faults = [*(self._bit_faults(place) if is_bit else self._register_faults(place)), *self._access_faults(place)]
        yield from faults
        if faults:
            return
        yield from self._write_faults()
        yield from self._number_faults()
        yield from self._name_faults()
        yield from self._valid_faults()
        if self.value is not None:
            try:
                self.raw(self.value)
            except InvalidRequest as error:
                yield ("value",), error.message

    def _bit_faults(self, place: Address) -> Iterator[tuple[KeyPath, str]]:
        if self.type is not None:
            yield ("type",), f"{place} is one bit and has no type"
        if self._bits[1] >= 0:
            yield ("address",), f"{self.address} is no field of a register"
        for key in ("scale", "offset", "scale_from", "linear", "invalid", "valid", "enumeration", "flags", "rollover"):
            if key in self.model_fields_set and getattr(self, key) != type(self).model_fields[key].default:
                yield (key,), f"{place} is one bit and has no {key}"

    def _register_faults(self, place: Address) -> Iterator[tuple[KeyPath, str]]:
        try:
            plain = value_type(self.type or "uint16")
        except InvalidRequest as error:
            yield ("type",), error.message
            return
        try:
            value_type(self.type or "uint16", self.order)
        except InvalidRequest as error:
            yield ("order",), error.message
            return
        try:
            form = self.form
        except InvalidRequest as error:
            yield ("address" if "field" in error.message else "type",), error.message
            return
        assert form is not None
        if plain.name.startswith("bit:"):
            yield ("type",), f"one bit is written with its address, {place}.{plain.name[4:]}"
        if place.offset + form.registers > TABLE_SIZE:
            yield ("address",), f"{counted(form.registers, 'register')} from {place} on would end beyond the last one"
        if not self.scale or self.scale != self.scale or abs(self.scale) == float("inf"):
            yield ("scale",), f"must be a number other than 0, not {self.scale:g}"
        if not form.name.startswith(_NUMBERS):
            for key in ("scale", "offset", "scale_from", "linear", "rollover"):
                if getattr(self, key) != type(self).model_fields[key].default:
                    yield (key,), f"{form.name} is no number and has no {key}"

    def _access_faults(self, place: Address) -> Iterator[tuple[KeyPath, str]]:
        if self.access == "read-write" and not self.table.is_writable:
            yield ("access",), f"Modbus cannot write {self.table.label}s"
        if self.access == "read" and (place.bit is not None or self._bits[1] >= 0):
            yield ("access",), f"{self.address} can be written as its register can; give that a range in read_only"
        if self.write is not None and not self.is_writable:
            yield ("write",), f"{shown(self.name)} is only read"

    def _write_faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of ``write`` that would only show when the point is written."""
        if self.write is None:
            return
        function, form = self.write.function, self.form
        if function is not None and function not in _WRITTEN_BY[self.table.holds_bits]:
            yield ("write", "function"), f"function {function} does not write {self.table.label}s"
        elif function in (6, 22) and self.size != 1:
            yield ("write", "function"), f"{form.name if form else ''} has {self.size} registers; {function} writes one"
        for key, held in (("on", self.write.on), ("off", self.write.off)):
            if held is not None and form is not None and self.is_whole and not _can_be_read(form, held):
                yield ("write", key), f"{held} does not fit {form.name}"
        if self.write.on is not None and self.write.on == self.write.off:
            yield ("write", "off"), f"is {self.write.off}, as on"

    def _number_faults(self) -> Iterator[tuple[KeyPath, str]]:
        for key in ("minimum", "maximum"):
            if getattr(self, key) is not None and not self.is_number:
                yield (key,), f"{shown(self.name)} holds no number and has no {key}"
        if self.minimum is not None and self.maximum is not None and not self.minimum <= self.maximum:
            yield ("maximum",), f"must be at least the minimum, {self.minimum:g}, not {self.maximum:g}"
        if self.linear is not None and (self.scale != 1.0 or self.offset or self.scale_from):
            yield ("linear",), "stands instead of scale, offset and scale_from"
        if self.rollover and not self.is_whole:
            yield ("rollover",), f"{shown(self.name)} holds no whole number and does not roll over"
        if self.is_number:
            form = self.form
            for index, each in enumerate(self.invalid):
                if self.is_whole and (isinstance(each, bool) or each != int(each if math.isfinite(each) else 0)):
                    yield ("invalid", index), f"must be a whole number, as the registers hold it, not {shown(each)}"
                elif form is not None and self.is_whole and not _can_be_read(form, int(each)):
                    yield ("invalid", index), f"{shown(each)} is never read: it does not fit {form.name}"
        elif self.invalid:
            yield ("invalid",), f"{shown(self.name)} holds no number and has no invalid ones"

    def _valid_faults(self) -> Iterator[tuple[KeyPath, str]]:
        if self.valid is not None and not self.valid[0] <= self.valid[1]:
            yield ("valid",), f"must be [low, high], not {shown(self.valid)}"
        if self.valid is not None and not self.is_computed and not self.is_number:
            yield ("valid",), f"{shown(self.name)} holds no number and has no valid range"
        for index, each in enumerate(self.alarm):
            if each.kind == "state":
                yield from self._state_faults(index, each)
            elif not self.is_computed and not self.is_number:
                yield ("alarm", index), f"{shown(self.name)} holds no number and has no limits"
            if any(other.kind == each.kind for other in self.alarm[:index]):
                yield ("alarm", index, "kind"), f"{each.kind} is there already"

    def _state_faults(self, index: int, alarm: AlarmSection) -> Iterator[tuple[KeyPath, str]]:
        is_bit = not self.is_computed and self.form is None
        there = ["true", "false"] if is_bit else [*self.enumeration, *self.flags]
        if not there:
            yield ("alarm", index), f"{shown(self.name)} has no states: it is no bit, and has no enumeration or flags"
            return
        for place, each in enumerate(alarm.states):
            if isinstance(each, bool) is not is_bit or (isinstance(each, str) and each not in there):
                yield (
                    ("alarm", index, "states", place),
                    f"there is no state {shown(each)}; there are {', '.join(there)}",
                )

    def _name_faults(self) -> Iterator[tuple[KeyPath, str]]:
        if self.flags and (not self.is_whole or self.conversion.changes or self.scale_from):
            yield ("flags",), "names of bits go with whole numbers without a scale"
        if self.flags and self.enumeration:
            yield ("flags",), "goes not with enumeration: a number is one of several, or has bits"
        for name, bit in self.flags.items():
            if self.form is not None and bit >= 16 * self.form.registers:
                yield ("flags", name), f"{self.form.name} has bits 0…{16 * self.form.registers - 1}, not {bit}"
        if not self.enumeration:
            return
        if not self.is_whole or self.conversion.changes or self.scale_from:
            yield ("enumeration",), "names stand for whole numbers without a scale"
            return
        seen: dict[int, str] = {}
        for name, number in self.enumeration.items():
            if number in seen:
                yield ("enumeration", name), f"{number} is {shown(seen[number])} already"
            seen.setdefault(number, name)
            try:
                assert self.form is not None
                self.form.merge(number, bytes(2 * self.form.registers))
                self.check_range(number)
            except InvalidRequest as error:
                yield ("enumeration", name), error.message

    def moved(self, prefix: str, by: int, known: Sequence[str]) -> "PointSection":
        """Return a copy of the point for one repetition of its group, with the name and address that it has there.

        Names in ``scale_from`` and ``formula`` become full names.

        Args:
            prefix: text before its name: ``string.1.``.
            by: number of items to add to its address.
            known: full names of points around it, those of the nearest group first, which such names can mean.

        Raises:
            InvalidRequest, ValidationError: the point would not lie in its table.
        """
        keys = {name: getattr(self, name) for name in self.model_fields_set}
        keys["name"] = prefix + self.name
        if self.scale_from:
            keys["scale_from"] = resolved(self.scale_from, known)
        if self.formula:
            keys["formula"] = self.expression.renamed(lambda name: resolved(name, known))
        else:
            place = self.place
            shifted = Address(place.table, place.offset + by, place.bit)
            low, high = self._bits[1:]
            keys["address"] = format_address(shifted) + (f".{low}-{high}" if low >= 0 else "")
        return type(self).model_validate(keys)


def _can_be_read(form: ValueType[Any], number: int) -> bool:
    """Whether registers of a type for whole numbers can hold a number, or its pattern of bits."""
    bits, signed = size_in_bits(form)
    if signed and 0 <= number < 1 << bits:
        return True
    try:
        form.merge(number, bytes(2 * form.registers))
    except InvalidRequest:
        return False
    return True


def resolved(name: str, known: Sequence[str]) -> str:
    """Return the full name of the point that a name in a group means; the name itself if no known point has it.

    It is the first of ``known`` that equals the name, or ends with a dot and the name.

    Args:
        name: the name as the group has it, such as ``voltage``.
        known: full names of points around, the nearest group first, such as ``string.1.voltage``.
    """
    return next((each for each in known if each == name or each.endswith(f".{name}")), name)
