"""Translates a client's request for its upstream (unit, addresses, size), and the reply back for the client.

Knows requests, replies and routes; knows no upstream. A shifted address is shifted back in the reply, and a request
that was split gets one reply.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from ...codes import Table
from ...errors import InvalidRequest
from ...pdu.bits import slice_bits
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...pdu.unknown_functions import OpaqueRequest
from ...pdu.wide_registers import NARROW, wide
from ...pdu.write_items import WriteMultipleCoils, WriteMultipleRegisters
from .routes import Route

_READS = (ReadRegisters, ReadBits)  # a union would be made anew at every look: 0.15 µs


class Translated:
    """A client's request as its upstream gets it, and the translation of the reply back for the client.

    Args:
        request: the client's request.
        route: the route of the request.
        width: number of bytes in a register of the device, 2…12; clients get registers of this width, too.

    Attributes:
        requests: the requests that are sent upstream for the client's request: one, or several if it is split.
        key: bytes that are equal for identical reads; empty for other requests.
        place: the range that is read (table, first address upstream, count) if its values are to be remembered;
            otherwise None.

    Raises:
        InvalidRequest: the shifted address does not exist.
    """

    __slots__ = ("_request", "_route", "key", "place", "requests")

    def __init__(self, request: Request, route: Route, width: int = NARROW) -> None:
        self._request = request
        self._route = route
        self.requests: tuple[Request, ...] = _upstream_requests(request, route, width)
        self.key: bytes = b""
        self.place: tuple[Table, int, int] | None = None
        if isinstance(request, _READS):
            self.key = b"".join(map(_wire, self.requests))
            if route.cache is not None and request.reads is not None:
                self.place = request.reads.table, request.address + route.shift, request.count

    def of_data(self, data: bytes) -> Message:
        """Return the client's reply to a read from ``data``: the registers or bits that the upstream sent."""
        kind: Any = type(self.requests[0])  # as wide as the device's registers are
        reply: Message = kind.Reply(data)
        return reply

    def whole(self, replies: Sequence[Message]) -> Message:
        """Return one reply made of the upstream's replies to `requests`; a single reply is returned as it is.

        Addresses in the reply are still those of the upstream; `client_reply` shifts them back.
        """
        return replies[0] if len(replies) == 1 else _joined(self._request, self._route, self.requests, replies)

    def client_reply(self, reply: Message) -> Message:
        """Return the client's reply, translated from the upstream's reply: addresses are shifted back.

        A broadcast gets no reply from the upstream. Its request then stands for the reply, and the client gets the
        reply that a device would give to a write.
        """
        if reply is self.requests[0]:  # no unit answers on unit 0 of a serial line: the request stands for its reply
            return echo(self._request)
        shift = self._route.shift
        return _moved(reply, type(self._request), -shift) if shift else reply


def _upstream_requests(request: Request, route: Route, width: int) -> tuple[Request, ...]:
    if width != NARROW and isinstance(request, ReadRegisters):
        request = wide(type(request), width)(request.address, request.count)
    if route.shift:
        moved = _moved(request, type(request), route.shift)
        assert isinstance(moved, Request)
        request = moved
    if route.max_registers is None and route.max_bits is None:
        return (request,)
    limit = _limit(request, route)
    if limit is None or _count(request) <= limit:
        return (request,)
    if isinstance(request, ReadBits | ReadRegisters):
        return tuple(_read_pieces(type(request), request.address, request.count, limit))
    if isinstance(request, WriteMultipleRegisters):
        return tuple(
            WriteMultipleRegisters(
                request.address + at, min(limit, request.count - at), request.data[2 * at :][: 2 * limit]
            )
            for at in range(0, request.count, limit)
        )
    assert isinstance(request, WriteMultipleCoils)
    return tuple(
        WriteMultipleCoils(request.address + at, size, slice_bits(request.data, at, size))
        for at in range(0, request.count, limit)
        for size in (min(limit, request.count - at),)
    )


def echo(request: Request) -> Message:
    """Return the reply of a device that has executed this write: it repeats fields of the request, such as the address.

    For a request with an unknown function, the reply is the request itself.
    """
    if request.echoes or isinstance(request, OpaqueRequest):
        return request
    fields = request.values()
    return request.Reply(**{name: fields[name] for name in request.Reply.declared if name in fields})


def _limit(request: Request, route: Route) -> int | None:
    """Return the largest number of items in one request of this kind that a route allows; None without a limit."""
    if isinstance(request, ReadRegisters):
        return route.max_registers
    if isinstance(request, ReadBits):
        return route.max_bits
    if route.split_writes and isinstance(request, WriteMultipleRegisters):
        return route.max_registers
    if route.split_writes and isinstance(request, WriteMultipleCoils):
        return route.max_bits
    return None


def _count(request: Any) -> int:  # one of the four kinds that `_limit` knows
    count: int = request.count
    return count


@lru_cache(maxsize=1024)
def _read_pieces(kind: type[Any], address: int, count: int, limit: int) -> tuple[Request, ...]:
    """Return the parts into which a read is split; cached, because clients repeat their reads."""
    return tuple(kind(address + at, min(limit, count - at)) for at in range(0, count, limit))


def _wire(request: Request) -> bytes:
    """Return the PDU bytes of a request, encoded at the first use only."""
    return request.wire if hasattr(request, "wire") else request.prepare()


def _joined(request: Request, route: Route, sent: Sequence[Request], replies: Sequence[Any]) -> Message:
    if isinstance(request, ReadRegisters):
        kind: Any = type(sent[0])  # as wide as the device's registers are
        joined: Message = kind.Reply(b"".join(reply.data for reply in replies))
        return joined
    if isinstance(request, ReadBits):
        bits = at = 0
        for piece, reply in zip(sent, replies, strict=True):
            count = _count(piece)
            bits |= (int.from_bytes(reply.data, "little") & (1 << count) - 1) << at
            at += count
        return request.Reply(bits.to_bytes((at + 7) >> 3, "little"))
    assert isinstance(request, WriteMultipleRegisters | WriteMultipleCoils)
    return request.Reply(request.address + route.shift, request.count)


def _moved(message: Message, kind: type[Request], shift: int) -> Message:
    """Return a copy of a message with ``shift`` added to all its addresses; the message itself if it has none.

    Args:
        message: a request or its reply.
        kind: class of the request.
        shift: number to add, also below zero.

    Raises:
        InvalidRequest: an address would be outside 0…65535.
    """
    names = {touch.address for touch in (kind.reads, kind.writes) if touch is not None}
    values = message.values()
    moved = names & set(values)
    if not moved:
        return message
    for name in moved:
        values[name] += shift
        if not 0 <= values[name] <= 0xFFFF:
            raise InvalidRequest(f"address {values[name] - shift} shifted by {shift} does not exist")
    return type(message)(**values)
