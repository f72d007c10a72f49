"""The schema of device files: units with their tables and typed, named points. One schema for all that play devices.

Knows what can be written and what fits together; knows no device (`busway.config.devices` makes them).

::

    listen = ["tcp://127.0.0.1:5020"]

    [[unit]]
    unit = 1
    holding_registers = 1000

    [[unit.point]]
    name = "tank.level"
    address = "4x1"
    type = "float32"
    value = 2.5
    unit_of_measure = "m"

Rules:

1. A table that is not declared has exactly the items of its points; in one that is, every point must lie.
2. ``first`` and the starts of ranges are offsets, 0-based; addresses of points are notations
   (`busway.values.addresses`).
3. ``value`` is in the unit of measure: the registers hold ``value / scale``. One that does not fit is refused, never
   truncated.
4. Points do not share registers; points on single bits may share one.
"""

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

from pydantic import BeforeValidator, Field, model_validator

from ...codes import MAX_FILE_RECORD_NUMBER, TABLE_SIZE, Table
from ...errors import ConfigError, InvalidRequest
from ...session.parameters import ServerParameters
from ...transport.tcp import SocketParameters
from ...values import Address, ValueType, parse_address, value_type
from ...values.refusal import shown
from .lines import Path
from .listeners import OF_CLIENTS, ListenerKeys, Url
from .options import OptionSection, with_options_of
from .schema import FileProblems, Section, parse_file

Result = TypeVar("Result")

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
"""Run indicator at the end of a server id (Application Protocol V1.1b3 §6.13)."""
_MOST_STEPS_OFF: Final = 1e-6
"""How far from a whole number of scale steps a value may be: what binary fractions cost."""


def parse_device_file(text: str, name: str) -> "DeviceFile":
    """A device file, checked as a whole.

    Args:
        text: its content.
        name: its name, for the sentences.

    Raises:
        FileError: all that is wrong with it, each with file, line and key.
    """
    return parse_file(text, DeviceFile, name)


def _as_table(value: object) -> object:
    """A table may be written as a number of items, or as the list of its values."""
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
    """Text, or ``{ hex = "…" }``."""
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
    """Bytes as a file writes them: ``{ hex = "01 02" }``."""

    hex: str


Bytes = Annotated[bytes, BeforeValidator(_as_bytes, json_schema_input_type=str | Hexadecimal)]
Whole = Annotated[int, Field(ge=0, le=0xFFFF)]
TableSize = Annotated[int, Field(ge=0, le=TABLE_SIZE)]
UnitNumber = Annotated[int, Field(ge=0, le=255)]


@with_options_of(ServerParameters, SocketParameters, without=OF_CLIENTS)
class ServerSection(ListenerKeys, OptionSection):
    """``[server]``: how the file is served. What is left out has the defaults of the parameters of these names."""

    retired: ClassVar[dict[str, str]] = {"shared_places": "shared_slots"}

    preset: Literal["standard", "strict"] = "standard"
    standard_port: bool | None = None
    unit_policy: Literal["listed", "any"] = "listed"
    unlisted: Literal["exception", "silence"] = "exception"
    shared_slots: bool | None = None

    def options(self) -> dict[str, Any]:  # of several types
        """The options of `busway.serve` that are set here."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}


class TableSection(Section):
    """The items of a table: ``first`` and ``count``, or ``values``; ``read_only`` ranges ``[first, count]``."""

    first: Whole = 0
    count: TableSize | None = None
    values: list[int | bool] | None = None
    read_only: list[Annotated[list[int], Field(min_length=2, max_length=2)]] = Field(default_factory=list)

    @property
    def size(self) -> int:
        """Number of items."""
        return self.count if self.count is not None else len(self.values or ())

    @property
    def end(self) -> int:
        """The offset after the last item."""
        return self.first + self.size

    def faults(self, *, bits: bool, size: int = TABLE_SIZE) -> Iterator[tuple[Path, str]]:
        """What cannot be, with its place in this table."""
        if self.end > size:
            yield (), f"offsets are 0…{size - 1}, but {self.first}…{self.end - 1} are declared"
        if self.values is not None and len(self.values) > self.size:
            yield ("values",), f"{len(self.values)} values for {self.size} items"
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

    number: int = Field(ge=1, le=0xFFFF)


class FifoSection(Section):
    """``[[unit.fifo]]``: a queue of registers, for function 24."""

    address: str
    values: list[Whole] = Field(default_factory=list)

    @property
    def place(self) -> Address:
        """The queue's pointer."""
        return parse_address(self.address, table=Table.HOLDING_REGISTERS)

    @model_validator(mode="after")
    def _check(self) -> "FifoSection":
        checked("address", lambda: self.place)
        return self


