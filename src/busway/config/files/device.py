"""The schema of device files: units with their tables and typed, named points, for servers, simulators and clients.

Knows what can be written and what fits together; knows no device (`busway.config.devices` makes them).

An example is in `docs/reference/device-file.md`.

Rules:

1. A table that is not declared has exactly the items of its points. If a table is declared, its points must lie in it.
2. ``first`` and the starts of ranges are offsets, 0-based; addresses of points are notations
   (`busway.values.addresses`).
3. A group of points is written once, and repeated at each of its places.
4. Points do not share bits of registers, unless one says ``overlaps``.
5. The keys of one point are in `points`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from ...codes import MAX_FILE_RECORD_NUMBER, MAX_READ_BITS, MAX_READ_REGISTERS, TABLE_SIZE, Table
from ...errors import ConfigError, InvalidRequest
from ...options.accepted_options import SERVERS
from ...options.declaration import Name, Range
from ...options.server import ListenerParameters
from ...options.text import build_parameters
from ...points import ItemRange, Point, ReadRules
from ...values import Address, parse_address
from ...values.counts import counted
from ...values.unfit_values import shown
from .file_error import FileError
from .key_lines import KeyPath
from .listeners import Url
from .options import OptionSection, with_options_of
from .points import MOST_REPEATED, STAND_IN, PointSection, WholeSection, checked, resolved
from .section import NO_LIST, NO_TABLE, FileProblems, Section
from .toml_source import read_source

OBJECT_NUMBERS: Final = {
    "vendor_name": 0,
    "product_code": 1,
    "revision": 2,
    "vendor_url": 3,
    "product_name": 4,
    "model_name": 5,
    "user_application_name": 6,
}
_RUNNING: Final = b"\xff"
"""Run indicator at the end of a server id: FF for on (Application Protocol V1.1b3 §6.13)."""


def parse_device_file(text: str, name: str) -> "DeviceFile":
    """Parse and check the text of a device file, and return its contents.

    Args:
        text: the file's text.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    source = read_source(text, name)
    file = source.checked(DeviceFile)
    try:
        build_parameters(ListenerParameters, file.server.options_of(ListenerParameters))
    except ConfigError as error:
        raise FileError([source.problem(("server", *([error.key] if error.key else [])), error.message)]) from None
    return file


def _as_table(value: object) -> object:
    """Return a table of a device file as a dictionary of its keys, also if written as a number of items or as a list.

    Raises `ValueError` for anything else.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return {"count": value}
    if isinstance(value, list):
        return {"values": value}
    if not isinstance(value, dict):
        raise ValueError(f"must be a number of items, a list of values, or a table, not {shown(value)}")
    return value


def _as_list(value: object) -> object:
    return value if isinstance(value, list) else [value]


def _as_bytes(value: object) -> object:
    """Return the bytes that a device file gives as text, in UTF-8, or as ``{ hex = "…" }``.

    Raises `ValueError` for everything else.
    """
    if isinstance(value, str):
        return value.encode("utf-8")
    if isinstance(value, dict) and set(value) == {"hex"} and isinstance(value["hex"], str):
        try:
            return bytes.fromhex(value["hex"])
        except ValueError:
            raise ValueError(f"{shown(value['hex'])} is not hexadecimal") from None
    raise ValueError(f'must be a text or {{ hex = "…" }}, not {shown(value)}')


def _as_server_id(value: object) -> object:
    data = _as_bytes(value)
    return data + _RUNNING if isinstance(value, str) and isinstance(data, bytes) else data


class Hexadecimal(Section):
    """Bytes written in hexadecimal in a file: ``{ hex = "01 02" }``."""

    hex: Annotated[str, 'the bytes: `"01 02"`.']


ServerIdField = Annotated[
    bytes, BeforeValidator(_as_server_id, json_schema_input_type=str | Hexadecimal), Field(max_length=251)
]
Bytes = Annotated[bytes, BeforeValidator(_as_bytes, json_schema_input_type=str | Hexadecimal)]
Whole = Annotated[int, Field(ge=0, le=0xFFFF)]
TableSize = Annotated[int, Field(ge=0, le=TABLE_SIZE)]
UnitNumber = Annotated[int, Field(ge=0, le=255)]
PresetWord = Literal["standard", "strict"]
LinkPresetWord = Literal["standard", "strict", "passive"]
OF_GROUP: Final = "its points, with the addresses of the first place."


@with_options_of(*SERVERS, role="server")
class ServerSection(OptionSection):
    """``[server]``: options of the server for the file's devices; keys that are left out have the options' defaults."""

    checked_later: ClassVar[tuple[type[Any], ...]] = (ListenerParameters,)  # with the listeners

    preset: Annotated[
        PresetWord, "`strict` sets each option that ends a deviation; what contradicts it is refused."
    ] = "standard"

    def options(self) -> dict[str, Any]:  # of several types
        """Return the options of `busway.serve` that this section sets, by name, also ``preset`` if it is set."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}


