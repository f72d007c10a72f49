"""Reads values from several addresses with as few requests as their addresses allow.

Knows places, types and requests; knows no link. Ranges that touch or overlap become one request; nothing is read that
was not asked for, because a device may refuse a range with a hole in it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from ..codes import MAX_READ_BITS, MAX_READ_REGISTERS, TABLE_SIZE, Table
from ..errors import InvalidRequest
from ..pdu.message import Request
from ..pdu.read_items import ReadBits, ReadRegisters
from ..pdu.wide_registers import NARROW
from ..values import Address, ValueType, value_type
from .operations import READ, Operation, place_of

Wanted: TypeAlias = (
    str
    | Address
    | tuple[str | Address]
    | tuple[str | Address, str | ValueType[Any] | None]
    | tuple[str | Address, str | ValueType[Any] | None, int | None]
)
"""What is wanted under one name: an address, with a type, and with a number of values for a list."""


@dataclass(frozen=True, slots=True)
class _Item:
    """One named value to be read: ``items`` registers or bits of a table from ``offset`` on, and its type."""

    name: str
    table: Table
    offset: int
    items: int
    form: ValueType[Any] | None
    count: int | None

    @property
    def end(self) -> int:
        return self.offset + self.items


@dataclass(slots=True)
class _Range:
    """The addresses of one read request, and the named values in them."""

    table: Table
    offset: int
    end: int
    items: list[_Item]

    def request(self) -> Request:
        return READ[self.table](self.offset, self.end - self.offset)


def read_together(wanted: Mapping[str, Wanted], order: str, width: int = NARROW) -> Operation:
    """Read all named values with few requests. Returns a dict of them, in the order of the names."""
    if width != NARROW:
        raise InvalidRequest(f"read_many needs registers of 2 bytes, not of {width}; read each value by itself")
    items = [_item(name, one, order) for name, one in wanted.items()]
    if not items:
        return {}
    ranges = _ranges(items)
    requests = [one.request() for one in ranges]
    replies = yield requests
    found: dict[str, Any] = {}
    for one, reply in zip(ranges, replies, strict=True):
        for item in one.items:
            values = _values(reply, item, one)
            found[item.name] = values[0] if item.count is None else values
    return {item.name: found[item.name] for item in items}


def _item(name: str, wanted: Wanted, order: str) -> _Item:
    address, kind, count = (*wanted, None, None)[:3] if isinstance(wanted, tuple) else (wanted, None, None)
    if isinstance(wanted, tuple) and not 1 <= len(wanted) <= 3:
        raise InvalidRequest(f"{name}: an address, a type and a count are wanted, not {wanted!r}")
    try:
        return _placed(name, address, kind, count, order)
    except InvalidRequest as error:
        raise InvalidRequest(f"{name}: {error.message}") from error


def _placed(
    name: str, address: str | Address, kind: str | ValueType[Any] | None, count: int | None, order: str
) -> _Item:
    place = place_of(address)
    assert place.table is not None
    number = 1 if count is None else count
    if number < 1:
        raise InvalidRequest(f"count must be at least 1, not {number}")
    form = None
    items, limit = number, MAX_READ_BITS
    if place.table.holds_bits:
        if kind is not None:
            raise InvalidRequest(f"{place}: a {place.table.label} is one bit and has no type {kind}")
    else:
        form = value_type(f"bit:{place.bit}" if place.bit is not None else kind or "uint16", order)
        items, limit = form.registers_for(number), MAX_READ_REGISTERS
    if items > limit:
        raise InvalidRequest(f"{place}: {items} {place.table.label}s are more than the {limit} of one request")
    if place.offset + items > TABLE_SIZE:
        raise InvalidRequest(f"{place}: {items} {place.table.label}s end beyond the last one, {TABLE_SIZE}")
    return _Item(name, place.table, place.offset, items, form, count)


def _ranges(items: Iterable[_Item]) -> list[_Range]:
    """Group the values to be read into ranges of one request each; no value lies in two of them."""
    ranges: list[_Range] = []
    for item in sorted(items, key=lambda one: (one.table.value, one.offset, one.end)):
        last = ranges[-1] if ranges else None
        limit = MAX_READ_BITS if item.table.holds_bits else MAX_READ_REGISTERS
        if (
            last is not None
            and last.table is item.table
            and item.offset <= last.end
            and max(item.end, last.end) - last.offset <= limit
        ):
            last.end = max(last.end, item.end)
            last.items.append(item)
        else:
            ranges.append(_Range(item.table, item.offset, item.end, [item]))
    return ranges


def _values(reply: object, item: _Item, one: _Range) -> list[Any]:
    begin = item.offset - one.offset
    if isinstance(reply, ReadBits.Reply):
        return reply.bits(one.end - one.offset)[begin : begin + item.items]
    assert isinstance(reply, ReadRegisters.Reply)
    assert item.form is not None
    return item.form.decode(reply.data[2 * begin : 2 * (begin + item.items)])
