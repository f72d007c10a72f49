"""Declares items that were read from a device, with their values, as the keys of a unit in a simulation file.

Knows tables and the keys of a unit; knows no device.

1. A table whose items have consecutive addresses is declared as a whole. In a table with holes, each item is declared
   as a point, so that requests for the holes are refused, as the device did.
"""

from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any

from ...codes import Table
from ...values import Address, format_address


def item_keys(tables: Mapping[Table, Mapping[int, int]]) -> dict[str, Any]:  # Any: what TOML has
    """Return the keys of a ``[[unit]]`` section that declare items with their values; tables without items have none.

    A table without holes has its own key, such as ``coils``; the items of other tables are in the key ``point``.

    Args:
        tables: for each table, the values of its items (bits: 0 or 1) by address, counted from 0.
    """
    keys: dict[str, Any] = {}
    points: list[dict[str, Any]] = []
    for table, items in tables.items():
        runs = list(_runs(items))
        if len(runs) == 1:
            keys[table.value] = _table_keys(table, *runs[0])
        else:
            points += [
                _unnamed(table, offset, value) for first, values in runs for offset, value in enumerate(values, first)
            ]
    if points:
        keys["point"] = points
    return keys


def _runs(items: Mapping[int, int]) -> Iterator[tuple[int, list[int]]]:
    """Yield the items in groups of consecutive addresses: the first address of each group, and its values."""
    for _, group in groupby(enumerate(sorted(items)), lambda pair: pair[1] - pair[0]):
        offsets = [offset for _, offset in group]
        yield offsets[0], [items[offset] for offset in offsets]


def _table_keys(table: Table, first: int, values: list[int]) -> dict[str, Any]:
    """Return the keys that declare a table with consecutive items; trailing zeros are left out of the values.

    Args:
        table: the table.
        first: address of the first item, counted from 0.
        values: the values of all items.
    """
    said = len(values)
    while said and not values[said - 1]:
        said -= 1
    kept: list[Any] = [bool(value) for value in values[:said]] if table.holds_bits else values[:said]
    return {"first": first, "count": len(values)} | ({"values": kept} if kept else {})


def _unnamed(table: Table, offset: int, value: int) -> dict[str, Any]:
    """Return the keys of a point for one item; its address, such as ``4x101``, becomes its name."""
    address = format_address(Address(table, offset))
    return {"name": address, "address": address, "value": bool(value) if table.holds_bits else value}