class TableSection(Section):
    """One of the four Modbus tables of a device in a file.

    ``first`` is its first item, ``count`` the number of items or ``values`` what they hold at the start;
    ``read_only`` has ranges as ``[first, count]``.
    """

    first: Annotated[Whole, "offset of the first item, 0-based."] = 0
    count: Annotated[TableSize | None, "number of items; None: as many as there are `values`."] = None
    values: Annotated[
        list[int | bool] | None, "what the items hold at first: 0…65535, or `true` and `false`; None: zero."
    ] = None
    read_only: Annotated[
        list[Annotated[list[int], Field(min_length=2, max_length=2)]],
        "ranges `[first, count]` that Modbus cannot write (exception 02).",
    ] = NO_LIST

    @property
    def size(self) -> int:
        """Number of items that the table has."""
        return self.count if self.count is not None else len(self.values or ())

    @property
    def end(self) -> int:
        """The offset after the last item of the table."""
        return self.first + self.size

    def faults(self, *, bits: bool, size: int = TABLE_SIZE) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors in the declaration of the table, each as path in the section and sentence.

        Args:
            bits: True if the items are bits, False if they are registers.
            size: largest number of items of such a table: its offsets are below.
        """
        if self.end > size:
            yield (), f"offsets are 0…{size - 1}, but {self.first}…{self.end - 1} are declared"
        if self.values is not None and len(self.values) > self.size:
            yield ("values",), f"{counted(len(self.values), 'value')} for {counted(self.size, 'item')}"
        for index, value in enumerate(self.values or ()):
            if bits and value not in (0, 1):
                yield ("values", index), f"must be true or false, not {shown(value)}"
            elif not bits and (isinstance(value, bool) or not 0 <= value <= 0xFFFF):
                yield ("values", index), f"a register holds 0…65535, not {shown(value)}"
        for index, (first, count) in enumerate(self.read_only):
            if count < 1 or first < self.first or first + count > self.end:
                yield (
                    ("read_only", index),
                    (f"[first, count] must lie within {self.first}…{self.end - 1}, not {shown([first, count])}"),
                )


DeclaredTable = Annotated[
    TableSection, BeforeValidator(_as_table, json_schema_input_type=TableSize | list[int | bool] | TableSection)
]


class FileSection(TableSection):
    """``[[unit.file]]``: the records of a file, for functions 20 and 21."""

    number: Annotated[int, Range(1, 0xFFFF), "number of the file; records are 0…9999."]


class FifoSection(Section):
    """``[[unit.fifo]]``: a queue of registers, for function 24."""

    address: Annotated[str, 'address of the pointer of the queue: `"4x1247"`.']
    values: Annotated[list[Whole], "registers in the queue."] = NO_LIST

    @property
    def place(self) -> Address:
        """The address in the holding registers under which function 24 reads the queue."""
        return parse_address(self.address, table=Table.HOLDING_REGISTERS)

    @model_validator(mode="after")
    def _check(self) -> "FifoSection":
        checked("address", lambda: self.place)
        return self


class GroupSection(WholeSection):
    """``[[unit.group]]``: a group of points, present once or repeated at several places."""

    name: Annotated[str, Name("the name of a group"), "text, with which the names of its points begin."]
    count: Annotated[
        int | None,
        Range(1, MOST_REPEATED),
        "how often it is there; its points are then `string.1.voltage`, `string.2.voltage` …; None: once, and its",
        "points are `string.voltage`.",
    ] = None
    count_from: Annotated[
        str, "name of a point that says how many there are, also a computed one; `count` is the most."
    ] = ""
    stride: Annotated[int, Range(0, TABLE_SIZE), "items from one place to the next; must be there with `count`."] = 0
    atomic: Annotated[bool, "whether what stands at one place is read in one request."] = False
    point: Annotated[Sequence[PointSection], OF_GROUP] = NO_LIST
    group: Annotated["Sequence[GroupSection]", "groups in it."] = NO_LIST

    @classmethod
    def stand_ins(cls) -> dict[str, Any]:
        """Return valid values for keys that a group must have: they replace wrong ones while the rest is checked."""
        return {"name": "?"}

    def faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys of this group that do not go together, each as path and sentence."""
        if self.count_from and self.count is None:
            yield ("count",), f"is missing: the most that {self.count_from} may say"
        if self.count is not None and self.count > 1 and not self.stride:
            yield ("stride",), "is missing: items from one place to the next"
        if not self.point and not self.group:
            yield ("point",), "is missing"
        yield from _repeated("point", "name", [point.name for point in self.point])

    def size(self) -> int:
        """Return the number of points of the group, inner groups included, with every repetition counted."""
        return (self.count or 1) * (len(self.point) + sum(each.size() for each in self.group))

    def names(self) -> Iterator[str]:
        """Yield the names of the group's own points as written in the file, without points of inner groups."""
        return (point.name for point in self.point)

    def placed(
        self, path: KeyPath, prefix: str, by: int, outer: Sequence[str], around: "_Around"
    ) -> Iterator["PlacedPoint"]:
        """Yield the group's points, with final names and addresses, once for each repetition of the group.

        Args:
            path: path of the group in the unit's section.
            prefix: text before the group's name: the names of the groups around it, ``string.1.``; empty for none.
            by: number of items to add to the addresses in the file, because a group around it is repeated.
            outer: full names of points around the group, those of the nearest group first.
            around: attributes that the groups around it give to a point.
        """
        for index in range(self.count or 1):
            here = f"{prefix}{self.name}." if self.count is None else f"{prefix}{self.name}.{index + 1}."
            known = [*(here + name for name in self.names()), *outer]
            inner = around
            if self.count_from:
                inner = _Around((*inner.exists, (resolved(self.count_from, outer), index + 1)), inner.group)
            if self.atomic and inner.group is None:
                inner = _Around(inner.exists, here.rstrip("."))
            shift = by + index * self.stride
            for number, point in enumerate(self.point):
                yield PlacedPoint((*path, "point", number), point.moved(here, shift, known), inner.exists, inner.group)
            for number, group in enumerate(self.group):
                yield from group.placed((*path, "group", number), here, shift, known, inner)


