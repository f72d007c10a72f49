"""Importer for modpoll: its CSV of lines ``device``, ``poll`` and ``ref``.

Knows modpoll's columns and types. Addresses of modpoll count from 0. The first half of an order such as ``BE_LE`` is
that of the bytes in a register, the second half that of the registers.

A ``ref`` belongs to the ``poll`` before it, and that to the ``device`` before it; without one the unit is 1. If one of
these lines is invalid, the points that belong to it are left out: which unit and table they have is not known.
"""

import csv
import io
import re
from collections.abc import Sequence
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
    table, order = "", "ABCD"
    rows = csv.reader(io.StringIO(text))
    for row in rows:
        cells = [cell.strip() for cell in row]
        where = f"line {rows.line_num}"
        kind = cells[0].lower() if cells else ""
        if not kind or kind.startswith("#"):
            continue
        if kind in ("device", "poll"):  # what follows belongs to this line, also where it is invalid
            unit, table = None if kind == "device" else unit, ""
        if kind == "device" and len(cells) > 2 and cells[2].isdecimal():
            unit = int(cells[2])
            found.remarks.append(f"Unit {unit} is modpoll's device {cells[1]}.")
        elif kind == "poll" and len(cells) > 3:
            table = _TABLES.get(cells[1].lower(), "")
            order = _ORDERS.get(cells[4].upper() if len(cells) > 4 and cells[4] else "BE_BE", "")
            if not table or not order:
                found.omit(where, ",".join(cells), "is no table and order that modpoll has")
                table = ""
            found.omit(where, ",".join(cells), "which reads are made is planned, and not written down")
        elif kind == "ref":
            _reference(cells, where, unit, table, order, found)
        else:
            found.omit(where, ",".join(cells), "is no line of modpoll that is known")
    return found


def _reference(
    cells: Sequence[str], where: str, unit: int | None, table: str, order: str, found: ImportedDevice
) -> None:
    name, address, kind, access, measure, scale = [*cells[1:7], "", "", "", "", "", ""][:6]
    if unit is None or not table or not address.isdecimal():
        found.omit(where, name or "a point", f"has no unit, no table or no address: {shown(','.join(cells))}")
        return
    keys: dict[str, object] = {"name": name, "address": f"{table}:{address}", "unit_of_measure": measure or None}
    first, bools = int(address), _BOOLS.fullmatch(kind.lower())
    if bools or table in ("coil", "discrete"):
        count = int(bools[1] or 1) if bools else 1
        for place in range(count):
            bit = f"{table}:{first + place}" if table in ("coil", "discrete") else f"{table}:{first}.{place}"
            found.add(unit, {**keys, "name": name if count == 1 else f"{name}.{place}", "address": bit}, where)
        return
    number, text = _NUMBER.fullmatch(kind.lower()), _STRING.fullmatch(kind.lower())
    if number is None and text is None:
        found.omit(where, name, f"has a type that there is not: {shown(kind)}")
        return
    keys["type"] = f"string:{text[1]}" if text else kind.lower()
    keys["order"] = None if order == "ABCD" else order
    if number and scale:
        try:
            keys["scale"] = float(scale)
        except ValueError:
            found.omit(where, f"{name}.scale", f"is no number: {shown(scale)}")
    if table == "holding" and access.lower() == "r":
        keys["access"] = "read"
    found.add(unit, keys, where)
