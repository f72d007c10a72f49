"""What a request looks like on the upstream, and its answer to the client.

Knows requests and replies; knows no upstream. A shifted address is shifted back in the answer, a request that was
split is answered whole.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from ...errors import InvalidRequest
from ...pdu.bits import slice_bits
from ...pdu.general import OpaqueRequest
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...pdu.wide import NARROW, wide
from ...pdu.write_items import WriteMultipleCoils, WriteMultipleRegisters
from .routes import Route


def upstream_requests(request: Request, route: Route, width: int = NARROW) -> tuple[Request, ...]:
    """The requests to send for one that a route takes: itself, as a rule.

    Args:
        request: as the client asks it.
        route: what becomes of it.
        width: bytes of the registers of the device, 2…12; it answers reads in its own width, which goes through.

    Raises:
        InvalidRequest: an address that does not exist behind the shift.
    """
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


def client_reply(request: Request, route: Route, sent: Sequence[Request], replies: Sequence[Message]) -> Message:
    """The answer to ``request`` from the answers to what was ``sent`` for it."""
    if len(replies) > 1:
        return _joined(request, sent, replies)
    reply = replies[0]
    if reply is sent[0]:  # nobody answers on unit 0 of a serial line: the request stands for its answer
        return echo(request)
    return _moved(reply, type(request), -route.shift) if route.shift else reply


def echo(request: Request) -> Message:
    """What a device would have answered to a write."""
    if request.echoes or isinstance(request, OpaqueRequest):
        return request
    fields = request.values()
    return request.Reply(**{name: fields[name] for name in request.Reply.declared if name in fields})


def _limit(request: Request, route: Route) -> int | None:
    """What fits in one request of this kind, or None."""
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
    """A poller asks the same for ever: its pieces are made, and encoded, once."""
    return tuple(kind(address + at, min(limit, count - at)) for at in range(0, count, limit))


def _joined(request: Request, sent: Sequence[Request], replies: Sequence[Any]) -> Message:
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
    return request.Reply(request.address, request.count)


def _moved(message: Message, kind: type[Request], shift: int) -> Message:
    """The message with every address that its function names moved by ``shift``."""
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
