"""The server's fast path under a policy: checks addresses and values and audits writes, without a full decision.

Knows address ranges with their rules (zones), declarations of functions and memory blocks of devices; knows no client,
no session.

1. A function that answers requests is used unchanged if they are permitted at all addresses. If they are permitted in
   some address ranges, a check of the address comes before it. For a write with value limits or with an audit line, the
   function gets a memory block that checks what is written (`Block.put`); so the request itself is validated as always,
   before that check.
2. Functions under a rate, and requests that are not one plain range, take the generic path.
3. A request that fails a check changes nothing and takes the generic path, where it is decided, counted and recorded:
   denied requests, writes across several zones, and all writes while the audit log cannot be written
   (``on_failure="refuse"``).
4. An audited write reads the old values in the same step. Its line equals that of the generic path, to the byte (a
   property test compares them).
"""

import struct
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, cast

from ..codes import Table
from ..pdu.fast_answers import Block, DirectModel, ExchangingBlock, FastAnswer, Requester
from ..pdu.fields import FixedField
from ..pdu.message import Request, Touch
from ..session.responder import ServedUnit
from .access_request import counts_as_write
from .audit_line import DONE, done_line, who_text
from .notation import NumberRange
from .rule_evaluation import Rights, UnitAccess, Zone, ranges_of
from .rules import EVERYWHERE

if TYPE_CHECKING:
    from .audit_log import AuditLog

_unpack_address = struct.Struct(">H").unpack_from
_unpack_two = struct.Struct(">HH").unpack_from


def bind(
    rights: Rights, unit: int, served: ServedUnit, kind: type[Request], audit: "AuditLog | None" = None
) -> FastAnswer | None:
    """Return a function that answers requests with one function code from their bytes, if the clients' rights permit.

    It returns the reply; None for a request that must take the generic path.

    Args:
        rights: the rights of the clients.
        unit: the unit asked, 0…255.
        served: the unit, with its device.
        kind: the request class of a function that the device offers.
        audit: the log where each write is recorded; None records none.

    Returns:
        The answering function; None if all requests must take the generic path, such as those that no rule permits.
    """
    device = served.device
    if device is None:
        return None

    def access(space: Table | None, writes: bool) -> UnitAccess:
        return UnitAccess(unit, served.units, kind.code, None, space, writes)

    if kind in DONE:
        assert kind.writes is not None
        zones = rights.permitted(access(kind.writes.table, True))
        if zones and audit is not None:
            return _audited(kind, device, zones, unit, audit)
        if any(zone.limits is not None for zone in zones):
            return kind.direct(_CheckedDevice(device, lambda block: _limited(block, zones)))
    elif audit is not None and counts_as_write(kind):
        return None
    answer = kind.direct(device)
    return None if answer is None else _within(kind, answer, rights, access)


def _within(
    kind: type[Request], answer: FastAnswer, rights: Rights, access: Callable[[Table | None, bool], UnitAccess]
) -> FastAnswer | None:
    """Return a function that checks whether the touched items are permitted, and then calls ``answer``.

    Returns ``answer`` itself if all addresses are permitted without value limits, and None if the bytes of a request
    are not enough to check it, or no address is permitted.

    Args:
        kind: the request class.
        answer: answers a request from its bytes.
        rights: the rights of the clients.
        access: returns the kind of request for which zones are looked up, for a table and whether it is written.
    """
    if kind.spans is not Request.spans:
        return None  # it says for itself what it touches: only a request can tell
    touches = [(touch, writes) for touch, writes in ((kind.writes, True), (kind.reads, False)) if touch is not None]
    accesses = [access(touch.table, writes) for touch, writes in touches]
    if not touches or (counts_as_write(kind) and kind.writes is None):
        accesses.append(access(None, counts_as_write(kind)))
    found = [ranges_of(_unlimited(rights.permitted(one))) for one in accesses]
    if all(ranges == EVERYWHERE for ranges in found):
        return answer
    if len(found) != 1 or not found[0] or not touches or not _is_plain(kind, touches[0][0]):
        return None
    if touches[0][0].count is None:
        return _within_single(answer, found[0])
    return _within_range(answer, found[0][0]) if len(found[0]) == 1 else _within_ranges(answer, found[0])


def _unlimited(zones: tuple[Zone, ...]) -> tuple[Zone, ...]:
    return tuple(zone for zone in zones if zone.limits is None)


def _is_plain(kind: type[Request], touch: Touch) -> bool:
    """Whether requests of a function begin with an address and, unless it touches one item, the number of items."""
    names = ("address",) if touch.count is None else ("address", "count")
    fields = kind.layout.fields[: len(names)]
    return (
        kind.sub_code is None
        and (touch.address, touch.count or "count") == ("address", "count")
        and tuple(kind.layout.names[: len(names)]) == names
        and all(isinstance(field, FixedField) and field.width == 2 for field in fields)
    )