class PointSection(Section):
    """``[[unit.point]]``: one value with a name."""

    name: str = Field(min_length=1)
    address: str
    type: str | None = None
    order: str = "ABCD"
    value: Any = None
    unit_of_measure: str = ""
    scale: float = 1.0
    access: Literal["read", "read-write"] | None = None
    description: str = ""

    @cached_property
    def place(self) -> Address:
        """Where it stands."""
        return parse_address(self.address)

    @cached_property
    def table(self) -> Table:
        """The table it stands in."""
        table = self.place.table
        assert table is not None  # a text that names no table is refused
        return table

    @cached_property
    def form(self) -> ValueType[Any] | None:
        """The type of its registers; None for one bit."""
        if self.table.holds_bits or self.place.bit is not None:
            return None
        return value_type(self.type or "uint16", self.order)

    @cached_property
    def size(self) -> int:
        """Registers or bits that it takes."""
        return 1 if self.form is None else self.form.registers

    @property
    def is_writable(self) -> bool:
        """Whether Modbus may write it."""
        return self.table.is_writable and self.access != "read"

    def raw(self, value: Any) -> Any:
        """What the registers hold for a value in the unit of measure. Raises `InvalidRequest` if it does not fit."""
        form = self.form
        if form is None:
            if not isinstance(value, bool):
                raise InvalidRequest(f"one bit is true or false, not {shown(value)}")
            return value
        if self.scale != 1.0:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InvalidRequest(f"a number is needed where there is a scale, not {shown(value)}")
            steps = value / self.scale
            if not form.name.startswith("float"):
                if not abs(steps) < 2**64 or abs(steps - round(steps)) > _MOST_STEPS_OFF * max(1.0, abs(steps)):
                    raise InvalidRequest(f"{shown(value)} is no whole number of steps of {self.scale:g}")
                steps = round(steps)
            value = steps
        form.encode([value])
        return value

    def physical(self, raw: Any) -> Any:
        """The value in the unit of measure of what the registers hold."""
        if self.scale == 1.0 or isinstance(raw, bool):
            return raw
        return float(f"{raw * self.scale:.12g}")  # 183 × 0.1 is 18.3

    @model_validator(mode="after")
    def _check(self) -> "PointSection":
        place = checked("address", lambda: self.place)
        if place.table is Table.COILS or place.table is Table.DISCRETE_INPUTS or place.bit is not None:
            if self.type is not None:
                raise FileProblems([(("type",), f"{place} is one bit and has no type")])
            if self.scale != 1.0:
                raise FileProblems([(("scale",), f"{place} is one bit and has no scale")])
        else:
            form = checked("type", lambda: value_type(self.type or "uint16"))
            form = checked("order", lambda: value_type(self.type or "uint16", self.order))
            if form.name.startswith("bit:"):
                raise FileProblems([(("type",), f"one bit is written with its address, {place}.{form.name[4:]}")])
            if self.scale != 1.0 and not form.name.startswith(("int", "uint", "float", "bcd")):
                raise FileProblems([(("scale",), f"{form.name} is no number and has no scale")])
            if not self.scale or self.scale != self.scale or abs(self.scale) == float("inf"):
                raise FileProblems([(("scale",), f"must be a number other than 0, not {self.scale:g}")])
            if place.offset + form.registers > TABLE_SIZE:
                raise FileProblems(
                    [(("address",), f"{form.registers} registers from {place} on end beyond the last one")]
                )
        if self.access == "read-write" and not self.table.is_writable:
            raise FileProblems([(("access",), f"Modbus can not write {self.table.label}s")])
        if self.access == "read" and place.bit is not None:
            raise FileProblems(
                [(("access",), f"{place} can be written as its register can; give that a range in read_only")]
            )
        if self.value is not None:
            checked("value", lambda: self.raw(self.value))
        return self


