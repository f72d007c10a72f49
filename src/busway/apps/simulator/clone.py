"""Clones a device: reads a live device and makes a simulation file that imitates it.

Knows how a device is read, and how the result is declared; knows no connection, no file and no command line. It never
writes to the device.

1. With a register map each of its points is read once, and the file has the points with the values that were read.
2. Without one the tables are read in blocks. A block that is refused is divided until it is known of each item whether
   it exists. If a whole block is refused, single items in it are tried first (`STRIDE`), so that empty tables cost
   little. ``thorough`` divides every block.
3. A value is recorded in its unit of measure if writing it gives the same registers again, and as registers otherwise:
   the clone gives the same replies as the device.
4. If a device is watched for a while, numbers that changed get a behaviour: one that only grew, and is no float,
   becomes a counter with the observed rate, any other number a random walk within the observed range. Bits and numbers
   with names stay constant.
5. A point that the device refuses is left out, and a remark says so. A device that does not answer ends the cloning;
   the error names the point or range that was asked for.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from ...client.blocking import BlockingUnit
from ...codes import MAX_READ_BITS, MAX_READ_REGISTERS, ExceptionCode, Table
from ...config.files.behaviours import FASTEST, SLOWEST
from ...config.files.device import OBJECT_NUMBERS
from ...config.files.simulation import SimulatedPointSection, SimulatedUnitSection
from ...errors import BadReply, ExceptionReply, InvalidRequest, ModbusError
from ...values import Address, ValueType, format_address
from ...values.counts import counted
from .recorded_tables import item_keys

Offered = TypeVar("Offered")
Progress = Callable[[str], None]

RANGES: Final = (range(10_000), range(40_000, 41_000))
"""Addresses, counted from 0, that are read without a map: most devices have no others, and SunSpec begins at 40000."""
STRIDE: Final = 10
"""In a block that the device refuses as a whole, every tenth item is read by itself: maps prefer round numbers."""
_HOLES: Final = frozenset(
    (
        ExceptionCode.ILLEGAL_DATA_ADDRESS,
        ExceptionCode.ILLEGAL_DATA_VALUE,
        ExceptionCode.SERVER_DEVICE_FAILURE,
    )
)
"""Exception codes of devices for a range that they do not have, or have only in part. Codes 03 and 04 contradict the
specification (Application Protocol V1.1b3 §7)."""
_UNNAMED_UNITS: Final = (0, 255)
"""Unit identifiers that name no particular unit on TCP; a clone gets unit 1 then."""
_LEVELS: Final = ("extended", "regular", "basic")


@dataclass(slots=True)
class Clone:
    """A recording of a live device as a unit of a simulation file, with remarks on what differs.

    Attributes:
        section: the unit with its points or tables, to be written into a device file.
        remarks: a sentence for each part of the device that could not be recorded as it is, with the reason.
    """

    section: SimulatedUnitSection
    remarks: list[str] = field(default_factory=list)


def clone_points(
    unit: BlockingUnit, points: Sequence[SimulatedPointSection], *, progress: Progress = lambda line: None
) -> Clone:
    """Clone a unit of a live device by the points of a register map, each read once.

    Args:
        unit: the unit of the live device.
        points: the points to read.
        progress: called now and then with a line of text about the progress.

    Raises:
        ModbusError: the device did not answer, or refused every point; the error names the point.
    """
    remarks: list[str] = []
    keys = _identity(unit, progress)
    recorder = _Recorder(unit)
    found: list[SimulatedPointSection] = []
    refusal: ExceptionReply | None = None
    for number, point in enumerate(points, 1):
        try:
            found += recorder.record(point, remarks)
        except ExceptionReply as error:
            error.message = f"point {point.name} at {point.place}: {error.message}"
            refusal = refusal or error
            remarks.append(f"left out: {error.message}")
        except ModbusError as error:
            error.message = f"point {point.name} at {point.place}: {error.message}"
            raise
        if number % 100 == 0:
            progress(f"{number} of {counted(len(points), 'point')}")
    if refusal is not None and not found:
        raise refusal
    progress(counted(len(found), "point"))
    found += recorder.unnamed_bits()
    return Clone(SimulatedUnitSection.model_validate({**keys, "point": [_keys_of(each) for each in found]}), remarks)


def clone_tables(
    unit: BlockingUnit,
    *,
    ranges: Sequence[range] = RANGES,
    thorough: bool = False,
    progress: Progress = lambda line: None,
) -> Clone:
    """Clone a unit of a live device by reading all items that its tables have in some ranges.

    Args:
        unit: the unit of the live device.
        ranges: ranges of addresses to read in each table, within 0…65535.
        thorough: whether each block that the device refuses is searched item by item. Otherwise this is done only if
            one of every `STRIDE` items, tried first, exists.
        progress: called now and then with a line of text about the progress.

    Raises:
        ModbusError: the device did not answer, or has no item in these ranges; the error names table and addresses.
    """
    keys = _identity(unit, progress)
    remarks: list[str] = []
    found: dict[Table, dict[int, int]] = {}
    refusal: ExceptionReply | None = None
    for table in Table:
        items: dict[int, int] = {}
        scanner = _Scanner(unit, table, thorough=thorough)
        for part in ranges:
            progress(f"{table.label}s {part.start}…{part.stop - 1}")
            items.update(scanner.items(part))
            if not scanner.offered:
                remarks.append(f"{table.label}s are not offered")
                break
        refusal = scanner.refusal or refusal
        found[table] = items
        sampled = f"; in {counted(scanner.sampled, 'refused block')} only every tenth item was tried"
        progress(counted(len(items), table.label) + (sampled if scanner.sampled else ""))
    if not any(found.values()):
        if refusal is None:
            raise InvalidRequest("there is nothing to clone in no range at all")
        refusal.message = f"nothing to clone, everything was refused; the last time {refusal.message}"
        raise refusal
    return Clone(SimulatedUnitSection.model_validate(keys | item_keys(found)), remarks)


def watch_points(
    unit: BlockingUnit, clone: Clone, moments: Iterable[float], *, progress: Progress = lambda line: None
) -> Clone:
    """Return a clone with behaviours added, learnt by reading the live device's points again and again.

    Args:
        unit: the unit of the live device.
        clone: the clone, just made by `clone_points`; it is not changed.
        moments: times of the reads in seconds since `clone_points`, ascending. The iterable itself waits for each time
            before it yields it.
        progress: called with a line of text at the end.

    Raises:
        ModbusError: the device did not answer, or refuses a point now; the error names the point.
    """
    watched = [_Watched(point, point.value) for point in clone.section.point if point.is_number]
    watched = [each for each in watched if not each.point.enumeration]
    for moment in moments:
        for each in watched:
            each.see(_read_again(unit, each.point), moment)
    progress(f"{sum(each.has_changed for each in watched)} of {len(watched)} numbers changed")
    learnt = {each.point.name: each.learnt() for each in watched}
    points = [learnt.get(point.name, point) for point in clone.section.point]
    keys = {key: getattr(clone.section, key) for key in clone.section.model_fields_set}
    return Clone(clone.section.model_copy(update={**keys, "point": points}), clone.remarks)


def _read_again(unit: BlockingUnit, point: SimulatedPointSection) -> float:
    try:
        return float(point.physical(unit.read(point.place, point.form)))
    except ModbusError as error:
        error.message = f"point {point.name} at {point.place}: {error.message}"
        raise


class _Watched:
    """The changes of one number of a live device, as observed by reading it again and again.

    Args:
        point: the point that has the number.
        value: the number at time 0, in the unit of measure.
    """

    def __init__(self, point: SimulatedPointSection, value: float) -> None:
        self.point = point
        self._first = self._last = self._low = self._high = float(value)
        self._step = self._time = 0.0
        self._moments = 0
        self._fell = False

    @property
    def has_changed(self) -> bool:
        """Whether the watched number has had more than one value."""
        return self._low < self._high

    def see(self, value: float, time: float) -> None:
        """Record the watched number's value at a time, in seconds since the first value; NaN is ignored."""
        if value != value:  # not a number
            return
        self._step = max(self._step, abs(value - self._last))
        self._fell = self._fell or value < self._last
        self._low, self._high = min(self._low, value), max(self._high, value)
        self._last, self._time = value, time
        self._moments += 1

    def learnt(self) -> SimulatedPointSection:
        """Return the point with a behaviour that fits the observed changes; the point itself if there were none.

        A number that never fell, and whose type is no float, gets a counter; any other number gets a random walk. The
        range of the point is extended to the values that were seen, except of a point with ``scale_from``.
        """
        if not self.has_changed or self._time <= 0:
            return self.point
        is_whole = self.point.form is not None and not self.point.form.name.startswith("float")
        if is_whole and not self._fell:
            behaviour: dict[str, Any] = {"kind": "counter", "rate": _short((self._last - self._first) / self._time)}
        else:
            every = max(_short(self._time / self._moments), FASTEST)
            behaviour = {"kind": "random-walk", "step": _short(self._step), "low": self._low, "high": self._high}
            behaviour["every"] = min(every, SLOWEST)
        wider: dict[str, Any] = {}
        if not self.point.scale_from:
            if self.point.minimum is not None and self._low < self.point.minimum:
                wider["minimum"] = self._low
            if self.point.maximum is not None and self._high > self.point.maximum:
                wider["maximum"] = self._high
        return _with(self.point, behaviour=behaviour, **wider)


