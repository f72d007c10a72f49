"""How commands print values on stdout: a table on a terminal, aligned lines elsewhere, JSON lines or CSV on demand.

Knows rows and how they look; knows no device.

1. A value is printed in the form that `busway write` accepts: states as ``on`` and ``off``, floats with the fewest
   digits that give the same registers again.
2. JSON is one object per line, so that a program can read output of any length. ``nan`` and ``inf``, which JSON does
   not have, are texts.
3. CSV has one header line, at the beginning.
4. Texts of devices and certificates are printed without control characters (`printable`); JSON escapes these.
"""

import math
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ..errors import ConfigError
from ..values import Address, ValueType, format_address, printable

NOT_READ_BACK = "written, not read back"
"""Outcome of a write that ``--verify`` could not read back."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """One value to print, with its address and its bytes.

    Attributes:
        address: the address of the value.
        value: the value that was read or written; None if it could not be read.
        raw: bytes of its registers in wire order; for a bit that was read from a register, both bytes of the register;
            for a coil, a discrete input and a written bit one byte, 0 or 1; empty if it could not be read.
        type: name of its value type; ``bit`` for one bit.
        reason: why it could not be read; empty if it was read or written.
        written: True for a value that was written, False for one that was read.
        verified: for a written value, whether the device holds it, as reading back has shown; None if it was not to be
            read back.
        read_back: False if ``verified`` is False because the value could not be read back.
        holds: the value that the device holds instead, if ``verified`` is False and the value was read back.
    """

    address: Address
    value: Any  # what its type says
    raw: bytes
    type: str = ""
    reason: str = ""
    written: bool = False
    verified: bool | None = None
    read_back: bool = True
    holds: Any = None  # what its type says

    @property
    def outcome(self) -> str:
        """The result of a write in words: ``written``, and what reading back showed; empty if not written."""
        if not self.written:
            return ""
        if self.verified is None:
            return "written"
        if not self.read_back:
            return NOT_READ_BACK
        return "written, read back" if self.verified else f"written, but the device holds {shown_value(self.holds)}"

    @property
    def quality(self) -> str:
        """``good``; ``bad`` if the value could not be read."""
        return "bad" if self.reason else "good"

    @property
    def raw_text(self) -> str:
        """The bytes ``raw`` as text: registers in hexadecimal, four digits each; one byte as 0 or 1; empty if none."""
        return str(self.raw[0]) if len(self.raw) == 1 else self.raw.hex(" ", 2)


def value_rows(place: Address, form: ValueType[Any] | None, values: Sequence[Any], raw: bytes) -> list[TableRow]:
    """Return the rows to print for values at consecutive addresses, in order.

    Args:
        place: address of the first value.
        form: value type; None for coils and discrete inputs.
        values: the values.
        raw: bytes of their registers in wire order, one value after the other; without ``form`` one byte for each
            value, 0 or 1.
    """
    size = 1 if form is None else 2 * form.registers
    rows = []
    for index, (address, value) in enumerate(zip(_addresses(place, form, len(values)), values, strict=True)):
        if form is not None and form.name.startswith("float"):
            value = fewest_digits(value, size)
        rows.append(TableRow(address, value, raw[index * size : (index + 1) * size], _type_name(place, form)))
    return rows


def failed_rows(place: Address, form: ValueType[Any] | None, count: int, reason: str) -> list[TableRow]:
    """Return the rows to print for values at consecutive addresses that could not be read, in order.

    Args:
        place: address of the first value.
        form: value type; None for coils and discrete inputs.
        count: number of values.
        reason: why they could not be read.
    """
    name = _type_name(place, form)
    return [TableRow(address, None, b"", name, reason) for address in _addresses(place, form, count)]


def _addresses(place: Address, form: ValueType[Any] | None, count: int) -> list[Address]:
    step = 1 if form is None else form.registers
    return [Address(place.table, place.offset + index * step, place.bit) for index in range(count)]


def _type_name(place: Address, form: ValueType[Any] | None) -> str:
    return "bit" if form is None or place.bit is not None else form.name


def fewest_digits(value: float, size: int) -> float:
    """Return the float with the fewest decimal digits that has the same bytes as ``value`` in ``size`` bytes.

    For example 0.1 for 0.10000000149 in 4 bytes. Infinities, NaN and sizes other than 2 and 4 are returned unchanged.

    Args:
        value: a float that a device holds.
        size: its size in the device, in bytes.
    """
    letter = {2: ">e", 4: ">f"}.get(size)
    if letter is None or not math.isfinite(value):
        return value
    wanted = struct.pack(letter, value)
    for digits in range(1, 10):
        short = float(f"{value:.{digits}g}")
        try:
            if struct.pack(letter, short) == wanted:
                return short
        except OverflowError:  # rounded up beyond the largest number of this size
            continue
    return value


def float32_digits(value: Any) -> Any:
    """Return a float with the fewest digits that give the same float of 32 bits: 0.1 for 0.10000000149.

    A value that is no float, or that 32 bits cannot hold exactly, is returned unchanged; a store has such values from
    times when the point had another type.
    """
    from ..points.conversion import is_float32

    return fewest_digits(value, 4) if isinstance(value, float) and is_float32(value) else value


def shown_value(value: Any) -> str:
    """Return a value as text for people: ``on`` or ``off`` for a bool, ``0b…`` for a tuple of 16 bits, else its str.

    Texts lose their control characters.
    """
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):  # sixteen bits, the least significant first
        return "0b" + "".join("1" if bit else "0" for bit in reversed(value))
    if isinstance(value, str):
        return printable(value)
    return str(value)


def json_value(value: Any) -> Any:
    """Return a value in a form that JSON has: infinities and NaN become texts, tuples lists; others are unchanged."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return list(value) if isinstance(value, tuple) else value