class UnitSection(Section):
    """``[[unit]]``: a device; with several numbers, a device of its own for each."""

    unit: Annotated[
        list[UnitNumber],
        BeforeValidator(_as_list, json_schema_input_type=UnitNumber | list[UnitNumber]),
        Field(min_length=1),
    ]
    name: str = ""
    description: str = ""
    holding_registers: DeclaredTable | None = None
    input_registers: DeclaredTable | None = None
    coils: DeclaredTable | None = None
    discrete_inputs: DeclaredTable | None = None
    point: list[PointSection] = Field(default_factory=list)
    file: list[FileSection] = Field(default_factory=list)
    fifo: list[FifoSection] = Field(default_factory=list)
    identification: dict[str, Bytes] = Field(default_factory=dict)
    server_id: (
        Annotated[
            bytes,
            BeforeValidator(_as_server_id, json_schema_input_type=str | Hexadecimal),
            Field(max_length=251),
        ]
        | None
    ) = None
    exception_status: int = Field(default=0, ge=0, le=255)
    functions: list[Annotated[int, Field(ge=1, le=127)]] | None = None

    def table(self, table: Table) -> TableSection | None:
        """The declaration of a table, if there is one."""
        declared: TableSection | None = getattr(self, table.value)
        return declared

    def points_in(self, table: Table) -> list[PointSection]:
        """The points that stand in a table."""
        return [point for point in self.point if point.table is table]

    def objects(self) -> dict[int, bytes]:
        """Identification objects by number."""
        return {_object_number(key): value for key, value in self.identification.items()}

    @model_validator(mode="after")
    def _check(self) -> "UnitSection":
        faults = [
            *self._table_faults(),
            *self._point_faults(),
            *self._object_faults(),
            *_repeated("file", "number", [each.number for each in self.file]),
            *_repeated("fifo", "address", [each.place.offset for each in self.fifo]),
        ]
        if faults:
            raise FileProblems(faults)
        return self

    def _table_faults(self) -> Iterator[tuple[Path, str]]:
        for table in Table:
            declared = self.table(table)
            if declared is not None:
                for path, message in declared.faults(bits=table.holds_bits):
                    yield (table.value, *path), message
        for index, file in enumerate(self.file):
            for path, message in file.faults(bits=False, size=MAX_FILE_RECORD_NUMBER + 1):
                yield ("file", index, *path), message

    def _point_faults(self) -> Iterator[tuple[Path, str]]:
        yield from _repeated("point", "name", [point.name for point in self.point])
        owners: dict[tuple[Table, int, int | None], str] = {}
        for index, point in enumerate(self.point):
            place, declared = point.place, self.table(point.table)
            if declared is not None and not declared.first <= place.offset <= declared.end - point.size:
                yield (
                    ("point", index, "address"),
                    f"{place} does not lie in the declared {point.table.label}s, {declared.first}…{declared.end - 1}",
                )
            for offset in range(place.offset, place.offset + point.size):
                bits = range(16) if place.bit is None else (place.bit,)
                taken = next((owners[key] for bit in bits if (key := (point.table, offset, bit)) in owners), None)
                if taken is not None:
                    yield ("point", index, "address"), f"{place} is taken by {shown(taken)}"
                    break
                owners |= {(point.table, offset, bit): point.name for bit in bits}

    def _object_faults(self) -> Iterator[tuple[Path, str]]:
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
    """A whole device file."""

    listen: Annotated[list[Url], Field(min_length=1)] = Field(default_factory=lambda: ["tcp://127.0.0.1:5020"])
    server: ServerSection = ServerSection()
    unit: list[UnitSection] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_units(self) -> "DeviceFile":
        faults = list(self._unit_faults())
        if faults:
            raise FileProblems(faults)
        return self

    def _unit_faults(self) -> Iterator[tuple[Path, str]]:
        owners: dict[int, int] = {}
        for index, section in enumerate(self.unit):
            for number in section.unit:
                if number in owners:
                    yield ("unit", index, "unit"), f"unit {number} is there already: unit[{owners[number]}]"
                owners[number] = index
        if self.server.unit_policy == "any" and len(owners) > 1:
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


def _repeated(section: str, key: str, values: list[Any]) -> Iterator[tuple[Path, str]]:
    seen: dict[Any, int] = {}
    for index, value in enumerate(values):
        if value in seen:
            yield (section, index, key), f"{shown(value)} is there already: {section}[{seen[value]}]"
        seen.setdefault(value, index)


def checked(key: str, make: Callable[[], Result]) -> Result:
    """What ``make`` gives; what it refuses becomes a fault of ``key`` of the section that is being checked."""
    try:
        return make()
    except (InvalidRequest, ConfigError) as error:
        raise FileProblems([((key,), error.message)]) from None
