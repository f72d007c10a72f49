"""The request that reads one point alone, before or after a command, within what its device allows.

Pure: knows points, rules and requests; knows no link.

1. If the point is in a block that must be read as a whole, the block is read, and the point's part is cut out of the
   reply.
2. A point in a range that no read may include is not read.
"""

from dataclasses import dataclass
from typing import Final

from ....codes import Table
from ....errors import InvalidRequest
from ....pdu.message import Request
from ....pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from ....points.point import Point
from ....points.point_rules import ItemRange, ReadRules
from ....values.counts import counted

_READS: Final = {
    Table.COILS: ReadCoils,
    Table.DISCRETE_INPUTS: ReadDiscreteInputs,
    Table.INPUT_REGISTERS: ReadInputRegisters,
    Table.HOLDING_REGISTERS: ReadHoldingRegisters,
}


@dataclass(frozen=True, slots=True)
class PointRead:
    """The read of one point alone: its request, and where the point is in the reply.

    Attributes:
        point: the point.
        span: the items (registers or bits) that are read; more than those of the point if a block is read whole.
    """

    point: Point
    span: ItemRange

    @property
    def request(self) -> Request:
        """The request that reads the point."""
        return _READS[self.point.table](self.span.start, self.span.width)

    def own(self, data: bytes) -> bytes:
        """Return the point's own part of a reply's data: the bytes of its registers, or for a bit one byte, 0 or 1.

        Args:
            data: the data of the reply to `request`.

        Raises:
            InvalidRequest: ``data`` has more or fewer bytes than the request asked for.
        """
        first, bits = self.point.start - self.span.start, self.point.table.holds_bits
        size = (self.span.width + 7) // 8 if bits else 2 * self.span.width
        if len(data) != size:
            raise InvalidRequest(f"{counted(len(data), 'byte')} came where {size} were asked for")
        if bits:
            return bytes([data[first // 8] >> first % 8 & 1])
        return data[2 * first : 2 * (first + self.point.width)]


def point_read(point: Point, rules: ReadRules) -> PointRead:
    """Return the read of one point alone: its request, and where the point is in the reply.

    Args:
        point: the point.
        rules: the limits for reading its device.

    Raises:
        InvalidRequest: the point, or the block that must be read with it, overlaps a range that no read may include, or
            ends beyond the last address, 65535. Nothing was sent.
    """
    span = ItemRange(point.start, point.end)
    for block in rules.exact.get(point.table, ()):
        if span in block:
            span = block
    for each in rules.forbidden.get(point.table, ()):
        if each.start < span.end and span.start < each.end:
            raise InvalidRequest(f"{point.name} is written by what a read says, and no read may touch it")
    if span.end > 65_536:
        raise InvalidRequest(f"{point.name} is confirmed beyond the last item")
    return PointRead(point, span)