def _short(number: float) -> float:
    """Return a number rounded to six significant digits, for a file that people read."""
    return float(f"{number:.6g}")


class _Recorder:
    """Reads points of a live device, and remembers registers whose bits several points share."""

    def __init__(self, unit: BlockingUnit) -> None:
        self._unit = unit
        self._shared: dict[tuple[Table, int], int] = {}
        self._named: set[tuple[Table, int, int]] = set()

    def record(self, point: SimulatedPointSection, remarks: list[str]) -> list[SimulatedPointSection]:
        """Read a point from the device, and return a list with this point, which has the value that was read.

        If its registers hold no valid value of its type, or writing the value would give other registers, the list has
        a point for each register instead, and a remark is added to ``remarks``. Raises `ModbusError` if the device
        refuses the read or does not answer.
        """
        place, form = point.place, point.form
        if form is None:
            return [_with(point, value=self._bit(place))]
        registers = self._unit.read(Address(place.table, place.offset), "uint16", count=point.size, split=True)
        data = b"".join(value.to_bytes(2, "big") for value in registers)
        try:
            return [_valued(point, form, data)]
        except (BadReply, InvalidRequest) as error:
            remarks.append(f"kept as registers: point {point.name} at {place}: {error.message}")
        return [_register_point(point, index, value) for index, value in enumerate(registers)]

    def _bit(self, place: Address) -> bool:
        assert place.table is not None
        if place.bit is None:
            return bool(self._unit.read(Address(place.table, place.offset)))
        key = (place.table, place.offset)
        if key not in self._shared:
            self._shared[key] = self._unit.read(Address(*key), "uint16")
        self._named.add((*key, place.bit))
        return bool(self._shared[key] >> place.bit & 1)

    def unnamed_bits(self) -> Iterator[SimulatedPointSection]:
        """Yield a point for each set bit that no recorded point has, so that the cloned register has the same value.

        Only registers of which points take single bits are regarded.
        """
        for (table, offset), value in self._shared.items():
            for bit in range(16):
                if value >> bit & 1 and (table, offset, bit) not in self._named:
                    address = format_address(Address(table, offset, bit))
                    yield SimulatedPointSection.model_validate({"name": address, "address": address, "value": True})