@dataclass(frozen=True, slots=True)
class _Around:
    """Attributes that a point of a device file gets from the groups around it; `PlacedPoint` explains them."""

    exists: tuple[tuple[str, int], ...] = ()
    group: str | None = None


@dataclass(frozen=True, slots=True)
class PlacedPoint:
    """One point of a unit with its final name and address, whether written alone or in a group.

    Attributes:
        path: its path in the unit's section of the file.
        section: its keys in the file; for a point of a group, with full name and the address at this place of the
            group.
        exists: for each group around the point with ``count_from``: the name of the point that holds the number of
            repetitions, and the number of this point's repetition, from 1 on.
        group: name of the atomic group, read in one request, that the point is in; None for none.
    """

    path: KeyPath
    section: PointSection
    exists: tuple[tuple[str, int], ...] = ()
    group: str | None = None


class ReadSection(Section):
    """``read`` of a unit: limits of read requests, such as the largest one and forbidden ranges."""

    max_registers: Annotated[int, Range(1, MAX_READ_REGISTERS), "registers that one request may ask for."] = (
        MAX_READ_REGISTERS
    )
    max_bits: Annotated[int, Range(1, MAX_READ_BITS), "coils or discrete inputs that one request may ask for."] = (
        MAX_READ_BITS
    )
    readable: Annotated[
        list[str],
        'ranges such as `"4x1-4x100"` where reads may go, also between points; none: everywhere, and nothing between',
        "points.",
    ] = NO_LIST
    forbidden: Annotated[list[str], "ranges that no read may touch."] = NO_LIST
    exact: Annotated[list[str], "ranges that are read whole or not at all."] = NO_LIST
    bridge: Annotated[bool, "whether what lies between points may be read to save a request."] = False
    one_point: Annotated[bool, "whether each point takes a request of its own."] = False
    pause: Annotated[float, Range(0, 3600), "seconds between a reply and the next request."] = 0.0
    poll_class: Annotated[str, "the class of points that name none."] = ""

    @model_validator(mode="after")
    def _check(self) -> "ReadSection":
        faults: list[tuple[KeyPath, str]] = []
        for key in ("readable", "forbidden", "exact"):
            for index, text in enumerate(getattr(self, key)):
                try:
                    item_range(text)
                except InvalidRequest as error:
                    faults.append(((key, index), error.message))
        if faults:
            raise FileProblems(faults)
        return self

    def rules(self) -> ReadRules:
        """Return the section as `ReadRules` of `busway.points`, for the read plan."""
        return ReadRules(
            self.max_registers,
            self.max_bits,
            _by_table(self.readable),
            _by_table(self.forbidden),
            _by_table(self.exact),
            bridge=self.bridge,
            one_point=self.one_point,
            pause=self.pause,
        )


