"""Builds the devices of a server from the contents of device files.

Knows the schema and `Device`; reads no file.
"""

import struct
from collections.abc import Sequence
from typing import Any

from ..codes import Table
from ..server.device import Device
from ..server.table_declaration import Cells
from .device_writes import check_scaled, judge_writes
from .files.device import DeviceFile, TableSection, UnitSection
from .files.points import PointSection


def build_units(file: DeviceFile) -> dict[int, Device]:
    """Build the devices that a device file declares; returns them by unit number, each with its own memory."""
    return {number: build_device(section) for section in file.unit for number in section.unit}


def build_device(section: UnitSection) -> Device:
    """Build the device of one unit of a device file, with the initial values of its points.

    Modbus writes that do not fit a point are refused (`judge_writes`).
    """
    # Any: arguments of different types
    options: dict[str, Any] = {
        table.value: _cells(section.table(table), section.points_in(table), section.hole(table)) for table in Table
    }
    if section.server_id is not None:
        options["server_id"] = section.server_id
    device = Device(
        files={file.number: _declared(file, file.read_only) for file in section.file},
        fifos={fifo.place.offset: fifo.values for fifo in section.fifo},
        identification=section.objects(),
        exception_status=section.exception_status,
        functions=section.functions,
        **options,
    )
    points = [each.section for each in section.stored]
    for point in points:
        if point.value is not None:
            put_value(device, point, point.value)
    judge_writes(device, points)
    return device


def put_value(
    device: Device,
    point: PointSection,
    value: Any,  # what the point's type says
    scale: PointSection | None = None,
) -> None:
    """Write the value of a point, in its unit of measure, into a device; no hook is called.

    Args:
        device: the device.
        point: the point.
        value: the value, without the power of ten of ``scale_from``.
        scale: the point that ``scale_from`` names, whose exponent counts for the range of the value. With None, the
            range of a point with ``scale_from`` is not checked.

    Raises:
        InvalidRequest: the value does not fit the point.
    """
    raw = point.raw(value)
    if scale is not None:
        check_scaled(device, point, value, scale)
    form = point.form
    if form is None or not form.is_part:
        device.write(point.place, raw if form is None else [raw], form)  # sixteen bits are one value
        return
    with device.lock:
        held = device.peek(point.table, point.place.offset, form.registers) or b""
        device.write(point.place, list(struct.unpack(f">{form.registers}H", form.merge(raw, held))))


def _cells(declared: TableSection | None, points: Sequence[PointSection], hole: int | None) -> Cells | None:
    """Return the memory of a table: the items that the file declares, else those of its points and of the gaps between.

    None if the file declares no such table and no points in it. Items of points that are not writable are read-only.

    Args:
        declared: the declaration of the table; None without one. Its items have the declared initial values.
        points: the points in the table. Without a declaration their items are 0 at first.
        hole: without a declaration, the value that is read in the gaps, which Modbus cannot write; None: the gaps have
            no items.
    """
    read_only = [
        [point.place.offset, point.size] for point in points if point.table.is_writable and not point.is_writable
    ]
    if declared is not None:
        return _declared(declared, [*declared.read_only, *read_only])
    values = {offset: 0 for point in points for offset in range(point.place.offset, point.place.offset + point.size)}
    if not values:
        return None
    if hole is not None:
        holes = [offset for offset in range(min(values), max(values)) if offset not in values]
        values |= dict.fromkeys(holes, hole)
        read_only += _ranges(holes)
    return Cells(values=dict(sorted(values.items())), read_only=_pairs(read_only))


def _ranges(offsets: Sequence[int]) -> list[list[int]]:
    """Join consecutive offsets to ranges: ``1, 2, 3, 7`` gives ``[1, 3], [7, 1]``, each first offset and count."""
    found: list[list[int]] = []
    for offset in offsets:
        if found and offset == sum(found[-1]):
            found[-1][1] += 1
        else:
            found.append([offset, 1])
    return found


def _declared(table: TableSection, read_only: Sequence[Sequence[int]]) -> Cells:
    return Cells(table.first, table.size, table.values, _pairs(read_only))


def _pairs(ranges: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    return [(first, count) for first, count in ranges]
