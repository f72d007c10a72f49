"""``busway read --points FILE``: reads the points of a device by name, in as few requests as its rules allow.

1. All errors of the file are reported together, before anything is sent.
2. If a request fails, each of its points has a record with the reason. If the device refuses a request for several
   points, these are requested one by one: one register that does not exist does not spoil the others.
3. Points that hold the number of members of a repeated group are read first, and members that do not exist are not
   read.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

from ..codes import ExceptionCode
from ..errors import BadReply, ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError
from ..points import Point, Quality, Reading, Reason
from ..points.decoder import ReadDecoder
from ..points.derived import Derivation
from ..points.name_patterns import is_meant
from ..points.quality import exception_reason, reason_text
from ..values import format_address
from .arguments import hint_at_unit
from .exits import ExitCode, exit_code_of
from .output import LivePage, fewest_digits, json_value, print_aligned, print_csv, print_json, shown_value

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit
    from ..config.files.device import UnitSection

_COLUMNS: Final = ("point", "value", "unit_of_measure", "quality", "reason", "label", "address", "type", "raw")
_REFUSED: Final = (ExceptionCode.ILLEGAL_DATA_ADDRESS, ExceptionCode.ILLEGAL_DATA_VALUE)


@dataclass(frozen=True, slots=True)
class PointRecord:
    """The result of reading one point: its value, quality and bytes.

    Attributes:
        point: the point.
        reading: value and quality; without value, the reason for that.
        raw: the bytes of its registers in wire order; for a coil or discrete input one byte, 0 or 1; empty if it was
            not read or is computed.
    """

    point: Point
    reading: Reading
    raw: bytes = b""

    @property
    def value(self) -> Any:  # what its type says
        """The value of the point, None if there is none; an unscaled float has the fewest digits for its registers."""
        value, point = self.reading.value, self.point
        if isinstance(value, float) and point.type.startswith("float") and not point.conversion.changes:
            return fewest_digits(value, 2 * point.width)
        return value

    @property
    def address(self) -> str:
        """The address of the point; empty for a computed point."""
        if self.point.formula:
            return ""
        name = self.point.type
        field = "." + name.removeprefix("field:").partition(":")[0] if name.startswith("field:") else ""
        return format_address(self.point.address) + field


def load_points(name: str, unit: int | None) -> "tuple[int | None, UnitSection]":
    """Load one unit with its points from a device file; return its unit number and its section.

    Args:
        name: a device file, a simulation file, ``device:NAME``, or a register map whose name ends in ``.csv``.
        unit: the number given by ``--unit``; None for the only unit of the file. If the file describes just one unit,
            that one is taken, also if its number is missing or another.

    Returns:
        The unit number to ask, and the section. The number is None for a register map without ``unit``: a map has none.

    Raises:
        ConfigError: the file is invalid, or has several units and ``unit`` is None or none of them.
    """
    from ..apps.simulator.csv_register_map import read_register_map
    from ..apps.simulator.includes import load_declaration
    from ..config.files.simulation import SimulatedUnitSection

    if name.lower().endswith(".csv"):
        return unit, SimulatedUnitSection.model_validate({"unit": 1, "point": read_register_map(name)})
    with hint_at_unit():
        sections = [each.section for each in load_declaration(name, unit=unit).units]
    numbers = [number for section in sections for number in section.unit]
    if unit is None:
        if len(numbers) != 1:
            raise ConfigError(f"{name} has the units {', '.join(map(str, numbers))}: say which", key="--unit")
        return numbers[0], sections[0]
    found = next((section for section in sections if unit in section.unit), None)
    if found is None and len(sections) != 1:
        raise ConfigError(f"{name} has the units {', '.join(map(str, numbers))}, not {unit}", key="--unit")
    return unit, found or sections[0]


def chosen_points(section: "UnitSection", names: Sequence[str]) -> list[Point]:
    """Return the points of a unit whose names match, in the order of the file.

    Args:
        section: the section of the unit.
        names: names and patterns, such as ``string.*``; empty for all points.

    Raises:
        ConfigError: a name matches no point.
    """
    points = section.described()
    for name in names:
        if not any(is_meant(point.name, name) for point in points):
            there = ", ".join(point.name for point in points[:12]) + (", …" if len(points) > 12 else "")
            raise ConfigError(f"there is no such point; there are {there}", key=name)
    return [point for point in points if not names or any(is_meant(point.name, name) for name in names)]


class PointReader:
    """Reads chosen points of a unit, as often as wanted, in few requests.

    Args:
        unit: the unit of a link that is asked.
        section: the section of a device file that describes its points.
        names: names and patterns of the points; empty for all.

    Attributes:
        points: the chosen points, in the order of the file.

    Raises:
        ConfigError: a name matches no point; nothing was sent.
    """

    def __init__(self, unit: "BlockingUnit", section: "UnitSection", names: Sequence[str]) -> None:
        self._unit = unit
        self._rules = section.read.rules()
        self._all = {point.name: point for point in section.described()}
        self.points: list[Point] = chosen_points(section, names)
        needed = self._with_inputs(self.points)
        self._derivation = Derivation(needed)
        self._stored = [point for point in needed if not point.formula]
        self._known: dict[str, int] = {}
        self.code: int = ExitCode.DONE
        """Exit code of the first failure in the last call of `read`, 0 without: of a request, or 2 for a point that the
        device file lets no request fetch."""

    def _with_inputs(self, points: Iterable[Point]) -> list[Point]:
        """Return these points, and all points that are needed to compute or scale them, in the order of the file."""
        found: dict[str, Point] = {}
        waiting = [point.name for point in points]
        while waiting:
            point = self._all[waiting.pop()]
            if point.name in found:
                continue
            found[point.name] = point
            inputs = Derivation([point]).inputs() if point.formula else ()
            waiting += [*inputs, *(name for name, _ in point.exists)]
            waiting += [point.conversion.scale_from] if point.conversion.scale_from else []
        return [point for point in self._all.values() if point.name in found]

    def read(self) -> list[PointRecord]:
        """Read the chosen points once, and return a record for each that exists, in the order of the file.

        If a request fails, or the device file lets no request fetch a point, the records have the reason, and ``code``
        the exit code of the first failure.

        Raises:
            InvalidRequest: a request cannot be sent to this unit.
        """
        self.code = ExitCode.DONE
        counting = self._counting()
        records = self._read([point for point in self._stored if point.name in counting])
        records |= self._derived(Derivation([self._all[name] for name in counting if self._all[name].formula]), records)
        rest = [point for point in self._stored if point.name not in counting and _exists(point, records)]
        records |= self._read(rest)
        records |= self._derived(self._derivation, records)
        return [records[point.name] for point in self.points if point.name in records and _exists(point, records)]

    def _counting(self) -> set[str]:
        """Return the names of the points that are read first: they hold the number of members of repeated groups.

        Points that are needed to compute or scale these are among them.
        """
        names = {name for point in self._stored for name, _ in point.exists}
        return {point.name for point in self._with_inputs([self._all[name] for name in names])}

    def _derived(self, derivation: Derivation, records: Mapping[str, PointRecord]) -> dict[str, PointRecord]:
        found = derivation.apply({name: each.reading for name, each in records.items()}, time.monotonic(), self._known)
        return {
            name: PointRecord(self._all[name], reading, records[name].raw if name in records else b"")
            for name, reading in found.items()
        }

    def _read(self, points: Sequence[Point]) -> dict[str, PointRecord]:
        from ..apps.collector.cost import network_cost
        from ..apps.collector.plan import plan_reads

        plan = plan_reads(points, self._rules, network_cost())
        replies: list[tuple[ReadDecoder, bytes]] = []
        found = {each.item.name: self._failed(each.item, Reason.CONFIGURATION) for each in plan.unreadable}
        if plan.unreadable:
            self.code = self.code or ExitCode.WRONG_USE
        for read in plan.reads:
            members = [point for point in read.items if point in points]
            self._ask(members, read.start, read.width, replies, found)
        # Twice where scale factors come from another read: then all are known.
        decoded = [(decoder, data, decoder.decode(data, self._known)) for decoder, data in replies]
        if any(Reason.NO_SCALE_FACTOR in each.flaws.values() for _, _, each in decoded):
            decoded = [(decoder, data, decoder.decode(data, self._known)) for decoder, data in replies]
        for decoder, data, result in decoded:
            for place, point in enumerate(decoder.points):
                reading = Reading(result.values[place], result.flaws.get(place, Reason.NONE))
                found[point.name] = PointRecord(point, reading, _items(decoder, point, data))
        return found

    def _ask(
        self,
        points: list[Point],
        start: int,
        width: int,
        replies: list[tuple[ReadDecoder, bytes]],
        found: dict[str, PointRecord],
    ) -> None:
        """Send one read request; if the device refuses it (02 or 03), read each of its points separately.

        Args:
            points: the points to read, of one table.
            start, width: 0-based offset of the first item, and number of items.
            replies: each reply is appended here, with the decoder for it.
            found: gets a record for each point that could not be read, by name.
        """
        from ..client.operations import READ

        table = points[0].table
        if self._rules.pause:
            time.sleep(self._rules.pause)
        try:
            (reply,) = self._unit.execute_many([READ[table](start, width)])
        except InvalidRequest:
            raise
        except ModbusError as error:
            if len(points) > 1 and isinstance(error, ExceptionReply) and error.code in _REFUSED:
                for point in points:
                    self._ask([point], point.start, point.width, replies, found)
                return
            self.code = self.code or exit_code_of(error)
            for point in points:
                found[point.name] = self._failed(point, reason_of(error))
        else:
            replies.append((ReadDecoder(points, table, start, width), bytes(reply.data)))

    def _failed(self, point: Point, reason: int) -> PointRecord:
        return PointRecord(point, Reading(None, reason))


def _exists(point: Point, records: Mapping[str, PointRecord]) -> bool:
    """Whether a point exists in the device; a member of a repeated group may be beyond the group's reported size.

    Args:
        point: the point.
        records: what was read so far, by name. While the number of members is not in it, all members exist.
    """
    for name, place in point.exists:
        record = records.get(name)
        if record is not None and record.reading.value is not None and place > record.reading.value:
            return False
    return True


def _items(decoder: ReadDecoder, point: Point, data: bytes) -> bytes:
    """Return the bytes of a point's registers from the data of a reply, in wire order.

    For a coil or discrete input that is one byte, 0 or 1.
    """
    first = point.start - decoder.start
    if point.table.holds_bits:
        return bytes([data[first // 8] >> (first & 7) & 1])
    return data[2 * first : 2 * (first + point.width)]


def reason_of(error: ModbusError) -> int:
    """Return the number that tells why a point has no value because of this error.

    It is a `Reason`, or for an exception reply that of `exception_reason`.
    """
    if isinstance(error, ExceptionReply):
        return exception_reason(error.code)
    if isinstance(error, BadReply):
        return Reason.BROKEN_REPLY
    if isinstance(error, LinkDown):
        return Reason.NO_CONNECTION
    return Reason.IN_DOUBT if getattr(error, "kind", "") == "in doubt" else Reason.TIMEOUT


def read_points(reader: PointReader, *, unit: int | None, as_json: bool, as_csv: bool, period: float | None) -> int:
    """Read points once, or every ``period`` seconds until Ctrl-C, and print them.

    Args:
        reader: reads the points.
        unit: unit identifier, for JSON; None to leave it out.
        as_json, as_csv: the form of the output.
        period: seconds from one round to the next; None for one round.

    Returns:
        The exit code: after one round that of its first failure, 0 without; after several rounds 0.

    Raises:
        ConfigError: ``as_json`` and ``as_csv`` are both True.
        InvalidRequest: a request cannot be sent to this unit.
    """
    with closing(_PointWriter(unit, as_json=as_json, as_csv=as_csv, repeats=period is not None)) as writer:
        if period is None:
            writer.write(reader.read())
            return reader.code
        due = time.monotonic()
        with suppress(KeyboardInterrupt):
            while True:
                now = datetime.now().astimezone().isoformat(timespec="milliseconds")
                writer.write(reader.read(), now)
                due = max(due + period, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
    return ExitCode.DONE


class _PointWriter:
    """Prints points with their values on stdout: as JSON lines, CSV, or columns, which a terminal redraws in place."""

    def __init__(self, unit: int | None, *, as_json: bool, as_csv: bool, repeats: bool) -> None:
        if as_json and as_csv:
            raise ConfigError("does not go with --json", key="--csv")
        self._unit = unit
        self._as_json, self._as_csv = as_json, as_csv
        self._has_header = False
        self._page = LivePage() if repeats and not as_json and not as_csv and LivePage.fits() else None

    def close(self) -> None:
        """End the printing; what was redrawn in place stays on the terminal."""
        if self._page is not None:
            self._page.close()

    def write(self, records: Sequence[PointRecord], now: str = "") -> None:
        """Print the points of one round of reading; ``now`` is its time (ISO 8601), empty to print none."""
        if self._as_json:
            for record in records:
                print_json(({"time": now} if now else {}) | ({} if self._unit is None else {"unit": self._unit})
                           | _fields(record))  # fmt: skip
        elif self._as_csv:
            header = [] if self._has_header else [*(["time"] if now else []), *_COLUMNS]
            self._has_header = True
            print_csv(header, [[*([now] if now else []), *_cells(record, raw=record.raw.hex())] for record in records])
        elif self._page is not None:
            self._page.show([_shown(record) for record in records], now)
        else:
            print_aligned([[*([now] if now else []), *_shown(record)] for record in records])


def _fields(record: PointRecord) -> dict[str, Any]:
    """Return the fields of the JSON object that ``--json`` prints for a point."""
    point, reading = record.point, record.reading
    fields = {
        "point": point.name,
        "value": json_value(record.value),
        "unit_of_measure": point.unit_of_measure,
        "quality": reading.quality.label,
        "reason": reason_text(reading.reason),
        "address": record.address,
        "type": point.type,
        "raw": record.raw.hex(),
    }
    label = point.label(reading.value)
    return fields | ({"label": label} if label else {})


def _cells(record: PointRecord, raw: str) -> list[str]:
    point, reading = record.point, record.reading
    return [
        point.name,
        "" if reading.value is None else shown_value(record.value),
        point.unit_of_measure,
        reading.quality.label,
        reason_text(reading.reason),
        point.label(reading.value),
        record.address,
        point.type,
        raw,
    ]


def _shown(record: PointRecord) -> list[str]:
    """Return a point as cells for people: name, value, unit of measure, label, quality and reason, address, bytes.

    Quality and reason are empty for a good value.
    """
    point, reading = record.point, record.reading
    value = "—" if reading.value is None else shown_value(record.value)
    label = point.label(reading.value)
    raw = record.raw.hex(" ", 2) if len(record.raw) > 1 else record.raw[:1].hex().lstrip("0") or record.raw.hex()[:1]
    why = f"{reading.quality.label}: {reason_text(reading.reason)}" if reading.quality is not Quality.GOOD else ""
    return [point.name, value, point.unit_of_measure, label, why, record.address, raw]
