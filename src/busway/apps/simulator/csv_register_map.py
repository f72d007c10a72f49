"""Imports register maps in CSV, as manuals and spreadsheets have them, as points of a unit.

Knows the columns and the notation of their cells; the schema of device files checks the points.

::

    name,address,type,scale,unit,access,value
    voltage,3x1,uint16,0.1,V,read,230.0
    setpoint,4x11,float32,,°C,read-write,21.5

Rules:

1. The first line that is neither empty nor begins with ``#`` names the columns; capitals and spaces around a name do
   not matter. Unknown columns are refused by name; a column whose name begins with ``#`` is not read.
2. Cells are separated by comma, semicolon or tab: the one that splits the first line into known columns. Text is UTF-8
   with or without a byte order mark, UTF-16 with one, or else Latin-1.
3. A file is read as a whole; each error is reported with file, line and column.
4. If commas do not separate cells, a number may have a decimal comma.
5. Nothing is guessed: for an empty cell the key has its default, and a cell that cannot be read is refused.
   `read_what_fits` leaves out rows and columns that cannot be read, and returns the errors in them.
"""

import csv
import io
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ...codes import Table
from ...config.files.file_error import FileError, in_order
from ...config.files.key_lines import KeyPath
from ...config.files.simulation import SimulatedPointSection, SimulatedUnitSection
from ...config.files.toml_source import Source
from ...errors import ConfigError, InvalidRequest
from ...values import Address, format_address, parse_address, value_type
from ...values.addresses import table_named
from ...values.similar_names import similar_name
from ...values.unfit_values import shown

_ENCODINGS: Final = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_DELIMITERS: Final = (",", ";", "\t")
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
_WHOLE: Final = re.compile(r"[+-]?\d{1,20}|0[xX][0-9a-fA-F]{1,16}|0[bB][01]{1,64}")
_ENTRY: Final = re.compile(r"\s*(?P<number>[^=:]*?)\s*[=:]\s*(?P<label>.*?)\s*")
_ACCESS: Final = {
    "read": ("r", "ro", "read", "read-only", "read only"),
    "read-write": ("rw", "r/w", "wr", "w", "read-write", "read/write", "read write"),
}
_BIT_TYPES: Final = ("bit", "bool", "boolean")
_TRUE: Final = ("1", "true", "on", "yes")
_FALSE: Final = ("0", "false", "off", "no")


@dataclass(frozen=True, slots=True)
class Column:
    """A column that a register map in CSV may have.

    Attributes:
        name: header of the column.
        key: key of a point that gets the cell's value; empty if the cell only helps to read another cell of the row.
        says: meaning of the cells, for the documentation.
        also: other headers with the same meaning.
    """

    name: str
    key: str
    says: str
    also: tuple[str, ...] = ()


COLUMNS: Final = (
    Column("name", "name", "the name, one of a kind; must be there", ("point", "parameter")),
    Column(
        "address",
        "address",
        "a notation that names its table (`4x1`, `40001`, `input:0x10`, `%MW0`, `4x1.3`), or, with a column `table`, "
        "an offset counted from 0; must be there",
        ("register",),
    ),
    Column("table", "", "`coil`, `discrete`, `input` or `holding`, where `address` is a plain number"),
    Column(
        "type", "type", "type of the value, `uint16` if empty; for bits empty, or `bool`", ("data type", "datatype")
    ),
    Column("order", "order", "order of bytes and registers, `ABCD` if empty", ("byte order",)),
    Column("scale", "scale", "the registers hold value / scale, 1 if empty", ("factor",)),
    Column("unit", "unit_of_measure", "unit of measure", ("unit_of_measure", "unit of measure", "units")),
    Column("access", "access", "`read` (`r`, `ro`) or `read-write` (`rw`, `r/w`); what the table allows if empty"),
    Column("min", "minimum", "the lowest value that may be written, in the unit of measure", ("minimum",)),
    Column("max", "maximum", "the highest", ("maximum",)),
    Column("enumeration", "enumeration", "names of numbers: `0=off | 1=on`; also with `;` between", ("enum", "values")),
    Column("description", "description", "text, for people", ("comment", "remarks")),
    Column("value", "value", "the first value, in the unit of measure; zero if empty", ("default", "start")),
)
"""The columns, in the order of the documentation."""