def item_range(text: str) -> tuple[Table, ItemRange]:
    """Parse a range of items: ``4x1-4x100``, both ends included, or ``4x1`` for one item.

    Returns the table, and the range as offsets: of the first item, and after the last.

    Raises:
        InvalidRequest: the text is no range of items of one table.
    """
    first, dash, last = text.partition("-")
    ends = [parse_address(each.strip()) for each in ((first, last) if dash else (first, first))]
    if (
        ends[0].table is None
        or ends[0].table is not ends[1].table
        or ends[0].bit is not None
        or ends[1].bit is not None
    ):
        raise InvalidRequest(f"{shown(text)} is no range of items of one table, such as 4x1-4x100")
    if ends[0].offset > ends[1].offset:
        raise InvalidRequest(f"{shown(text)} ends before it begins")
    return ends[0].table, ItemRange(ends[0].offset, ends[1].offset + 1)


def _by_table(texts: Sequence[str]) -> dict[Table, list[ItemRange]]:
    found: dict[Table, list[ItemRange]] = {}
    for table, span in map(item_range, texts):
        found.setdefault(table, []).append(span)
    return found


class UnitSection(WholeSection):
    """``[[unit]]``: one device, or with several numbers equal devices with separate memories."""

    unit: Annotated[
        list[UnitNumber],
        BeforeValidator(_as_list, json_schema_input_type=UnitNumber | list[UnitNumber]),
        Name("at least one unit"),
        "0…255, or a list of them: then each is a device of its own, all alike.",
    ]
    name: Annotated[str, "text, for people."] = ""
    description: Annotated[str, "text, for people."] = ""
    holding_registers: Annotated[
        DeclaredTable | None, "number of items, list of values, or a table; None: exactly the items of its points."
    ] = None
    input_registers: Annotated[DeclaredTable | None, "the same."] = None
    coils: Annotated[DeclaredTable | None, "the same."] = None
    discrete_inputs: Annotated[DeclaredTable | None, "the same."] = None
    point: Annotated[Sequence[PointSection], "its points."] = NO_LIST
    group: Annotated[Sequence[GroupSection], "points that belong together."] = NO_LIST
    read: Annotated[ReadSection, "how the unit lets itself be read; left out: no limits but those of Modbus."] = (
        ReadSection()
    )
    file: Annotated[list[FileSection], "files, for functions 20 and 21."] = NO_LIST
    fifo: Annotated[list[FifoSection], "queues of registers, for function 24."] = NO_LIST
    identification: Annotated[
        dict[str, Bytes],
        f'objects of function 43/14: {", ".join(f"`{name}`" for name in OBJECT_NUMBERS)}, or numbers `"0x80"`; each a',
        'text or `{ hex = "01 02" }`, at most 244 bytes; left out: vendor, product and revision of busway.',
    ] = NO_TABLE
    server_id: Annotated[
        ServerIdField | None,
        'function 17: a text, to which the run indicator FF is added, or `{ hex = "…" }` as it stands; None: `busway`.',
    ] = None
    exception_status: Annotated[int, Range(0, 255), "what function 07 gives."] = 0
    functions: Annotated[
        list[Annotated[int, Field(ge=1, le=127)]] | None,
        "codes of the functions that the device offers; others get exception 01; None: all.",
    ] = None

    def table(self, table: Table) -> TableSection | None:
        """Return the declaration of a table of this unit; None if the file does not declare the table."""
        declared: TableSection | None = getattr(self, table.value)
        return declared

    @classmethod
    def stand_ins(cls) -> dict[str, Any]:
        """Return valid values for keys that a unit must have: they replace wrong ones while the rest is checked."""
        return {"unit": 1}

    @cached_property
    def placed(self) -> tuple[PlacedPoint, ...]:
        """All points of the unit, with final names and addresses; those written alone come first.

        A point of a repeated group occurs once for each repetition.
        """
        own = [PlacedPoint(("point", index), point) for index, point in enumerate(self.point)]
        names = [point.name for point in self.point]
        grouped = (
            each
            for index, group in enumerate(self.group)
            for each in group.placed(("group", index), "", 0, names, _Around())
        )
        return (*own, *grouped)

    @cached_property
    def stored(self) -> tuple[PlacedPoint, ...]:
        """The points of the unit that are in tables: all but the computed ones."""
        return tuple(each for each in self.placed if not each.section.is_computed)

    def hole(self, table: Table) -> int | None:
        """Return None: reads at addresses between the points of a table are refused, with exception 02.

        The units of simulation files override it: they can have a value that is read there.
        """
        return None

    def points_in(self, table: Table) -> list[PointSection]:
        """Return the points of the unit that are in one table, with final names and addresses."""
        return [each.section for each in self.stored if each.section.table is table]

    def described(self) -> list[Point]:
        """Return all points of the unit as `busway.points.Point` objects, computed ones and repetitions included."""
        exponents = {each.section.scale_from for each in self.placed}
        return [
            replace(
                each.section.described,
                is_exponent=each.section.name in exponents,
                exists=each.exists,
                group=each.group,
                poll_class=each.section.poll_class or self.read.poll_class,
            )
            for each in self.placed
        ]

    def objects(self) -> dict[int, bytes]:
        """Return the identification objects that the file declares (function 43/14), by number; empty for none."""
        return {_object_number(key): value for key, value in self.identification.items()}

    def faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys and points of this unit that do not go together, each as path and sentence."""
        yield from self._table_faults()
        yield from self._placed_faults()
        yield from self._object_faults()
        yield from _repeated("file", "number", [each.number for each in self.file])
        yield from _repeated("fifo", "address", [each.place.offset for each in self.fifo])

    def _table_faults(self) -> Iterator[tuple[KeyPath, str]]:
        for table in Table:
            declared = self.table(table)
            if declared is not None:
                for path, message in declared.faults(bits=table.holds_bits):
                    yield (table.value, *path), message
        for index, file in enumerate(self.file):
            for path, message in file.faults(bits=False, size=MAX_FILE_RECORD_NUMBER + 1):
                yield ("file", index, *path), message

    def _placed_faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of points that do not go together: equal names, shared bits, wrong names, circles.

        Only one error is yielded if the groups have too many points, or a repeated group does not fit into its table.
        """
        if sum(group.size() for group in self.group) > MOST_REPEATED:
            yield ("group",), f"groups come to more than {MOST_REPEATED} points"
            return
        try:
            placed = self.placed
        except (InvalidRequest, ValidationError) as error:
            # The first place is right by itself: a further one lies beyond the end of its table.
            why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.message
            yield ("group",), f"its places do not fit: {why}"
            return
        yield from _repeated("point", "name", [point.name for point in self.point])
        yield from _overlaps(self, self.stored)
        yield from _names_that_are_not_there(placed)
        yield from _circles(placed)

    def _object_faults(self) -> Iterator[tuple[KeyPath, str]]:
        numbers: dict[int, str] = {}
        for key, value in self.identification.items():
            try:
                number = _object_number(key)
            except ValueError as error:
                yield ("identification", key), str(error)
                continue
            if number in numbers:
                yield ("identification", key), f"is the same object as {numbers[number]}"
            numbers[number] = key
            if len(value) > 244:
                yield ("identification", key), f"an object has at most 244 bytes, not {len(value)}"


