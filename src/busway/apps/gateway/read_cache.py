"""The values read recently, and the reads in flight, that can answer a read of a gateway without a new request.

`forwarding` asks here before it sends a read; `shared_reads` lets a client wait for a read in flight.

Knows reads and writes by unit and range; knows no link, and the time only as ``now``.

A client that has seen a write end must not get a value from before it. So:

1. From the moment a write to a unit is forwarded until it has ended, no read of the unit is shared or remembered, and
   earlier values are dropped. A write to unit 0 or 255 concerns all units of the upstream: 0 is a broadcast, and on TCP
   both numbers mean the server itself, which may be the device behind any unit. So every write concerns units 0 and 255
   as well. A write to one of several units that are the same device concerns all of them.
2. A read that was sent before a write ended is not remembered either: its value may be the old one.
3. A value is as old as its request; it is used until its time to live has passed.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from ...codes import BROADCAST_UNIT, TCP_DEVICE_UNIT, Table
from ...pdu.bits import slice_bits
from ...pdu.wide_registers import NARROW

Shared = TypeVar("Shared")
Key = bytes
"""The PDU of a read as it is sent upstream; for a read that is split, the PDUs of all its parts joined."""
ReadRange = tuple[Table, int, int]
"""A range of items: table, address of the first item, number of items."""

ANY_DEVICE = (BROADCAST_UNIT, TCP_DEVICE_UNIT)
"""Units that may be the same device as any other."""
BLOCKS_PER_UNIT = 64
"""Most results of reads that are remembered for a unit; the result unused for the longest time is dropped."""


@dataclass(frozen=True, slots=True)
class _Block:
    """The values that one read returned, and the time when that read was forwarded, in monotonic seconds."""

    place: ReadRange
    data: bytes
    read_at: float


@dataclass(slots=True)
class _Unit(Generic[Shared]):
    """The reads in flight, the recently read values and the writes in progress of one unit identifier.

    ``changes`` counts how often a write has emptied ``reading`` (reads by key) and ``blocks`` (remembered values).
    """

    open_writes: int = 0
    changes: int = 0
    reading: dict[Key, Shared] = field(default_factory=dict)
    blocks: dict[ReadRange, _Block] = field(default_factory=dict)  # used last comes last

    def forget(self) -> None:
        self.changes += 1
        self.reading.clear()
        self.blocks.clear()


class ReadCache(Generic[Shared]):
    """The shared reads and recently read values of one upstream. ``Shared`` is the type of a read in flight.

    A client that has seen a write end never gets a value from before the write.

    Args:
        register_width: number of bytes in a register of the upstream's devices.
        same_device: groups of units that are the same device: a write to one unit concerns all units of its group.
    """

    __slots__ = ("_concerned", "_open_writes", "_units", "_width")

    def __init__(self, register_width: int = NARROW, same_device: Iterable[Collection[int]] = ()) -> None:
        self._width = register_width
        # The units that a write concerns, if the unit has others on the same device.
        self._concerned = {unit: (*sorted(group), *ANY_DEVICE) for group in same_device for unit in group}
        self._units: dict[int, _Unit[Shared]] = {}
        self._open_writes = 0

    def _unit(self, unit: int) -> _Unit[Shared]:
        found = self._units.get(unit)
        if found is None:
            found = self._units[unit] = _Unit()
        return found

    # Writes.

    def write_begins(self, unit: int) -> None:
        """Drop remembered values and stop the sharing of reads, because a write to a unit is about to be forwarded.

        This concerns also the other units that may be the same device; a write to unit 0 or 255 concerns all units.
        Each call must be followed by a call of `write_ended`.
        """
        self._changed(unit, 1)

    def write_ended(self, unit: int) -> None:
        """Record the end of a write to a unit, successful or not, and drop values that were read during the write.

        Once no write that concerns a unit is in progress, its reads are shared and remembered again.
        """
        self._changed(unit, -1)

    def _changed(self, unit: int, more_writes: int) -> None:
        self._open_writes += more_writes
        self._unit(unit).open_writes += more_writes
        concerned = self._units if unit in ANY_DEVICE else self._concerned.get(unit, (unit, *ANY_DEVICE))
        for state in filter(None, map(self._units.get, concerned)):
            state.forget()

    def _is_quiet(self, unit: int) -> bool:
        """Whether no write is in progress that concerns a unit; a write to unit 0 or 255 concerns all units."""
        if not self._open_writes:
            return True
        if unit in ANY_DEVICE:
            return False
        states = (self._units.get(each) for each in self._concerned.get(unit, (unit, *ANY_DEVICE)))
        return not any(state is not None and state.open_writes for state in states)

    # Reads in flight.

    def shared(self, unit: int) -> dict[Key, Shared] | None:
        """Return a unit's reads in flight by key; None while a write that concerns it is in progress: share none then.

        The caller adds its reads to the dictionary, and removes them when they end. Each call returns the same
        dictionary for a unit; a write empties it.
        """
        state = self._unit(unit)
        return state.reading if not self._open_writes or self._is_quiet(unit) else None

    def changes(self, unit: int) -> int:
        """Return a number that changes when a write that concerns a unit begins, and again when it ends.

        Read it before a read is forwarded, and pass it to `remember` with the read's data.
        """
        return self._unit(unit).changes

    # Values.

    def remember(self, unit: int, place: ReadRange, data: bytes, *, since: int, read_at: float) -> None:
        """Keep the data of a read, unless a write that concerns the unit was in progress since the read was forwarded.

        Args:
            unit: unit identifier on the upstream.
            place: the range that was read.
            data: the registers or packed bits, as in a reply.
            since: result of `changes` when the read was forwarded.
            read_at: when the read was forwarded, in seconds, by the clock of ``now`` in `recall`.
        """
        state = self._unit(unit)
        if state.changes != since or not self._is_quiet(unit):
            return
        state.blocks.pop(place, None)
        state.blocks[place] = _Block(place, data, read_at)
        if len(state.blocks) > BLOCKS_PER_UNIT:
            del state.blocks[next(iter(state.blocks))]

    def recall(self, unit: int, place: ReadRange, now: float, *, for_seconds: float) -> bytes | None:
        """Return remembered values of a range, as in a reply; None if there are none that are young enough.

        Args:
            unit: unit identifier on the upstream.
            place: the range, which may be a part of a larger read.
            now: the time in seconds, by the clock of ``read_at`` in `remember`.
            for_seconds: age in seconds from which values are too old.
        """
        state = self._units.get(unit)
        if state is None or not state.blocks:
            return None
        same = state.blocks.get(place)  # pollers repeat their reads
        if same is not None and now < same.read_at + for_seconds:
            state.blocks[place] = state.blocks.pop(place)
            return same.data
        table, first, count = place
        for block in reversed(state.blocks.values()):
            known_table, known_first, known_count = block.place
            at = first - known_first
            if at >= 0 and at + count <= known_count and known_table is table and now < block.read_at + for_seconds:
                state.blocks[block.place] = state.blocks.pop(block.place)
                if table.holds_bits:
                    return slice_bits(block.data, at, count)
                return block.data[self._width * at : self._width * (at + count)]
        return None
