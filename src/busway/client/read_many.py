"""Reads values from several addresses with as few requests as their addresses allow.

Knows addresses, value types and requests; knows no link.

1. Ranges that touch or overlap become one request, as far as the limit of one request allows. Nothing else is read
   with them, because a device may refuse a range in which registers are missing.
2. A program that polls asks for the same names again and again. So the requests, and how their replies are decoded, are
   kept as a plan for equal names, addresses and types. If there are `_MOST_PLANS` plans, a new one replaces them all.
3. All values of one type in a reply are decoded by one call: that is three times as fast as one by one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from ..codes import MAX_READ_BITS, MAX_READ_REGISTERS, TABLE_SIZE, Table
from ..errors import InvalidRequest
from ..pdu.message import Request
from ..pdu.read_items import ReadBits, ReadRegisters
from ..pdu.wide_registers import NARROW
from ..values import Address, ValueType, value_type
from .operations import READ, Operation, place_of

NamedRead: TypeAlias = (
    str
    | Address
    | tuple[str | Address]
    | tuple[str | Address, str | ValueType[Any] | None]
    | tuple[str | Address, str | ValueType[Any] | None, int | None]
)
"""What to read under one name: an address, or a tuple of address and type, or of address, type and count.

With a count the value is a list of that many values.
"""


@dataclass(frozen=True, slots=True)
class _Item:
    """One named value, or list of values, to be read.

    Attributes:
        name: its name in the result.
        table: the table that has it.
        offset: protocol address of the first register or bit, 0…65535.
        items: number of registers or bits.
        form: type of the values; None for coils and discrete inputs.
        count: number of values in the list; None for one value that is no list.
    """

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
    """One read request: the addresses from ``offset`` to ``end - 1``, and the named values that lie in them."""

    table: Table
    offset: int
    end: int
    items: list[_Item]

    def request(self) -> Request:
        return READ[self.table](self.offset, self.end - self.offset)


def read_together(wanted: Mapping[str, NamedRead], order: str, width: int = NARROW) -> Operation:
    """Read all named values, as a generator of requests. Its result is a dict of values by name, in the given order.

    Args:
        wanted: what to read, by name.
        order: order of bytes and registers in values, such as ``CDAB``; with ``ABCD`` a `ValueType` keeps its own.
        width: bytes of one register in replies; any other than 2 is refused.

    Raises:
        InvalidRequest: an address, type, count, order or width is invalid, or one request cannot read the values of one
            name. Nothing was sent.
        BadReply: bytes of a reply are no value of their type.
    """
    if width != NARROW:
        raise InvalidRequest(f"read_many needs registers of 2 bytes, not of {width}; read each value by itself")
    if not wanted:
        return {}
    plan = _plan_of(wanted, order)
    replies = yield plan.requests
    found = dict.fromkeys(plan.names)
    for one, reply in zip(plan.ranges, replies, strict=True):
        one.decode(reply, found)
    return found


def _plan_of(wanted: Mapping[str, NamedRead], order: str) -> "_Plan":
    key = (order, *wanted)
    known = _plans.get(key)
    if known is not None and known.wanted == wanted:
        return known
    items = [_item(name, one, order) for name, one in wanted.items()]
    ranges = _ranges(items)
    plan = _Plan(dict(wanted), tuple(wanted), [one.request() for one in ranges], [_Decoder(one) for one in ranges])
    if len(_plans) >= _MOST_PLANS:
        _plans.clear()
    _plans[key] = plan
    return plan


def _item(name: str, wanted: NamedRead, order: str) -> _Item:
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
    """Group the values to be read into ranges, each for one request; every value lies in exactly one range."""
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


class _Decoder:
    """Turns the reply to one request into the named values in it; all values of one type are decoded at once."""

    __slots__ = ("_bits", "_lists", "_register_bits", "_together")

    def __init__(self, one: _Range) -> None:
        size = one.end - one.offset
        bits = [item for item in one.items if item.form is None]
        self._bits = [(item.name, item.offset - one.offset, item.count) for item in bits], size
        self._lists: list[tuple[str, ValueType[Any], slice]] = []
        self._register_bits: list[tuple[str, int, int]] = []
        together: dict[ValueType[Any], list[_Item]] = {}
        for item in one.items:
            if item.form is None:
                continue
            if item.count is not None:
                self._lists.append((item.name, item.form, _bytes_of(item, one)))
            elif (place := item.form.bit_place) is not None:
                self._register_bits.append((item.name, _bytes_of(item, one).start + place[0], place[1]))
            else:
                together.setdefault(item.form, []).append(item)
        self._together = [
            (form, [item.name for item in items], _joined([_bytes_of(item, one) for item in items]))
            for form, items in together.items()
        ]

    def decode(self, reply: object, found: dict[str, Any]) -> None:
        """Decode the reply to the request, and put its values into the dict ``found``, by name.

        Raises `BadReply` if bytes are no value of their type.
        """
        if isinstance(reply, ReadBits.Reply):
            wanted, size = self._bits
            states = reply.bits(size)
            for name, at, count in wanted:
                found[name] = states[at] if count is None else states[at : at + count]
            return
        assert isinstance(reply, ReadRegisters.Reply)
        data = reply.data
        for form, names, parts in self._together:
            whole = data[parts[0]] if len(parts) == 1 else b"".join([data[part] for part in parts])
            found.update(zip(names, form.decode(whole), strict=True))
        for name, at, mask in self._register_bits:
            found[name] = data[at] & mask != 0
        for name, form, part in self._lists:
            found[name] = form.decode(data[part])


def _bytes_of(item: _Item, one: _Range) -> slice:
    begin = 2 * (item.offset - one.offset)
    return slice(begin, begin + 2 * item.items)


def _joined(parts: Iterable[slice]) -> list[slice]:
    """Return slices of a reply, with each joined to the slice before it if it begins where that one ends."""
    found: list[slice] = []
    for part in parts:
        if found and found[-1].stop == part.start:
            found[-1] = slice(found[-1].start, part.stop)
        else:
            found.append(part)
    return found


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the values of one `read_together` are read; cached for the next call with equal arguments.

    Attributes:
        wanted: the argument of that call.
        names: the names, in the order of the result.
        requests: the requests to send together.
        ranges: for each request, the decoder of its reply.
    """

    wanted: dict[str, NamedRead]
    names: tuple[str, ...]
    requests: Sequence[Request]
    ranges: Sequence[_Decoder]


_MOST_PLANS: Final = 64
_plans: dict[tuple[str, ...], _Plan] = {}
