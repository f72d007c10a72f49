"""Writes on the compiled path that are looked at: held against limits, and left in the audit log.

Knows the zones of a policy, the blocks of a device and the lines of the log; knows no rule beyond its zone, no session.

1. An answer is compiled by the function itself, with a block that looks (`Block.put`). So what is right on the wire is
   judged where it always is, before anything is looked at.
2. What lies within one zone, within its limits, is written; what stood there is taken in the same step, and the line is
   left when the write is done. All else is declined untouched and takes the generic path: what is denied, what reaches
   over several zones, every write while the log takes none.
3. The line is that of the generic path, to the byte (a property test holds them together).

Measured, with CPython 3.11, from frame to frame: FC06 with a line 4.6 µs, where the generic path takes 47; within
limits and without a line 3.1 for 27; with neither 2.2.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

from ..codes import Table
from ..pdu.direct import Answer, Block, DirectModel, ExchangingBlock
from ..pdu.message import Request
from .audit import AuditLog
from .entries import DONE, WallClock, done_line
from .rules import Zone

LOOKED_AT: Final = frozenset(DONE)
"""The functions whose writes can be looked at on the compiled path: they write one range, and do nothing else."""


@dataclass(frozen=True, slots=True)
class WriteLines:
    """Where the lines of one client's writes to one unit go, and what they say of it.

    Attributes:
        log: the audit log.
        clock: gives the time of a line.
        who: the client, as `who_text` gives it.
        unit: the unit it asks.
    """

    log: AuditLog
    clock: WallClock
    who: str
    unit: int


@dataclass(frozen=True, slots=True)
class NotedWrites:
    """The writes that may take the compiled path where each has to leave a line.

    Attributes:
        model: the device.
        zones: by function code, the function and where it may write.
    """

    model: DirectModel
    zones: Mapping[int, tuple[type[Request], tuple[Zone, ...]]]


def with_lines(answers: Mapping[int, Answer], writes: NotedWrites, lines: WriteLines) -> dict[int, Answer]:
    """The answers that one client is offered: those it shares with others, and its writes, which leave lines.

    A write is compiled when it is first asked, and takes its place then: most clients do not write.
    """
    offered = dict(answers)
    for code in writes.zones:
        offered[code] = _compiled_later(offered, code, writes, lines)
    return offered


def _compiled_later(offered: dict[int, Answer], code: int, writes: NotedWrites, lines: WriteLines) -> Answer:
    def first(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
        if offered[code] is first:
            kind, zones = writes.zones[code]
            offered[code] = looking_answer(kind, writes.model, zones, lines) or _decline
        return offered[code](buffer, at, end)

    return first


def _decline(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
    return None


def looking_answer(
    kind: type[Request], model: DirectModel, zones: Sequence[Zone], lines: WriteLines | None = None
) -> Answer | None:
    """The answer to one kind of write, of those `LOOKED_AT`, within the zones of a policy.

    Args:
        kind: the function.
        model: the device.
        zones: what may be written (`zones_of`).
        lines: where each write leaves its line; None: nowhere.

    Returns:
        The answer; None where there is nothing to permit, or no compiled path.
    """
    return kind.direct(_LookingModel(model, kind, zones, lines)) if zones else None


class _LookingModel:
    """A device whose blocks look at what is written to them."""

    __slots__ = ("_kind", "_lines", "_model", "_zones")

    def __init__(
        self, model: DirectModel, kind: type[Request], zones: Sequence[Zone], lines: WriteLines | None
    ) -> None:
        self._model = model
        self._kind = kind
        self._zones = zones
        self._lines = lines

    def plain_block(self, table: Table, *, writes: bool) -> Block | None:
        """As `busway.pdu.direct.DirectModel.plain_block`."""
        block = self._model.plain_block(table, writes=writes)
        if block is None:
            return None
        if self._lines is None:
            return _LookingBlock(block, _limited(block, self._zones))
        if not hasattr(block, "exchange"):  # not by isinstance, which would look at the items too
            return None
        return _LookingBlock(block, _noted(cast(ExchangingBlock, block), self._kind, self._zones, self._lines))


class _LookingBlock:
    """A block with another ``put``: a closure, since a method would look everything up again at each write."""

    __slots__ = ("_block", "count", "first", "put")

    def __init__(self, block: Block, put: Callable[[int, int, bytes], bool | None]) -> None:
        self._block = block
        self.first = block.first
        self.count = block.count
        self.put = put

    @property
    def data(self) -> bytearray:
        """The items."""
        return self._block.data


def _judge(first: int, zones: Sequence[Zone]) -> Callable[[int, int, bytes], int | None]:
    """What says in which of the zones a write lies; None where in none, over an edge, or beyond the limits.

    Args:
        first: the address of the block's first item; positions count from there.
        zones: what may be written, by address.
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


def _limited(block: Block, zones: Sequence[Zone]) -> Callable[[int, int, bytes], bool | None]:
    """Writes within zones and limits."""
    zone_of, plain_put = _judge(block.first, zones), block.put

    def put(position: int, count: int, data: bytes) -> bool | None:
        return True if zone_of(position, count, data) is None else plain_put(position, count, data)

    return put


def _noted(
    block: ExchangingBlock, kind: type[Request], zones: Sequence[Zone], lines: WriteLines
) -> Callable[[int, int, bytes], bool | None]:
    """Writes within zones and limits, each with its line."""
    begin, exchange, zone_of = block.first, block.exchange, _judge(block.first, zones)
    texts = [done_line(lines.who, lines.unit, kind.code, zone.rule) for zone in zones]
    log, append, now, said = lines.log, lines.log.append, lines.clock, DONE[kind]

    def put(position: int, count: int, data: bytes) -> bool | None:
        index = zone_of(position, count, data)
        if index is None or not log.takes_writes:
            return True
        old = exchange(position, count, data)
        what, rest = texts[index]
        append(f'{{"time":"{now()}{what}{said(begin + position, count, old, data)}{rest}')
        return None

    return put