def _within_range(answer: FastAnswer, permitted: NumberRange) -> FastAnswer:
    first, last = permitted

    def within(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        try:  # what is cut off reaches into the next frame, or beyond the buffer; the answer judges the length
            address, count = _unpack_two(buffer, at + 1)
        except struct.error:
            return None
        return answer(buffer, at, end, client) if first <= address <= last - count else None

    return within


def _within_ranges(answer: FastAnswer, permitted: Sequence[NumberRange]) -> FastAnswer:
    firsts, ends = zip(*permitted, strict=True)

    def within(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        try:
            address, count = _unpack_two(buffer, at + 1)
        except struct.error:
            return None
        index = bisect_right(firsts, address) - 1
        return answer(buffer, at, end, client) if index >= 0 and address <= ends[index] - count else None

    return within


def _within_single(answer: FastAnswer, permitted: Sequence[NumberRange]) -> FastAnswer:
    """Return a function that calls ``answer`` if the address of a request for one item is permitted, else returns None.

    ``permitted`` has the permitted address ranges, ascending; at least one.
    """
    firsts, ends = zip(*permitted, strict=True)

    def within(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        try:
            (address,) = _unpack_address(buffer, at + 1)
        except struct.error:
            return None
        index = bisect_right(firsts, address) - 1
        return answer(buffer, at, end, client) if index >= 0 and address < ends[index] else None

    return within


CheckedPut = Callable[[int, int, bytes], bool | None]


class _CheckedDevice:
    """A device whose memory blocks check each write by a policy. Used only to build functions of the fast path.

    Args:
        device: the device itself.
        checked: takes a memory block, and returns a ``put`` that checks each write to it; None if there cannot be one.
    """

    __slots__ = ("_checked", "_device")

    def __init__(self, device: DirectModel, checked: Callable[[Block], CheckedPut | None]) -> None:
        self._device = device
        self._checked = checked

    def plain_block(self, table: Table, *, writes: bool) -> Block | None:
        """Return the memory of a table with a check before each write; ``writes``: whether it is needed for writing.

        None if the device offers no direct access to the table, or its block cannot be checked.
        """
        block = self._device.plain_block(table, writes=writes)
        put = None if block is None else self._checked(block)
        return None if block is None or put is None else _CheckedBlock(block, put)


class _CheckedBlock:
    """A memory block of a device with a ``put`` that checks each write against the policy."""

    __slots__ = ("_block", "count", "first", "put")

    def __init__(self, block: Block, put: CheckedPut) -> None:
        self._block = block
        self.first = block.first
        self.count = block.count
        self.put = put

    @property
    def data(self) -> bytearray:
        """The bytes that hold the block's registers or bits."""
        return self._block.data


def _zone_finder(first: int, zones: Sequence[Zone]) -> Callable[[int, int, bytes], int | None]:
    """Return a function that finds the zone in which a write is permitted.

    It takes position, count and items of the write, and returns the index in ``zones``; None if the write is not within
    one zone, or a value is outside its limits.

    Args:
        first: the address of the block's first item; positions count from there.
        zones: the permitted address ranges, ascending, each with the rule that decides there.
    """
    firsts, ends = [zone.first for zone in zones], [zone.end for zone in zones]
    limits = [zone.limits for zone in zones]

    def zone_of(position: int, count: int, data: bytes) -> int | None:
        address = first + position
        index = bisect_right(firsts, address) - 1
        if index < 0 or address + count > ends[index]:
            return None
        limit = limits[index]
        return index if limit is None or limit.permit_all(data) else None

    return zone_of


def _limited(block: Block, zones: Sequence[Zone]) -> CheckedPut:
    """Return a ``put`` for a memory block that refuses writes outside the permitted addresses and value limits.

    For a refused write, ``put`` changes nothing and returns True: the request then takes the generic path.
    """
    zone_of, plain_put = _zone_finder(block.first, zones), block.put

    def put(position: int, count: int, data: bytes) -> bool | None:
        return True if zone_of(position, count, data) is None else plain_put(position, count, data)

    return put


_Done = tuple[int, int, int, bytes, bytes]
"""Facts of an executed write: index of its zone, address, count, old and new items in wire order."""
_NOTHING_DONE: Final[_Done] = (0, 0, 0, b"", b"")


def _audited(
    kind: type[Request], device: DirectModel, zones: Sequence[Zone], unit: int, audit: "AuditLog"
) -> FastAnswer | None:
    """Return a function of the fast path that checks addresses and values, writes, and appends an audit line.

    That function returns None for a write that is not permitted, or that the audit log does not take now: nothing is
    written, and the request takes the generic path. The result of `_audited` itself is None if the device's memory
    cannot be used directly.
    """
    done = _NOTHING_DONE

    def recorded(block: Block) -> CheckedPut | None:
        if not hasattr(block, "exchange"):  # not by isinstance, which would look at the items too
            return None
        exchange, begin = cast(ExchangingBlock, block).exchange, block.first
        zone_of = _zone_finder(begin, zones)

        def put(position: int, count: int, data: bytes) -> bool | None:
            nonlocal done
            index = zone_of(position, count, data)
            if index is None or not audit.takes_writes:
                return True
            done = index, begin + position, count, exchange(position, count, data), data
            return None

        return put

    answer = kind.direct(_CheckedDevice(device, recorded))
    if answer is None:
        return None
    lines = [done_line(unit, kind.code, zone.rule_name) for zone in zones]
    append, now, text_of = audit.append, audit.timestamp, DONE[kind]

    def audited(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        reply = answer(buffer, at, end, client)
        if reply is not None:
            index, address, count, old, new = done
            begin, rest = lines[index]
            who = client.audit_text or who_text(client)
            append(f'{{"time":"{now()}",{who}{begin}{text_of(address, count, old, new)}{rest}')
        return reply

    return audited
