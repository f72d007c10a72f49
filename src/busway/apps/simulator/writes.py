"""What Modbus writes to the points of a unit: refused where it does not fit them, told where it does.

Knows points and the hooks of devices; knows no behaviour.

1. A write is judged by the values that it would leave: outside a point's range, or a number without a name where the
   numbers have names, is answered with exception 04, and nothing has changed: 03 is about how a request is
   built, and never about a register's value (Application Protocol V1.1b3 §7).
2. A write of some of a point's registers is a write of the point.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence

from ...codes import Table
from ...errors import BadReply, InvalidRequest
from ...pdu.model import Refusal
from ...pdu.write_items import pack_registers
from ...server.device import Device
from ...server.hooks import Change
from .simulated import SimulatedPoint

Told = Callable[[Sequence[SimulatedPoint], str], None]
"""Called with the points that were written, and with who wrote."""


def watch_writes(device: Device, points: Sequence[SimulatedPoint], told: Told) -> None:
    """Judge and tell all writes to some points of a device from now on."""
    for table in Table:
        inside = [point for point in points if point.table is table]
        if inside and table.is_writable:
            writes = _Writes(inside, told)
            device.on_write(table, writes.judge)
            device.on_write(table, writes.tell, when="after")


class _Writes:
    """Writes to one table of one unit.

    Args:
        points: those that stand in it.
        told: called after each write that touches some.
    """

    def __init__(self, points: Sequence[SimulatedPoint], told: Told) -> None:
        self._points = sorted(points, key=lambda point: point.address)
        self._ends = [point.address + point.form.size for point in self._points]
        self._told = told

    def _touched(self, change: Change) -> Sequence[SimulatedPoint]:
        # Points are disjoint but for bits of one register, so their ends ascend as their starts do.
        first = bisect_left(self._ends, change.address + 1)
        end = change.address + change.count
        last = first
        while last < len(self._points) and self._points[last].address < end:
            last += 1
        return self._points[first:last]

    def judge(self, change: Change) -> None:
        """Refuse what does not fit a point."""
        for point in self._touched(change):
            section = point.section
            if section.minimum is None and section.maximum is None and not section.enumeration:
                continue
            try:
                value = section.physical(_after(point, change))
                if section.enumeration:
                    section.raw(value)
                section.check_range(value)
            except (InvalidRequest, BadReply) as error:
                raise Refusal(reason=f"{point.key}: {error.message}") from error

    def tell(self, change: Change) -> None:
        """Say what was written."""
        touched = self._touched(change)
        if touched:
            self._told(touched, change.peer)


def _after(point: SimulatedPoint, change: Change) -> float:
    """What the registers of a point would hold after a write, as a number of its type."""
    form = point.form.form
    assert form is not None  # only numbers have ranges and names
    registers = list(change.new)
    data = bytearray(point.device.peek(point.table, point.address, point.form.size) or b"")
    low = max(point.address, change.address)
    high = min(point.address + point.form.size, change.address + change.count)
    items = registers[low - change.address : high - change.address]
    data[2 * (low - point.address) : 2 * (high - point.address)] = pack_registers(items)
    number: float = form.decode(bytes(data))[0]
    return number