def _valued(point: SimulatedPointSection, form: ValueType[Any], data: bytes) -> SimulatedPointSection:
    """Return a point with the value that its registers hold; its range and its names are extended to allow that value.

    Args:
        point: the point.
        form: the value type of the point.
        data: the content of the point's registers, two bytes for each.

    Raises:
        BadReply: the registers hold no valid value of the type.
        InvalidRequest: the value is invalid for the point, or writing it would give other registers.
    """
    (raw,) = form.decode(data)
    value = point.physical(raw)
    if value != value:  # a file knows one NaN only
        value = float("nan")
    changes: dict[str, Any] = {"value": value}
    if isinstance(value, int | float):
        if not point.scale_from:  # which the range counts, and the value does not
            if point.minimum is not None and value < point.minimum:
                changes["minimum"] = float(value)
            if point.maximum is not None and value > point.maximum:
                changes["maximum"] = float(value)
        if point.enumeration and value not in point.enumeration.values():
            changes["enumeration"] = {**point.enumeration, f"value {value}": value}
    try:
        made = _with(point, **changes)
    except ValidationError as error:
        raise InvalidRequest(error.errors()[0]["msg"]) from error
    if form.encode([made.raw(value)]) != data:
        raise InvalidRequest(f"{data.hex(' ')} would not come of {value!r} again")
    return made


def _with(point: SimulatedPointSection, **changes: Any) -> SimulatedPointSection:
    return SimulatedPointSection.model_validate({**_keys_of(point), **changes})


def _keys_of(point: SimulatedPointSection) -> dict[str, Any]:
    return {key: getattr(point, key) for key in point.model_fields_set}


def _register_point(point: SimulatedPointSection, index: int, value: int) -> SimulatedPointSection:
    """Return a point of type ``uint16`` for one register of a point that cannot be recorded by its value.

    Args:
        point: the point that has the register.
        index: number of the register in the point, from 0.
        value: content of the register, 0…65535.
    """
    place = Address(point.place.table, point.place.offset + index)
    keys = {"name": f"{point.name} register {index + 1}", "address": format_address(place), "value": value}
    if point.access is not None:
        keys["access"] = point.access
    return SimulatedPointSection.model_validate(keys)