class DeviceFile(Section):
    """The checked contents of a device file."""

    listen: Annotated[list[Url], Name("at least one endpoint"), "endpoints to listen on."] = Field(
        default_factory=lambda: ["tcp://127.0.0.1:5020"]
    )
    server: Annotated[ServerSection, "options of the server."] = ServerSection()
    unit: Annotated[Sequence[UnitSection], Name("at least one unit"), "the devices."]

    @model_validator(mode="after")
    def _check_units(self) -> "DeviceFile":
        faults = list(self._unit_faults())
        if faults:
            raise FileProblems(faults)
        return self

    def _unit_faults(self) -> Iterator[tuple[KeyPath, str]]:
        owners: dict[int, int] = {}
        for index, section in enumerate(self.unit):
            for number in section.unit:
                if number in owners:
                    yield ("unit", index, "unit"), f"unit {number} is there already: unit[{owners[number]}]"
                owners[number] = index
        if self.server.options().get("unit_policy") == "any" and len(owners) > 1:
            yield ("server", "unit_policy"), f"any needs exactly one device, but there are {len(owners)}"


def _object_number(key: str) -> int:
    number = OBJECT_NUMBERS.get(key)
    if number is None:
        try:
            number = int(key, 0)
        except ValueError:
            number = -1
        if not 0 <= number <= 255:
            raise ValueError(f"there is no such object; there are {', '.join(OBJECT_NUMBERS)}, and numbers 0x00…0xFF")
    return number