class Writer(Protocol):
    """Interface of an object that prints rows of values on stdout, in one of several forms."""

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        """Print rows of values; ``time`` is when they were read (ISO 8601), empty to print no time."""

    def close(self) -> None:
        """End the printing; what a table that is redrawn in place showed last stays on the terminal."""


def choose_writer(*, as_json: bool, as_csv: bool, repeats: bool = False) -> Writer:
    """Return the writer of rows for the options of the command and the kind of stdout.

    Args:
        as_json, as_csv: whether ``--json``, ``--csv`` is given.
        repeats: whether the same rows are written again and again; then a terminal has one table redrawn in place.

    Raises:
        ConfigError: both options are given.
    """
    if as_json and as_csv:
        raise ConfigError("does not go with --json", key="--csv")
    if as_json:
        return JsonWriter()
    if as_csv:
        return CsvWriter()
    if sys.stdout.isatty():
        return LiveTableWriter() if repeats else TableWriter()
    return LineWriter()


class LineWriter:
    """Prints each value on a line: time if there is one, address, value, bytes, and for written values the outcome.

    Values that could not be read are left out: the command has printed their errors on stderr.
    """

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        cells = [
            (*([time] if time else []), format_address(row.address), shown_value(row.value), row.raw_text, row.outcome)
            for row in rows
            if not row.reason
        ]
        print_aligned(cells)

    def close(self) -> None:
        pass


class JsonWriter:
    """Prints values as one JSON object per line."""

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        for row in rows:
            fields: dict[str, Any] = {"time": time} if time else {}
            fields |= {
                "address": format_address(row.address),
                "table": row.address.table.value if row.address.table else None,
                "offset": row.address.offset,
                "value": json_value(row.value),
            }
            if not row.written:
                fields |= {"quality": row.quality, "reason": row.reason}
            fields |= {"type": row.type, "raw": row.raw.hex()}
            if row.written:
                fields["written"] = True
            if row.verified is not None:
                fields["verified"] = row.verified
            if row.verified is False and row.read_back:
                fields["holds"] = json_value(row.holds)
            print_json(fields)
        sys.stdout.flush()

    def close(self) -> None:
        pass


class CsvWriter:
    """Prints values as CSV: a header line, then one line per value."""

    def __init__(self) -> None:
        self._has_header = False

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        written = any(row.written for row in rows)
        names = ["type", "raw", "outcome"] if written else ["quality", "reason", "type", "raw"]
        header = [] if self._has_header else [*(["time"] if time else []), "address", "value", *names]
        self._has_header = True
        lines = []
        for row in rows:
            value = "" if row.value is None else shown_value(row.value)
            lines.append([*([time] if time else []), format_address(row.address), value])
            lines[-1] += [] if written else [row.quality, row.reason]
            lines[-1] += [row.type, row.raw.hex(), *([row.outcome] if written else [])]
        print_csv(header, lines)

    def close(self) -> None:
        pass


