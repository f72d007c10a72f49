"""Refuses Modbus writes that do not fit the points of a device, such as values outside their range.

Knows points and the hooks of devices.

1. A write is judged by the values that the points would have after it. If such a value is outside its point's range, or
   has no name although the point names its numbers, the write is answered with exception 04 and changes nothing.
   Exception 03 is about how a request is built, and never about a register's value (Application Protocol V1.1b3 §7).
2. A write of some of a point's registers is a write of the point.
"""

from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

from ..codes import Table
from ..errors import BadReply, InvalidRequest
from ..pdu.model import Refusal
from ..pdu.write_items import pack_registers
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
    for table in Table:
        limited = [point for point in points if point.table is table and _is_limited(point)]
        if limited and table.is_writable:
            device.on_write(table, _Limits(device, limited).judge)


def _is_limited(point: PointSection) -> bool:
    return point.minimum is not None or point.maximum is not None or bool(point.enumeration)


class _Limits:
    """The points of one table that have a range or named numbers, and the check of Modbus writes to them."""

    def __init__(self, device: Device, points: Sequence[PointSection]) -> None:
        self._device = device
        self._points = points
        self._items = PlacedItems([(point.place.offset, point.place.offset + point.size) for point in points])

    def judge(self, change: Change) -> None:
        """Raise `Refusal` with exception 04 if a write would leave a value that does not fit its point."""
        for index in self._items.touched(change.address, change.address + change.count):
            point = self._points[index]
            try:
                value = point.physical(self._after(point, change))
                if point.enumeration:
                    point.raw(value)
                point.check_range(value)
            except (InvalidRequest, BadReply) as error:
                raise Refusal(reason=f"{point.name}: {error.message}") from error

    def _after(self, point: PointSection, change: Change) -> Any:  # what the point's type says
        """Return the raw number that a point's registers would hold after a write of all or some of them."""
        form, start = point.form, point.place.offset
        assert form is not None  # only numbers have ranges and names
        registers = list(change.new)
        data = bytearray(self._device.peek(point.table, start, point.size) or b"")
        low, high = max(start, change.address), min(start + point.size, change.address + change.count)
        items = registers[low - change.address : high - change.address]
        data[2 * (low - start) : 2 * (high - start)] = pack_registers(items)
        return form.decode(bytes(data))[0]