_BY_HEADER: Final = {header: column for column in COLUMNS for header in (column.name, *column.also)}
_NAME_OF_KEY: Final = {column.key: column.name for column in COLUMNS if column.key}


def read_register_map(path: str | os.PathLike[str]) -> list[SimulatedPointSection]:
    """Return the points that the register map in a CSV file describes, in the order of its rows.

    Args:
        path: path of the file.

    Raises:
        FileError: the file is invalid; the error has all problems, each with file, line and column.
        ConfigError: the file cannot be read.
    """
    name = os.fspath(path)
    return parse_register_map(_read(name), name)


def read_what_fits(path: str) -> tuple[list[tuple[int, dict[str, Any]]], list[ConfigError]]:
    """Read those rows of a CSV file that can be read as keys of points, and return the errors in the others.

    Args:
        path: path of the file. Unknown columns are left out of all rows and reported as errors.

    Returns:
        Two lists: line number and keys of each row that could be read, the keys not yet checked by the schema; and the
        errors, each with file, line and column.

    Raises:
        FileError: there is no header line with columns for name and address, or a column is there twice.
        ConfigError: the file cannot be read.
    """
    reader = _Reader(path, _decoded(_read(path)), skips_columns=True)
    rows = reader.rows()
    if not rows and reader.problems:
        raise FileError(in_order(reader.problems))
    found = []
    for row in rows:
        keys, faults = _keys_of(row)
        if faults:
            name = row.cells.get("name", "")
            reader.problems += [
                ConfigError(sentence, file=path, line=row.line, key=f"{name}.{column}" if name else column)
                for column, sentence in faults
            ]
        else:
            found.append((row.line, keys))
    return found, in_order(reader.problems)


def _read(name: str) -> bytes:
    try:
        return Path(name).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"cannot be read: {reason[:1].lower()}{reason[1:]}", file=name) from error