def _repeated(section: str, key: str, values: list[Any]) -> Iterator[tuple[KeyPath, str]]:
    seen: dict[Any, int] = {}
    for index, value in enumerate(values):
        if value in seen:
            yield (section, index, key), f"{shown(value)} is there already: {section}[{seen[value]}]"
        seen.setdefault(value, index)


def _overlaps(unit: UnitSection, stored: Sequence[PlacedPoint]) -> Iterator[tuple[KeyPath, str]]:
    """Yield errors for points outside their table, and for points that overlap without being allowed to."""
    owners: dict[tuple[Table, int, int], str] = {}
    for each in stored:
        point, declared = each.section, unit.table(each.section.table)
        place = point.place
        if declared is not None and not declared.first <= place.offset <= declared.end - point.size:
            sentence = (
                f"{point.address} does not lie in the declared {point.table.label}s,"
                f" {declared.first}…{declared.end - 1}"
            )
            yield (*each.path, "address"), sentence
        if point.overlaps:
            continue
        bits = point.taken_bits
        for offset in range(place.offset, place.offset + point.size):
            taken = next((owners[key] for bit in bits if (key := (point.table, offset, bit)) in owners), None)
            if taken is not None:
                yield (*each.path, "address"), f"{point.address} is taken by {shown(taken)}"
                break
            owners |= {(point.table, offset, bit): point.name for bit in bits}


def _names_that_are_not_there(placed: Sequence[PlacedPoint]) -> Iterator[tuple[KeyPath, str]]:
    """Yield an error for each name of a point, in ``scale_from``, ``count_from`` or a formula, that does not fit.

    There is no such point, or it holds no number of the kind that is needed. A formula that uses ``t`` or a constant
    such as ``pi`` is an error too if a point has that name.
    """
    there = {each.section.name: each.section for each in placed}
    counts = {name: each.path for each in placed for name, _ in each.exists}
    needed = [((*each.path, "scale_from"), each.section.scale_from) for each in placed if each.section.scale_from]
    needed += [((*path[:-2], "count_from"), name) for name, path in counts.items()]
    for path, name in needed:
        if path[-1] == "count_from" and name in there and there[name].is_computed:
            continue
        point = there.get(name)
        if point is None:
            yield path, f"there is no point {shown(name)}"
        elif point.formula == STAND_IN:
            continue
        elif point.is_computed or not point.is_whole or point.conversion.changes or point.scale_from:
            yield path, f"{shown(name)} holds no whole number without a scale"
    for each in placed:
        if each.section.is_computed:
            for word in sorted(each.section.expression.words & there.keys()):
                yield (*each.path, "formula"), f'{word} is no point here; the point of that name is point("{word}")'
            for name in each.section.expression.names:
                other = there.get(name)
                if other is None:
                    yield (*each.path, "formula"), f"there is no point {shown(name)}"
                elif not other.is_computed and other.form is not None and not other.is_number:
                    yield (*each.path, "formula"), f"{shown(name)} holds no number, but {other.form.name}"


def _circles(placed: Sequence[PlacedPoint]) -> Iterator[tuple[KeyPath, str]]:
    """Yield an error for the first circle of computed points: a point whose formula depends on itself."""
    computed = {each.section.name: each for each in placed if each.section.is_computed}
    done: set[str] = set()
    for first in computed:
        path: dict[str, Iterator[str]] = {}
        following: str | None = first
        while following is not None or path:
            if following is not None and following in path:
                circle = [*list(path)[list(path).index(following) :], following]
                yield (*computed[following].path, "formula"), f"depends on itself: {' → '.join(circle)}"
                return
            if following is not None:
                path[following] = iter(computed[following].section.expression.names)
            last = next(reversed(path))
            following = next((name for name in path[last] if name in computed and name not in done), None)
            if following is None:
                done.add(last)
                del path[last]