class _Scanner:
    """Finds out which items a table of a live device has, and reads their values.

    Args:
        unit: the unit of the live device.
        table: the table.
        thorough: whether each refused block is searched item by item, even if none of the items tried first exists.

    Attributes:
        offered: False once the device has refused the function that reads the table (exception 01).
        refusal: the last exception reply of the device; None if there was none.
        sampled: number of blocks of which only every `STRIDE`-th item was tried, because none of these exists.
    """

    def __init__(self, unit: BlockingUnit, table: Table, *, thorough: bool) -> None:
        self._unit = unit
        self._table = table
        self._thorough = thorough
        self._read: Callable[..., Sequence[int]] = getattr(unit, f"read_{table.value}")
        self.offered = True
        self.refusal: ExceptionReply | None = None
        self.sampled: int = 0

    def items(self, part: range) -> dict[int, int]:
        """Return the values of the items that exist in a range of addresses, by address; bits are 0 or 1."""
        size = MAX_READ_BITS if self._table.holds_bits else MAX_READ_REGISTERS
        found: dict[int, int] = {}
        for first in range(part.start, part.stop, size):
            if not self.offered:
                break
            self._block(first, min(size, part.stop - first), found)
        return found

    def _block(self, first: int, count: int, found: dict[int, int]) -> None:
        if self._take(first, count, found) or not self.offered:
            return
        if self._thorough or any(self._take(offset, 1, found) for offset in range(first, first + count, STRIDE)):
            self._divide(first, count, found)
        elif self.offered:
            self.sampled += 1

    def _divide(self, first: int, count: int, found: dict[int, int]) -> None:
        """Read into ``found`` the existing items of a range that the device has refused as a whole.

        The range is halved, and refused halves are halved again, down to single items.
        """
        if count == 1:
            return
        half = count // 2
        for start, size in ((first, half), (first + half, count - half)):
            if not self._take(start, size, found):
                self._divide(start, size, found)

    def _take(self, first: int, count: int, found: dict[int, int]) -> bool:
        """Read a range of the live device into ``found``, and return True if the device has all items of the range.

        Returns False if the device refuses the range as missing. If it does not have the function that reads the table,
        returns False and sets ``offered`` to False.

        Raises:
            ModbusError: the device did not answer, or refused the range for another reason; the error names the range.
        """
        try:
            values = self._read(first, count=count)
        except ExceptionReply as error:
            self.refusal = error
            if error.code == ExceptionCode.ILLEGAL_FUNCTION:
                self.offered = False
                return False
            if error.code in _HOLES:
                return False
            error.message = f"{self._table.label}s {first}…{first + count - 1}: {error.message}"
            raise
        except ModbusError as error:
            error.message = f"{self._table.label}s {first}…{first + count - 1}: {error.message}"
            raise
        found.update(zip(range(first, first + count), map(int, values), strict=True))
        return True


def _identity(unit: BlockingUnit, progress: Progress) -> dict[str, Any]:
    """Read a unit's identification and server id; return the keys that declare them, and the number of the unit.

    Data that the device does not have are left out.
    """
    keys: dict[str, Any] = {"unit": 1 if unit.number in _UNNAMED_UNITS else unit.number}
    objects = _objects(unit)
    if objects:
        names = {number: name for name, number in OBJECT_NUMBERS.items()}
        keys["identification"] = {
            names.get(number, f"0x{number:02X}"): _as_file_has(value) for number, value in sorted(objects.items())
        }
    server_id = _offered(unit.report_server_id)
    if server_id:
        keys["server_id"] = {"hex": server_id.hex()}
    progress(f"{len(objects)} identification objects" + (", server id" if server_id else ""))
    return keys


def _objects(unit: BlockingUnit) -> dict[int, bytes]:
    """Return the identification objects of the highest level that the live device supports; empty if it has none."""
    for level in _LEVELS:
        objects = _offered(partial(unit.read_device_identification, level))
        if objects:
            return objects
    return {}


def _offered(ask: Callable[[], Offered]) -> Offered | None:
    """Return what ``ask`` returns; None if the device refuses the request or its reply is invalid.

    Args:
        ask: sends the request and returns the reply.
    """
    try:
        return ask()
    except (ExceptionReply, BadReply):
        return None


def _as_file_has(value: bytes) -> Any:
    return {"hex": value.hex()}
