"""What an upstream remembers of reads: those in flight, which others may share, and values that may still be answered.

Knows reads and writes by unit and range; knows no link, and the time only as ``now``.

Whoever has seen a write end must not be given what was there before it. So:

1. From the moment a write to a unit is asked until it has ended, nothing of the unit is shared or remembered, and what
   was before is forgotten. A broadcast does so for all units of the upstream.
   A write to 255 or 0 of a server on TCP is one to the device itself, whatever number others ask it by: it concerns all
   units too, and what is remembered of 255 and 0 is forgotten at every write.
   So is a write to one of the units that are known to be the same device: it concerns all of them.
2. A read that was sent before a write ended is not remembered either: its value may be the old one.
3. A value is as old as the moment its read was sent; it is answered until its time to live has passed since.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from ...codes import BROADCAST_UNIT, TCP_DEVICE_UNIT, Table
from ...pdu.bits import slice_bits
from ...pdu.wide import NARROW

Shared = TypeVar("Shared")
Key = bytes
"""The PDU of a read as it is sent; of one that is split, those of all its parts."""
Place = tuple[Table, int, int]
"""Table, address of the first item, count."""

EVERYBODY = (BROADCAST_UNIT, TCP_DEVICE_UNIT)
"""Units that may stand for any other."""
BLOCKS_PER_UNIT = 64
"""Values remembered of a unit; the one unused longest is forgotten."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Items that were read in one request, and when it was asked."""

    place: Place
    data: bytes
    read_at: float


@dataclass(slots=True)
class _Unit(Generic[Shared]):
    """What is remembered of one unit."""

    open_writes: int = 0
    changes: int = 0
    reading: dict[Key, Shared] = field(default_factory=dict)
    blocks: dict[Place, _Block] = field(default_factory=dict)  # what was used last comes last

    def forget(self) -> None:
        self.changes += 1
        self.reading.clear()
        self.blocks.clear()


class ReadCache(Generic[Shared]):
    """The memory of one upstream. ``Shared`` is whatever stands for a read in flight.

    Args:
        register_width: bytes of a register.
        same_device: units that are the same device, group by group.
    """

    __slots__ = ("_concerned", "_open_writes", "_units", "_width")

    def __init__(self, register_width: int = NARROW, same_device: Iterable[Collection[int]] = ()) -> None:
        self._width = register_width
        # What a write to a unit concerns, where that is more than itself and what may stand for any unit.
        self._concerned = {unit: (*sorted(group), *EVERYBODY) for group in same_device for unit in group}
        self._units: dict[int, _Unit[Shared]] = {}
        self._open_writes = 0

    def _unit(self, unit: int) -> _Unit[Shared]:
        found = self._units.get(unit)
        if found is None:
            found = self._units[unit] = _Unit()
        return found

    # Writes.

    def write_begins(self, unit: int) -> None:
        """A write to ``unit`` is about to be asked."""
        self._unit(unit).open_writes += 1
        self._open_writes += 1
        self._changed(unit)

    def write_ended(self, unit: int) -> None:
        """It has ended, however."""
        self._unit(unit).open_writes -= 1
        self._open_writes -= 1
        self._changed(unit)

    def _changed(self, unit: int) -> None:
        concerned = self._units if unit in EVERYBODY else self._concerned.get(unit, (unit, *EVERYBODY))
        for each in concerned:
            state = self._units.get(each)
            if state is not None:
                state.forget()

    def _is_quiet(self, unit: int) -> bool:
        """Whether no write is open that concerns a unit."""
        if not self._open_writes:
            return True
        if unit in EVERYBODY:
            return False
        states = (self._units.get(each) for each in self._concerned.get(unit, (unit, *EVERYBODY)))
        return not any(state is not None and state.open_writes for state in states)

    # Reads in flight.

    def shared(self, unit: int) -> dict[Key, Shared] | None:
        """All reads of a unit that may be shared, and where new ones are put in; None while they must not be.

        It is the same one for ever, and empty when something was written.
        """
        state = self._unit(unit)
        return state.reading if not self._open_writes or self._is_quiet(unit) else None

    def changes(self, unit: int) -> int:
        """A number that changes with every write that concerns a unit; `remember` wants what it was before the read."""
        return self._unit(unit).changes

    # Values.

    def remember(self, unit: int, place: Place, data: bytes, *, since: int, read_at: float) -> None:
        """Keep what a read has brought, unless something was written meanwhile.

        Args:
            unit: the unit on the upstream.
            place: what was read there.
            data: the items, as a reply carries them.
            since: what `changes` gave before it was asked.
            read_at: when it was asked.
        """
        state = self._unit(unit)
        if state.changes != since or not self._is_quiet(unit):
            return
        state.blocks.pop(place, None)
        state.blocks[place] = _Block(place, data, read_at)
        if len(state.blocks) > BLOCKS_PER_UNIT:
            del state.blocks[next(iter(state.blocks))]

    def recall(self, unit: int, place: Place, now: float, *, for_seconds: float) -> bytes | None:
        """The items of a range from what is remembered, also out of a larger block; None if nothing so young is."""
        state = self._units.get(unit)
        if state is None or not state.blocks:
            return None
        same = state.blocks.get(place)  # what pollers ask for, again and again
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
