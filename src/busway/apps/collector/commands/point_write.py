"""The request that writes a value to a point, and the check whether the device shows the value afterwards.

Pure: knows points, requests and replies; knows no link and no clock.

1. All checks of a value come before anything is sent: writable, type, scale, names, minimum, maximum, step. Nothing is
   rounded, and no text is taken for a number.
2. If a point is only some bits of a register, the register is read just before, so that its other bits keep their
   values; with function 22 the device itself keeps them.
3. Only a reply proves that a write was executed. An exception proves that it was not, apart from codes 05 and 0B (see
   `judged`). In every other case the outcome is unknown, unless nothing was sent.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from ....codes import ExceptionCode, Table
from ....errors import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkDown,
    ModbusError,
    NoReply,
    Overloaded,
)
from ....pdu.message import Request
from ....pdu.write_items import (
    MaskWriteRegister,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ....points.decoder import decode_point
from ....points.point import Point
from ....points.point_rules import ReadRules
from ....points.quality import Quality, Reading
from ....values import Address, value_type
from ....values.unfit_values import shown
from .command import CommandState, CommandValue
from .point_read import PointRead, point_read

_FUNCTIONS: Final[Mapping[Table, frozenset[int]]] = {
    Table.COILS: frozenset({5, 15}),
    Table.HOLDING_REGISTERS: frozenset({6, 16, 22}),
}


@dataclass(frozen=True, slots=True)
class PointWrite:
    """A value for a point that passed its checks, with the request that writes it.

    Attributes:
        point: the point.
        value: the value to write.
        exponents: values of points that other points name in ``scale_from``, by name: exponents of ten.
        function: the function code of the write: 5, 6, 15, 16 or 22.
        before: the read that must come first, because the point is only some bits of its register; None if none is
            needed.
        shown: the read of the place where the device shows the written value; None if the point's rule asks for no
            check.
    """

    point: Point
    value: CommandValue
    exponents: Mapping[str, int]
    function: int
    before: PointRead | None = None
    shown: PointRead | None = None

    def request(self, held: bytes = b"") -> Request:
        """Return the request that writes the value.

        Args:
            held: the register's bytes as ``before`` read them; empty if nothing had to be read.

        Raises:
            InvalidRequest: the value cannot be encoded as the point's type.
        """
        point = self.point
        data = self._encoded(held)
        if point.table is Table.COILS:
            state = bool(data[0])
            if self.function == 5:
                return WriteSingleCoil.of(point.start, state)
            return WriteMultipleCoils.of(point.start, [state])
        if self.function == 6:
            return WriteSingleRegister(point.start, int.from_bytes(data, "big"))
        if self.function == 22:
            own = _own_bits(self._encoded(b""), self._encoded(b"\xff\xff"))
            return MaskWriteRegister(point.start, 0xFFFF & ~own, int.from_bytes(data, "big") & own)
        return WriteMultipleRegisters(point.start, len(data) // 2, data)

    def _encoded(self, held: bytes) -> bytes:
        exponent = self.exponents.get(self.point.conversion.scale_from, 0)
        return self.point.encode(self.value, held, exponent)

    def held_value(self, held: bytes) -> CommandValue | None:
        """Decode the bytes ``held`` of the point's registers and return the value; None if they hold no value."""
        return plain(decode_point(self.point, held, self.exponents).value)

    # Confirming.

    def shows(self, data: bytes) -> tuple[bool, Reading]:
        """Compare data that was read back with the written value. Call it only if ``shown`` is not None.

        Args:
            data: the bytes that the read ``shown`` returned for its point (`PointRead.own`).

        Returns:
            Whether the data are the written value, False if they hold no value; and the value that was decoded from
                them, with its quality.
        """
        assert self.shown is not None
        place = self.shown.point
        found = decode_point(place, data, self.exponents)
        is_switch = place.type == "bit" and self.point.type != "bit"
        expected = self.value if is_switch else self.reading().value
        return found.value is not None and expected == found.value, found

    def reading(self) -> Reading:
        """Return the value, with its quality, that a read of the point would decode after the write."""
        return decode_point(self.point, self._encoded(b""), self.exponents)


def point_write(
    point: Point, value: CommandValue, exponents: Mapping[str, int], rules: ReadRules | None = None
) -> PointWrite:
    """Check a value for a point, and return it with the request that writes it.

    Args:
        point: the point.
        value: a number in the unit of measure, a state, a text, the name of a number, or a list of names of flags.
        exponents: values of points that other points name in ``scale_from``, by name: exponents of ten.
        rules: the limits for reading the device; None for no limits.

    Raises:
        InvalidRequest: the point is read-only, the value is against its rule or type, its scale (``scale_from``) was
            not read yet, the function of its rule cannot write it, or a read before or after the write is not allowed.
            Nothing was sent.
    """
    rule = point.writing
    if rule is None or point.formula:
        raise InvalidRequest(f"{point.name} is only read")
    if rule.on is not None and not isinstance(value, bool):
        raise InvalidRequest(f"{point.name} is a switch: true or false, not {shown(value)}")
    scale_from = point.conversion.scale_from
    if scale_from and scale_from not in exponents:
        raise InvalidRequest(f"{scale_from}, the scale of {point.name}, has not been read yet")
    made = PointWrite(point, value, exponents, _function_of(point))
    made.request()
    _check_number(made)
    rules = rules or ReadRules()
    is_part = point.form is not None and point.form.is_part and made.function != 22
    place = point if rule.verify == "read-back" else None if rule.verify == "none" else _moved(point, rule.verify)
    return replace(
        made,
        before=point_read(point, rules) if is_part else None,
        shown=None if place is None else point_read(place, rules),
    )