def parse_register_map(data: bytes | str, name: str) -> list[SimulatedPointSection]:
    """Return the points that a register map in CSV describes, in the order of its rows.

    Args:
        data: content of the file, as bytes or decoded.
        name: name of the file, for errors.

    Raises:
        FileError: the register map is invalid or has no point; the error has all problems, each with file, line and
            column.
    """
    text = data if isinstance(data, str) else _decoded(data)
    reader = _Reader(name, text)
    rows = reader.rows()
    problems = reader.problems
    lines: dict[KeyPath, int] = {(): 1}
    points: list[dict[str, Any]] = []  # Any: what a key of a point takes
    for row in rows:
        keys, faults = _keys_of(row)
        problems += [ConfigError(sentence, file=name, line=row.line, key=column) for column, sentence in faults]
        if faults:
            continue
        lines[("point", len(points))] = row.line
        lines |= {("point", len(points), key): row.line for key in keys}
        points.append(keys)
    found: list[SimulatedPointSection] = []
    if points:
        try:
            found = list(Source(name, {"unit": 1, "point": points}, lines).checked(SimulatedUnitSection).point)
        except FileError as error:
            problems += [
                ConfigError(each.message, file=name, line=each.line, key=_column_of(each.key))
                for each in error.problems
            ]
    if not points and not problems:
        problems.append(ConfigError("there is no point", file=name, line=1))
    if problems:
        raise FileError(in_order(problems))
    return found


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of a register map.

    Attributes:
        line: number of its line in the file.
        cells: the cells that are not empty, by name of the column.
        decimal_comma: whether numbers may have a decimal comma, as commas do not separate cells.
    """

    line: int
    cells: Mapping[str, str]
    decimal_comma: bool


@dataclass(slots=True)
class _Reader:
    """Splits a register map in CSV into rows, and collects the errors in it.

    Attributes:
        name: name of the file, for errors.
        text: content of the file.
        skips_columns: whether unknown columns are left out; if False, no row is read from a map with unknown columns.
        problems: the errors so far.
    """

    name: str
    text: str
    skips_columns: bool = False
    problems: list[ConfigError] = field(default_factory=list)

    def rows(self) -> list[_Row]:
        """Return the rows of the register map below its header line, without empty lines and comments.

        Rows with too many cells are left out. Without a valid header line, returns no rows. Adds errors to `problems`.
        """
        begin, header = self._header_line()
        if header is None:
            self._complain("there is no line with columns; there are " + ", ".join(_NAME_OF_KEY.values()), begin)
            return []
        delimiter = max(_DELIMITERS, key=lambda each: _known_in(header, each))
        columns: list[Column | None] | None = None
        found = []
        for line, cells in self._records(delimiter, begin):
            if not any(cells) or cells[0].startswith("#"):
                continue
            if columns is None:
                columns = self._columns(cells, line)
                if columns is None:
                    return []
                continue
            if len(cells) > len(columns) and any(cells[len(columns) :]):
                self._complain(f"{len(cells)} cells, but there are {len(columns)} columns", line)
                continue
            pairs = zip(columns, cells, strict=False)
            found.append(_Row(line, {column.name: cell for column, cell in pairs if column and cell}, delimiter != ","))
        return found

    def _header_line(self) -> tuple[int, str | None]:
        """Return number and text of the first line that is neither empty nor a comment; 1 and None if there is none."""
        for number, line in enumerate(self.text.splitlines(), 1):
            if line.strip(" \t,;") and not line.lstrip(" \t\"'").startswith("#"):
                return number, line
        return 1, None

    def _records(self, delimiter: str, begin: int) -> Iterator[tuple[int, list[str]]]:
        """Yield the CSV records from line ``begin`` on, each with the number of its first line; ends at invalid CSV."""
        body = "\n".join(self.text.splitlines()[begin - 1 :])
        reader = csv.reader(io.StringIO(body, newline=""), delimiter=delimiter, strict=True)
        line = begin
        try:
            for cells in reader:
                yield line, [cell.strip() for cell in cells]
                line = begin + reader.line_num
        except csv.Error as error:
            self._complain(f"is no CSV: {error}", line)

    def _columns(self, cells: list[str], line: int) -> list[Column | None] | None:
        """Return the column for each cell of the header line; None for a cell whose column is not read.

        Returns None instead of a list if a needed column is missing, or one is there twice or unknown; unknown columns
        are permitted with `skips_columns`. Adds errors to `problems`.
        """
        columns: list[Column | None] = []
        is_usable = True
        for number, cell in enumerate(cells, 1):
            header = " ".join(cell.lower().split())
            column = _BY_HEADER.get(header)
            if column is None and header and not header.startswith("#"):
                similar = similar_name(header, _BY_HEADER)
                known = f"is it {similar}?" if similar else f"there are {', '.join(each.name for each in COLUMNS)}"
                self._complain(f"there is no such column; {known}", line, cell)
                is_usable = is_usable and self.skips_columns
            if column is not None and column in columns:
                self._complain(f"column {number} is {column.name} once more", line, cell)
                is_usable = False
            columns.append(column)
        for needed in ("name", "address"):
            if not any(column and column.name == needed for column in columns):
                self._complain("this column is missing", line, needed)
                is_usable = False
        return columns if is_usable else None

    def _complain(self, sentence: str, line: int, column: str | None = None) -> None:
        self.problems.append(ConfigError(sentence, file=self.name, line=line, key=column))


def _decoded(data: bytes) -> str:
    for mark, encoding in _ENCODINGS:
        if data.startswith(mark):
            return data.decode(encoding, errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _known_in(header: str, delimiter: str) -> int:
    """Return the number of known column names in a header line if it is split by this delimiter."""
    return sum(" ".join(cell.strip(' "').lower().split()) in _BY_HEADER for cell in header.split(delimiter))


def _column_of(key: str | None) -> str | None:
    """Return the register map column for the path of a point's key: ``point[3].unit_of_measure`` → ``unit``.

    Returns the name of the key itself if no column gives the key; None if there is no key.
    """
    last = re.sub(r"\[\d+\]$", "", (key or "").rpartition("]")[2].lstrip(".").partition("[")[0].partition(".")[0])
    return _NAME_OF_KEY.get(last, last or None)


def _keys_of(row: _Row) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Return the keys for a `SimulatedPointSection` that a row of a register map gives, and the errors in the row.

    Each error is a pair of column and message. Keys whose cells are empty or invalid are left out.
    """
    cells = row.cells
    keys: dict[str, Any] = {}
    faults = [(needed, "is empty") for needed in ("name", "address") if needed not in cells]

    def take(column: str, read: Callable[[str], Any]) -> Any:
        try:
            return read(cells[column]) if column in cells else None
        except (ValueError, InvalidRequest) as error:
            faults.append((column, getattr(error, "message", None) or str(error)))
            return None

    for key in ("name", "type", "order", "description"):
        keys[key] = cells.get(key)
    keys["unit_of_measure"] = cells.get("unit")
    for column, key in (("scale", "scale"), ("min", "minimum"), ("max", "maximum")):
        keys[key] = take(column, lambda text: _number(text, row))
    keys["access"] = take("access", _access)
    keys["enumeration"] = take("enumeration", _enumeration)
    table = take("table", _table)
    can_place = table is not None or "table" not in cells
    place = take("address", lambda text: _place(text, table)) if can_place else None
    keys = {key: value for key, value in keys.items() if value is not None}
    if place is not None:
        is_bit = place.bit is not None or (place.table is not None and place.table.holds_bits)
        if is_bit and keys.get("type", "").lower() in _BIT_TYPES:
            del keys["type"]
        value = take("value", lambda text: _value(text, row, keys, is_bit=is_bit))
        keys |= {"address": str(place)} | ({} if value is None else {"value": value})
    return keys, faults


