"""Reports to a simulation which of its points a Modbus client has written.

Knows points and the hooks of devices; knows no behaviour. Values that do not fit a point were refused before, by
`busway.config.device_writes`.
"""

from collections.abc import Callable, Sequence

from ...codes import Table
from ...config.device_writes import PlacedItems
from ...server.device import Device
from ...server.hooks import Change
from .simulated import SimulatedPoint

Told = Callable[[Sequence[SimulatedPoint], str], None]
"""Function that is called with the points that were written, and the address of the client."""


def watch_writes(device: Device, points: Sequence[SimulatedPoint], told: Told) -> None:
    """Register a function that is called after each Modbus write that touches points of a device, from now on.

    Args:
        device: the device.
        points: the points to watch; points that clients cannot write may be among them.
        told: called with the points that were written and the address of the client.
    """
    for table in Table:
        inside = [point for point in points if point.table is table]
        if inside and table.is_writable:
            device.on_write(table, _Writes(inside, told).report, when="after")


class _Writes:
    """Reports Modbus writes to points in one table of a unit.

    Args:
        points: the points in the table.
        told: called after each write that touches some of them.
    """

    def __init__(self, points: Sequence[SimulatedPoint], told: Told) -> None:
        self._points = points
        self._items = PlacedItems([(point.address, point.address + point.form.size) for point in points])
        self._told = told

    def report(self, change: Change) -> None:
        """Report the points that a Modbus write has touched, if any. Called by the device after each write."""
        touched = self._items.touched(change.address, change.address + change.count)
        if touched:
            self._told([self._points[index] for index in touched], change.peer)
