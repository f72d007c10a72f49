"""Writes on the compiled path with value limits or an audit line.

Knows the zones of a policy, the blocks of a device and the lines of the log; knows no rule beyond its zone, no session.

1. The function compiles its answer with a block that checks what is written (`Block.put`). So the request itself is
   validated where it always is, before the check.
2. A write within one zone and its limits is executed; the old values are read in the same step, and the audit line is
   appended afterwards. Every other write changes nothing and takes the generic path: denied writes, writes across
   several zones, and all writes while the log cannot take lines.
3. The audit line equals that of the generic path, to the byte (a property test compares them).

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
"""Functions that write one range and do nothing else: their writes can be checked and recorded on this path."""


@dataclass(frozen=True, slots=True)
class WriteLines:
    """The audit log, with the parts of a line that are equal for all writes of one client to one unit.

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
    """The writes that may take the compiled path although each is recorded in the audit log.

    Attributes:
        model: the device.
        zones: by function code, the function and where it may write.
    """

    model: DirectModel
    zones: Mapping[int, tuple[type[Request], tuple[Zone, ...]]]


def with_lines(answers: Mapping[int, Answer], writes: NotedWrites, lines: WriteLines) -> dict[int, Answer]:
    """The compiled answers of one client: those it shares with others, and its writes with audit lines.

    A write is compiled when it is first requested, because most clients do not write.
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
    """The compiled answer of one write function, limited to the zones of a policy.

    Args:
        kind: the function, one of `LOOKED_AT`.
        model: the device.
        zones: what may be written (`zones_of`).
        lines: where each write is recorded; None for nowhere.

    Returns:
        The answer; None where there is nothing to permit, or no compiled path.
    """
    return kind.direct(_LookingModel(model, kind, zones, lines)) if zones else None


class _LookingModel:
    """A device whose blocks check and record what is written to them."""

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
    """A block with a checking ``put``: a closure, since a method would look everything up again at each write."""

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
    """A function that finds the zone of a write; None if it is in no zone, in several, or outside the limits.

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