def _table(text: str) -> Table:
    """Return the table that a cell of a register map names, such as ``holding``. Raises `ValueError` for no table."""
    found = table_named(text)
    if found is None:
        raise ValueError(f"there is no table {shown(text)}, but coil, discrete, input and holding")
    return found


def _place(text: str, table: Table | None) -> Address:
    """Parse an address that names its table, or a plain number, which is an offset in ``table``.

    Raises `InvalidRequest` if the text is neither, or names another table than ``table``.
    """
    place = parse_address(text, table=table)
    try:
        return parse_address(text)
    except InvalidRequest:
        return parse_address(format_address(place))  # a plain number, of the column's table


def _number(text: str, row: _Row) -> float:
    plain = _with_point(text, row)
    if not _NUMBER.fullmatch(plain):
        raise ValueError(f"must be a number, not {shown(text)}")
    return float(plain)


def _with_point(text: str, row: _Row) -> str:
    """Return the text of a number with a decimal point instead of a decimal comma, if the map may have such commas."""
    return text.replace(",", ".") if row.decimal_comma and text.count(",") == 1 and "." not in text else text


def _access(text: str) -> str:
    word = text.lower()
    for access, words in _ACCESS.items():
        if word in words:
            return access
    raise ValueError(f"must be read or read-write, not {shown(text)}")


def _enumeration(text: str) -> dict[str, int]:
    """Return the names and numbers in a cell such as ``0=off | 1=on``, as a dictionary from name to number.

    Raises:
        ValueError: the cell is written otherwise, or has a name twice.
    """
    found: dict[str, int] = {}
    for entry in re.split(r"[|;\n]", text):
        if not entry.strip():
            continue
        match = _ENTRY.fullmatch(entry)
        if match is None or not _WHOLE.fullmatch(match["number"]) or not match["label"]:
            raise ValueError(f"must be written 0=off | 1=on, not {shown(entry.strip())}")
        if match["label"] in found:
            raise ValueError(f"{match['label']} is {found[match['label']]} already")
        found[match["label"]] = _whole(match["number"])
    return found


def _whole(text: str) -> int:
    """Return the integer in a cell: decimal, also with leading zeros, ``0x…`` or ``0b…``."""
    return int(text, 0) if text[1:2] in ("x", "X", "b", "B") else int(text)


def _value(text: str, row: _Row, keys: Mapping[str, Any], *, is_bit: bool) -> Any:
    """Return the initial value in a cell of a register map, as the key ``value`` of a point takes it.

    Args:
        text: the cell: a name of the enumeration, on or off, a number in the unit of measure, or the notation of the
            type.
        row: the row of the cell.
        keys: the keys of the point so far: its enumeration, type, order and scale decide how the cell is read.
        is_bit: whether the point is one bit.

    Raises:
        ValueError, InvalidRequest: the cell cannot be read as such a value.
    """
    if text in keys.get("enumeration", {}):
        return text
    if is_bit:
        if text.lower() not in (*_TRUE, *_FALSE):
            raise ValueError(f"one bit is true or false, not {shown(text)}")
        return text.lower() in _TRUE
    if keys.get("scale", 1.0) != 1.0:
        return _number(text, row)
    form = value_type(keys.get("type", "uint16"), keys.get("order", "ABCD"))
    return form.parse(_with_point(text, row) if form.name.startswith("float") else text)