class TableWriter:
    """Prints values as a table with headings, a new one for each call; leaves out values that could not be read."""

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        from rich.console import Console

        Console().print(_table(rows, time))

    def close(self) -> None:
        pass


class LiveTableWriter:
    """Prints values as one table that is redrawn in place on a terminal; leaves out values that could not be read."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._live.start()

    def write(self, rows: Sequence[TableRow], time: str = "") -> None:
        self._live.update(_table(rows, time), refresh=True)

    def close(self) -> None:
        self._live.stop()


class LivePage:
    """Shows lines of cells on a terminal, in columns, and redraws them in place."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._live.start()

    @staticmethod
    def fits() -> bool:
        """Whether stdout is a terminal, so that lines can be redrawn in place."""
        return sys.stdout.isatty()

    def show(self, lines: Sequence[Sequence[str]], time: str) -> None:
        """Replace the lines on the terminal by these lines of cells.

        ``time`` (ISO 8601) is shown below as time of day; nothing if it is empty.
        """
        from rich.table import Table as RichTable
        from rich.text import Text

        grid = RichTable(show_header=False, box=None, caption=time[11:19] or None, caption_justify="left")
        for cells in lines:
            grid.add_row(*(Text(printable(cell)) for cell in cells))
        self._live.update(grid, refresh=True)

    def close(self) -> None:
        """End redrawing; the last lines stay on the terminal."""
        self._live.stop()


def _table(rows: Sequence[TableRow], time: str) -> Any:
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(caption=time[11:19] or None, caption_justify="left")
    table.add_column("Address")
    table.add_column("Value", justify="right")
    table.add_column("Raw", style="dim")
    outcome = any(row.written for row in rows)
    if outcome:
        table.add_column("Outcome")
    for row in rows:
        if row.reason:
            continue
        outcomes = [Text(row.outcome)] if outcome else []
        table.add_row(format_address(row.address), Text(shown_value(row.value)), row.raw_text, *outcomes)
    return table


def print_aligned(lines: Sequence[Sequence[str]]) -> None:
    """Print lines of cells on stdout in columns, each as wide as its widest cell; nothing if there are no lines.

    All lines must have the same number of cells.
    """
    if not lines:
        return
    lines = [[printable(cell) for cell in cells] for cells in lines]
    widths = [max(len(cells[index]) for cells in lines) for index in range(len(lines[0]))]
    for cells in lines:
        print("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())
    sys.stdout.flush()


def print_csv(header: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """Print lines of cells on stdout as CSV, below the header line ``header`` unless it is empty."""
    import csv

    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerows([header] if header else [])
    writer.writerows([printable(cell) for cell in cells] for cells in lines)
    sys.stdout.flush()


def print_json(fields: dict[str, Any]) -> None:
    """Print one JSON object on a line of stdout."""
    print(json_text(fields))


def json_text(document: Any, *, indent: int | None = None) -> str:
    """Return JSON text that any stdout and terminal can show: other characters become JSON escapes such as ``\\u001b``.

    Args:
        document: what JSON can represent.
        indent: spaces of indentation for each level; None for one line.
    """
    import json

    encoding = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().replace("-", "")
    text = json.dumps(document, indent=indent, ensure_ascii=not encoding.startswith("utf"))
    if text.replace("\n", "").isprintable():
        return text
    return "".join(each if each.isprintable() or each == "\n" else json.dumps(each)[1:-1] for each in text)


class _Progress:
    """Holds for the whole process whether `say` prints (``shown``)."""

    shown = True


def show_progress(shown: bool) -> None:
    """Set for the whole process whether `say` prints; the option ``--quiet`` turns it off."""
    _Progress.shown = shown


def say(sentence: str) -> None:
    """Print one sentence about progress on stderr; nothing with ``--quiet``."""
    if _Progress.shown:
        warn(sentence)


def warn(sentence: str) -> None:
    """Print one sentence on stderr about what failed or is not as expected, also with ``--quiet``."""
    print(f"busway: {printable(sentence)}", file=sys.stderr, flush=True)


def say_problems(sentence: str, problems: str) -> None:
    """Print one sentence on stderr, also with ``--quiet``, and below it the lines of ``problems``, one for each."""
    warn(sentence)
    for line in problems.split("\n"):
        print(printable(line), file=sys.stderr, flush=True)