def _check_number(made: PointWrite) -> None:
    """Raise `InvalidRequest` for a number outside the limits of the point's rule, or one that means "no value".

    If the point's linear scale is clamped, its range is a limit too. Values of switches and of points that are no
    numbers are not checked.
    """
    point, conversion, rule = made.point, made.point.conversion, made.point.writing
    assert rule is not None
    if rule.on is not None or not point.is_number:
        return
    number = conversion.names.get(made.value, made.value) if isinstance(made.value, str) else made.value
    if isinstance(number, list):  # names of flags
        number = point.raw(number)
    assert isinstance(number, int | float)
    rule.check(number)
    if conversion.linear is not None and conversion.linear.clamp:
        low, high = sorted(conversion.linear.value)
        if not low <= number <= high:
            raise InvalidRequest(f"must be {low:g}…{high:g}, not {shown(number)}")
    if made.reading().quality is Quality.BAD:
        raise InvalidRequest(f"{shown(made.value)} stands for no value at {point.name}")


def _function_of(point: Point) -> int:
    rule = point.writing
    assert rule is not None
    allowed = _FUNCTIONS.get(point.table)
    if allowed is None:
        raise InvalidRequest(f"{point.name} is only read: Modbus cannot write {point.table.label}s")
    chosen = rule.function
    if chosen is None:
        return 5 if point.table is Table.COILS else 6 if point.width == 1 else 16
    if chosen not in allowed:
        raise InvalidRequest(f"{point.name}: function {chosen} does not write {point.table.label}s")
    if chosen in (6, 22) and point.width != 1:
        raise InvalidRequest(f"{point.name} has {point.width} registers, and function {chosen} writes one")
    return chosen


def plain(value: Any) -> CommandValue | None:  # what the point's type says
    """Return a decoded value of a point as commands record it: a tuple becomes a list, all others are unchanged."""
    return list(value) if isinstance(value, tuple) else value


def _moved(point: Point, address: Address) -> Point:
    """Return a copy of a point at another address: the one where its written value is read back.

    At the address of a bit, the copy is a state without the point's scale and names.

    Raises:
        InvalidRequest: the address is a register, and the point is one bit.
    """
    table = address.table or point.table
    if table.holds_bits:
        return Point(point.name, table, address.offset)
    if address.bit is not None:
        return Point(point.name, table, address.offset, value_type(f"bit:{address.bit}"))
    if point.form is None:
        raise InvalidRequest(f"{point.name} is one bit, and is confirmed at {address}, which is a register")
    return replace(point, table=table, start=address.offset)


def _own_bits(over_zeros: bytes, over_ones: bytes) -> int:
    """Return a mask of the bits of a register that belong to a point.

    Args:
        over_zeros: the register with the point's value written into zeros.
        over_ones: the register with the same value written into ones.
    """
    kept = int.from_bytes(over_zeros, "big") ^ int.from_bytes(over_ones, "big")
    return 0xFFFF & ~kept


def judged(outcome: object) -> tuple[CommandState, str]:
    """Return the state of a command and the reason for it, from the outcome of its write.

    The state is `CommandState.DONE` if the device has accepted the write (also with exception 05, acknowledge),
    `CommandState.FAILED` if the write was refused or not sent, `CommandState.UNKNOWN` if it may have been executed.

    Args:
        outcome: the reply, or the error in place of one.

    Returns:
        The state; and a sentence, why the command is not done or a remark, empty if there is nothing to say.
    """
    if not isinstance(outcome, ModbusError):
        return CommandState.DONE, ""
    if isinstance(outcome, ExceptionReply):
        if outcome.code == ExceptionCode.ACKNOWLEDGE:
            return CommandState.DONE, "the device has accepted it and needs time"
        if outcome.code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND:
            return CommandState.UNKNOWN, f"it may have been executed: {outcome}"
        return CommandState.FAILED, str(outcome)
    if was_not_sent(outcome):
        return CommandState.FAILED, f"nothing was sent: {outcome}"
    return CommandState.UNKNOWN, str(outcome)


def was_not_sent(error: ModbusError) -> bool:
    """Whether an error proves that no byte of a write was sent, so that it was certainly not executed.

    True for `NoReply`: a write that was sent and not answered ends with `WriteOutcomeUnknown` instead.
    """
    if isinstance(error, LinkDown):
        return not error.sent
    if isinstance(error, BadReply):
        return False
    return isinstance(error, InvalidRequest | ConfigError | Overloaded | NoReply)
