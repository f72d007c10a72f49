"""Refuses Modbus writes that do not fit the points of a device, such as values outside their range.

Knows points and the hooks of devices.

1. A write is judged by the values that the points would have after it. If such a value is outside its point's range, or
   has no name although the point names its numbers, the write is answered with exception 04 and changes nothing.
   Exception 03 is about how a request is built, and never about a register's value (Application Protocol V1.1b3 §7).
2. A write of some of a point's registers is a write of the point. So is a write of the point that its ``scale_from``
   names, because it changes the value.
"""

from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate

from ..codes import Table
from ..errors import BadReply, InvalidRequest
from ..pdu.device_interface import Refusal
from ..pdu.write_items import pack_registers
from ..points.conversion import LARGEST_EXPONENT
from ..server.device import Device
from ..server.hooks import Change
from .files.points import PointSection


class PlacedItems:
    """The address ranges of points in one table, sorted to find quickly those that a write touches.

    Args:
        spans: the ranges, each as its first item and the item after its last one; overlaps are allowed.

    Attributes:
        order: the indices of ``spans``, sorted by the ranges: first item, then end.
    """

    def __init__(self, spans: Sequence[tuple[int, int]]) -> None:
        self.order: list[int] = sorted(range(len(spans)), key=lambda index: spans[index])
        self._spans = [spans[index] for index in self.order]
        # Points may overlap: the furthest end so far ascends, where the ends themselves need not.
        self._ends = list(accumulate((end for _, end in self._spans), max))

    def touched(self, first: int, end: int) -> list[int]:
        """Return the indices in ``spans`` of the ranges that share an item with ``first``…``end - 1``.

        They are sorted by the ranges: first item, then end.
        """
        found = []
        at = bisect_left(self._ends, first + 1)
        while at < len(self._spans) and self._spans[at][0] < end:
            if self._spans[at][1] > first:
                found.append(self.order[at])
            at += 1
        return found


def judge_writes(device: Device, points: Sequence[PointSection]) -> None:
    """Add hooks to a device that refuse Modbus writes with exception 04 if a value does not fit its point.

    Args:
        device: the device; it gets at most one hook for each writable table.
        points: its points in tables. Only those with a minimum, a maximum or named numbers are checked.
    """
    named = {point.name: point for point in points}
    limited = [(point, named.get(point.scale_from)) for point in points if _is_limited(point)]
    for table in Table:
        concerned = [each for each in limited if any(one is not None and one.table is table for one in each)]
        if concerned and table.is_writable:
            device.on_write(table, _Limits(device, table, concerned).judge)


def check_scaled(device: Device, point: PointSection, value: float, scale: PointSection) -> None:
    """Raise `InvalidRequest` if a value of a point with ``scale_from`` would be out of its range on a device now.

    Args:
        device: the device.
        point: the point.
        value: the value, without the power of ten of ``scale_from``.
        scale: the point that ``scale_from`` names.
    """
    if point.minimum is not None or point.maximum is not None:
        data = device.peek(scale.table, scale.place.offset, scale.size) or b""
        try:
            point.check_range(value, _exponent(scale, data))
        except BadReply as error:
            raise InvalidRequest(f"its scale, {scale.name}: {error.message}") from error


def _exponent(scale: PointSection, data: bytes) -> int:
    """Return the exponent, -10…10, in the registers of a point that others name in ``scale_from``.

    Args:
        scale: the point.
        data: its registers, big-endian.

    Raises:
        InvalidRequest: the number is not -10…10.
        BadReply: the registers hold no number.
    """
    assert scale.form is not None  # it holds whole numbers
    exponent: int = scale.form.decode(data)[0]
    if not -LARGEST_EXPONENT <= exponent <= LARGEST_EXPONENT:
        raise InvalidRequest(f"its scale, {scale.name}, is {exponent}, no exponent -10…10")
    return exponent


def _is_limited(point: PointSection) -> bool:
    return point.minimum is not None or point.maximum is not None or bool(point.enumeration)


class _Limits:
    """Points that have a range or named numbers, and the check of Modbus writes to one table that concern them.

    Args:
        device: the device.
        table: the table.
        points: points in the table, or with their exponent in it; each with the point that holds the exponent, or None.
    """

    def __init__(
        self, device: Device, table: Table, points: Sequence[tuple[PointSection, PointSection | None]]
    ) -> None:
        self._device = device
        placed = [(one, each) for each in points for one in each if one is not None and one.table is table]
        self._points = [each for _, each in placed]
        self._items = PlacedItems([(one.place.offset, one.place.offset + one.size) for one, _ in placed])

    def judge(self, change: Change) -> None:
        """Raise `Refusal` with exception 04 if a write would leave a value that does not fit its point."""
        for index in self._items.touched(change.address, change.address + change.count):
            point, scale = self._points[index]
            try:
                assert point.form is not None  # only numbers have ranges and names
                value = point.physical(point.form.decode(self._after(point, change))[0])
                if point.enumeration:
                    point.raw(value)
                point.check_range(value, 0 if scale is None else _exponent(scale, self._after(scale, change)))
            except (InvalidRequest, BadReply) as error:
                raise Refusal(reason=f"{point.name}: {error.message}") from error

    def _after(self, point: PointSection, change: Change) -> bytes:
        """Return the registers of a point, big-endian, as they would be after a write of all, some or none of them."""
        start = point.place.offset
        data = bytearray(self._device.peek(point.table, start, point.size) or b"")
        low, high = max(start, change.address), min(start + point.size, change.address + change.count)
        if point.table is change.table and low < high:
            items = list(change.new)[low - change.address : high - change.address]
            data[2 * (low - start) : 2 * (high - start)] = pack_registers(items)
        return bytes(data)
