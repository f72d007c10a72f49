"""Importer for modpoll: its CSV of lines ``device``, ``poll`` and ``ref``.

Knows modpoll's columns and types. Addresses of modpoll count from 0. The first half of an order such as ``BE_LE`` is
that of the bytes in a register, the second half that of the registers; texts have no order.

1. A ``ref`` belongs to the ``poll`` before it, and that to the ``device`` before it; without one the unit is 1. If one
   of these lines is invalid, the points that belong to it are left out: which unit and table they have is not known.
2. Among coils and discrete inputs, ``bool8`` and ``bool16`` are addressed by bytes: the address after the first one of
   the poll is that of its ninth item (modpoll 1.6, and its example ``modsim.csv``).
3. ``bool8`` of a register is its high byte.
"""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from ...values.unfit_values import shown
from .imported import ImportedDevice

_TABLES: Final = {
    "coil": "coil",
    "discrete_input": "discrete",
    "input_register": "input",
    "holding_register": "holding",
}
_ORDERS: Final = {"BE_BE": "ABCD", "LE_BE": "BADC", "BE_LE": "CDAB", "LE_LE": "DCBA"}
_NUMBER: Final = re.compile(r"(u?int|float)(16|32|64)")
_STRING: Final = re.compile(r"string(\d+)")
_BOOLS: Final = re.compile(r"bool(8|16)?")
_ADDRESS: Final = re.compile(r"(0x[0-9a-fA-F]{1,8}|[0-9]{1,8})(?::([0-9]{1,2}))?")
"""An address, and the number of a bit behind a colon."""


@dataclass(frozen=True, slots=True)
class _Poll:
    """What the points of a ``poll`` line have in common.

    Attributes:
        table: the table.
        order: the order of bytes and registers.
        start, size: address of the first item read, and the number of items.
    """

    table: str
    order: str
    start: int
    size: int

    @property
    def has_bits(self) -> bool:
        """Whether its items are coils or discrete inputs."""
        return self.table in ("coil", "discrete")


def is_modpoll(text: str) -> bool:
    """Whether a CSV text has lines whose first cell is ``poll`` and lines whose first cell is ``ref``."""
    heads = [line.partition(",")[0].strip().lower() for line in text.splitlines()]
    return "poll" in heads and "ref" in heads


def read_modpoll(text: str, name: str) -> ImportedDevice:
    """Import the points of a modpoll configuration (CSV).

    Args:
        text: the CSV text.
        name: the file's name; not used.

    Returns:
        The points, by unit; and as ``omissions`` the lines that could not be carried over, all ``poll`` lines included.
    """
    found = ImportedDevice()
    unit: int | None = 1
    poll: _Poll | None = None
    rows = csv.reader(io.StringIO(text))
    for row in rows:
        cells = [cell.strip() for cell in row]
        where = f"line {rows.line_num}"
        kind = cells[0].lower() if cells else ""
        if not kind or kind.startswith("#"):
            continue
        if kind in ("device", "poll"):  # what follows belongs to this line, also where it is invalid
            unit, poll = None if kind == "device" else unit, None
        if kind == "device" and len(cells) > 2 and cells[2].isdecimal():
            unit = int(cells[2])
            found.remarks.append(f"Unit {unit} is modpoll's device {cells[1]}.")
        elif kind == "poll" and len(cells) > 3:
            poll = _poll(cells)
            if poll is None:
                found.omit(where, ",".join(cells), "has no table, order or range that modpoll has")
            found.omit(where, ",".join(cells), "which reads are made is planned, and not written down")
        elif kind == "ref":
            _reference(cells, where, unit, poll, found)
        else:
            found.omit(where, ",".join(cells), "is no line of modpoll that is known")
    return found


def _poll(cells: Sequence[str]) -> _Poll | None:
    table = _TABLES.get(cells[1].lower())
    order = _ORDERS.get(cells[4].upper() if len(cells) > 4 and cells[4] else "BE_BE")
    start, size = _ADDRESS.fullmatch(cells[2]), _ADDRESS.fullmatch(cells[3])
    if not table or not order or not start or not size or start[2] or size[2]:
        return None
    return _Poll(table, order, _whole(start[1]), _whole(size[1]))


def _whole(digits: str) -> int:
    return int(digits, 16 if digits.startswith("0x") else 10)


def _reference(cells: Sequence[str], where: str, unit: int | None, poll: _Poll | None, found: ImportedDevice) -> None:
    name, place, kind, access, measure, scale = [*cells[1:7], "", "", "", "", "", ""][:6]
    address = _ADDRESS.fullmatch(place)
    if unit is None or poll is None or address is None:
        found.omit(where, name or "a point", f"has no unit, no table or no address: {shown(','.join(cells))}")
        return
    keys: dict[str, object] = {"name": name, "unit_of_measure": measure or None}
    first, bools = _whole(address[1]), _BOOLS.fullmatch(kind.lower())
    if address[2] and (kind.lower() != "bool" or poll.has_bits or int(address[2]) > 15):
        found.omit(where, name, f"is no bit of a register: {shown(','.join(cells))}")
        return
    if bools or poll.has_bits:
        bit = None if address[2] is None else int(address[2])
        bits = list(_bits(poll, first, bools[1] if bools else None, bit))
        for of_name, at in bits:
            found.add(unit, {**keys, "name": name if of_name is None else f"{name}.{of_name}", "address": at}, where)
        if not bits:
            found.omit(where, name, "is outside of what its poll reads")
        elif kind.lower() == "bool" and bit is None and not (poll.has_bits and first == poll.start):
            found.omit(where, f"{name}.bool", f"eight bits in modpoll; taken as {bits[0][1]} alone")
        return
    number, text = _NUMBER.fullmatch(kind.lower()), _STRING.fullmatch(kind.lower())
    if number is None and text is None:
        found.omit(where, name, f"has a type that there is not: {shown(kind)}")
        return
    keys |= {"address": f"{poll.table}:{first}", "type": f"string:{text[1]}" if text else kind.lower()}
    keys["order"] = poll.order if number and poll.order != "ABCD" else None
    if number and scale:
        try:
            keys["scale"] = float(scale)
        except ValueError:
            found.omit(where, f"{name}.scale", f"is no number: {shown(scale)}")
    if poll.table == "holding" and access.lower() == "r":
        keys["access"] = "read"
    found.add(unit, keys, where)


def _bits(poll: _Poll, first: int, width: str | None, bit: int | None) -> Iterator[tuple[int | None, str]]:
    """Yield the addresses of the bits of a reference, each with its number in the name of its point (rules 2 and 3).

    Args:
        poll: the poll that reads them.
        first: the address of the reference.
        width: "8" or "16" of ``bool8`` or ``bool16``; None for one bit, which has no number.
        bit: the number of the one bit, if the reference names it; None for 0.
    """
    if poll.has_bits:
        first_bit = first if width is None else poll.start + 8 * (first - poll.start)
        for number in range(int(width or 1)):
            if poll.start <= first_bit + number < poll.start + poll.size:
                yield None if width is None else number, f"{poll.table}:{first_bit + number}"
        return
    if width is None:
        # An order of bytes other than that of the wire exchanges the halves of the register, and so its bits.
        shift = 8 if bit is not None and poll.order in ("BADC", "DCBA") else 0
        yield None, f"{poll.table}:{first}.{((bit or 0) + shift) % 16}"
        return
    for number in range(8 if width == "8" else 0, 16):
        yield number, f"{poll.table}:{first}.{number}"
