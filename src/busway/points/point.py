"""A point: one named value of a device, which others call a tag.

Knows its address and type, how its raw number becomes a value, and the rules for it; knows no device, no request and no
file. `decoder` decodes points.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ..codes import Table
from ..errors import InvalidRequest
from ..values import Address, ValueType
from ..values.orders import BytesLike
from ..values.unfit_values import shown
from .conversion import Conversion, value_of
from .point_rules import AlarmRule, ReportRule, WriteRule

_WHOLE: Final = ("int", "uint", "bcd", "field")
_PLAIN: Final = Conversion()
_NO_META: Final[Mapping[str, Any]] = {}
_EVERY_READ: Final = ReportRule()


@dataclass(frozen=True, slots=True)
class Point:
    """One named value of a device: its address, type, conversion and rules.

    Attributes:
        name: its name, unique in the device.
        table: its table; holding registers for a computed point, which is in no table.
        start: its first register or bit, 0-based.
        form: the value type of its registers, also for one bit of a register (``bit:3``); None for a coil or discrete
            input.
        conversion: how raw numbers become values.
        unit_of_measure: ``V``, ``°C``; empty for none.
        group: name of its atomic group, which is read in one request; None for none.
        exists: for each repeated group around the point whose size the device reports: the name of the point that holds
            the size, and the position of this point's member in the group, from 1 on.
        is_exponent: whether another point names this one in ``scale_from``; decoders then remember its value.
        formula: the expression of a computed point; empty for a point that is read.
        rollover: the value at which an accumulator restarts at 0, in the unit of measure; None for other points.
        rollover_is_scaled: whether ``rollover`` has to be multiplied by the power of ten of ``scale_from``: it is the
            limit of the registers' type.
        poll_class: name of the poll class with which it is read; empty for that of its device.
        writing: which values may be written, and how; None if the point is read-only.
        reporting: which of its samples go to sinks that have no rule of their own.
        storing: which of its samples a store keeps; None for the rule of its device, its poll class or the collector.
        alarms: its alarm limits.
        was: its former name, whose stored samples belong to this point too; empty for none.
        description: what it is, for people.
        meta: further facts from its file.
    """

    name: str
    table: Table
    start: int
    form: ValueType[Any] | None = None
    conversion: Conversion = _PLAIN
    unit_of_measure: str = ""
    group: str | None = None
    exists: tuple[tuple[str, int], ...] = ()
    is_exponent: bool = False
    formula: str = ""
    rollover: float | None = None
    rollover_is_scaled: bool = False
    poll_class: str = ""
    writing: WriteRule | None = None
    reporting: ReportRule = _EVERY_READ
    storing: ReportRule | None = None
    alarms: tuple[AlarmRule, ...] = ()
    was: str = ""
    description: str = ""
    meta: Mapping[str, Any] = field(default_factory=lambda: _NO_META)  # Any: what TOML has

    @property
    def width(self) -> int:
        """Number of registers or bits that the point occupies in its table; 0 for a computed point."""
        return 0 if self.formula else 1 if self.form is None else self.form.registers

    @property
    def end(self) -> int:
        """The offset after the last register or bit of the point."""
        return self.start + self.width

    @property
    def type(self) -> str:
        """Name of the point's value type, such as ``float32``; ``bit`` for one bit, ``float64`` if it is computed."""
        if self.formula:
            return "float64"
        return "bit" if self.form is None or self.form.name.startswith("bit:") else self.form.name

    @property
    def order(self) -> str:
        """Byte and register order of the point in letters; empty for one bit, and for a computed point."""
        return "" if self.form is None or self.type == "bit" else self.form.order

    @property
    def address(self) -> Address:
        """Address of the point in its table."""
        name = "" if self.form is None else self.form.name
        bit = int(name[4:]) if name.startswith("bit:") else None
        return Address(self.table, self.start, bit)

    @property
    def is_whole(self) -> bool:
        """Whether raw numbers are integers: an integer, BCD or bit field as value type. False for a computed point."""
        return self.form is not None and self.form.name.startswith(_WHOLE)

    @property
    def is_number(self) -> bool:
        """Whether values are numbers: a computed point, or an integer, float, BCD or bit field as value type."""
        return bool(self.formula) or self.is_whole or (self.form is not None and self.form.name.startswith("float"))

    def encode(self, value: Any, held: BytesLike = b"", exponent: int = 0) -> bytes:
        """Return the registers or bits that hold a value of the point, for a write.

        Args:
            value: the value in the unit of measure; or the name of a value, ``auto``; or the names of the flags to set.
            held: the present bytes of its registers, for a point that is only a part of a register; empty for zeros.
            exponent: the value of the point that ``scale_from`` names; 0 without one.

        Returns:
            Registers in wire order, with the other bits as in ``held``; for a coil one byte, 0 or 1.

        Raises:
            InvalidRequest: the value does not fit the type, the scale or the names, or the point is computed.
        """
        raw = self.raw(value, exponent)
        if self.form is None:
            return bytes([raw])
        return self.form.merge(raw, held or bytes(2 * self.form.registers))

    def raw(self, value: Any, exponent: int = 0) -> Any:
        """Return the raw number to write for a value in the unit of measure.

        If values of the point's type are no numbers but texts, for example, the value is returned unchanged.

        Args:
            value: the value, the name of a value, or the names of the flags to set; a bool for a switch.
            exponent: the value of the point that ``scale_from`` names; 0 without one.

        Raises:
            InvalidRequest: the value does not fit the scale or the names, is no bool where the point is one bit, or the
                point is computed.
        """
        if self.formula:
            raise InvalidRequest(f"{self.name} is computed and holds nothing")
        if isinstance(value, bool) and self.writing is not None and self.writing.on is not None:
            return self.writing.on if value else self.writing.off
        if self.type == "bit":
            if not isinstance(value, bool):
                raise InvalidRequest(f"one bit is true or false, not {shown(value)}")
            return value
        value = self._number_of(value)
        if not self.is_number:
            return value
        return self.conversion.raw(value, whole=self.is_whole, exponent=exponent)

    def value(self, raw: Any) -> Any:
        """Return the value in the unit of measure for a raw number, without ``scale_from``. Texts stay unchanged."""
        if not self.is_number or isinstance(raw, bool):
            return raw
        return value_of(self.conversion, raw, whole=self.is_whole)

    def _number_of(self, value: Any) -> Any:
        """Return the number for the name of a value, or for names of flags; any other value is returned unchanged.

        Raises `InvalidRequest` for an unknown name, and, if values have names, for a number without a name.
        """
        conversion = self.conversion
        if conversion.names:
            if isinstance(value, str):
                if value not in conversion.names:
                    raise InvalidRequest(f"there is no {shown(value)}; there are {', '.join(conversion.names)}")
                return conversion.names[value]
            if isinstance(value, bool) or value not in conversion.names.values():
                raise InvalidRequest(f"must be {self.choices()}, not {shown(value)}")
        if conversion.flags and isinstance(value, list | tuple | set | frozenset):
            unknown = [each for each in value if each not in conversion.flags]
            if unknown:
                raise InvalidRequest(f"there is no flag {shown(unknown[0])}; there are {', '.join(conversion.flags)}")
            number = sum(1 << conversion.flags[each] for each in set(value))
            bits = 16 * self.width
            return (
                number - (1 << bits)
                if self.form and self.form.name.startswith("int") and number >> bits - 1
                else number
            )
        return value

    def choices(self) -> str:
        """Return the names of the point's values with their numbers, as text: ``off (0), auto (1)``."""
        return ", ".join(f"{name} ({number})" for name, number in self.conversion.names.items())

    def label(self, value: Any) -> str:
        """Return the name of a value of the point, or the names of the flags set in it, joined by ``, ``.

        Empty if the value has no name or no flag is set, and for a bool and every value that is no ``int``.
        """
        conversion = self.conversion
        if isinstance(value, bool) or not isinstance(value, int):
            return ""
        if conversion.flags:
            return ", ".join(name for name, bit in conversion.flags.items() if value >> bit & 1)
        return next((name for name, number in conversion.names.items() if number == value), "")

    def renamed(self, name: str) -> "Point":
        """Return a copy of the point with another name."""
        return replace(self, name=name)

    def __hash__(self) -> int:
        return hash((self.name, self.table, self.start, self.form))
