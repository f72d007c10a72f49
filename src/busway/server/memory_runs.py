"""Memory of a device's tables: runs of registers or bits at consecutive addresses, in wire order.

Knows bytes, positions and the lock that writers share; knows no table, no address rule, no hook and no request.

1. The attribute ``data`` of a run is read without a lock, in one slice. A writer holds the lock and changes ``data`` in
   one call of C code that keeps its length (a slice assignment, ``pack_into``), or replaces it by another object, so a
   reader never sees half of a change.
2. A position counts from the run's first item. The caller has checked that the items exist.
3. Several runs change at once by `replace_all` and in no other way.
"""

import struct
import threading
from collections import deque
from collections.abc import Mapping
from itertools import repeat
from typing import Final, Protocol

from ..pdu.bits import slice_bits, splice_bits

_PACKED: Final = 125
"""Most registers that are written by ``pack_into``: as many as a request can have. An assignment to a slice would first
make a `bytearray` of the new bytes: 0.55 µs instead of 0.38 (CPython 3.11).
"""
_COPIES: Final = tuple(struct.Struct(f"{2 * count}s") for count in range(_PACKED + 1))
_PACK: Final = tuple(copy.pack_into for copy in _COPIES)
_UNPACK: Final = tuple(copy.unpack_from for copy in _COPIES)
_REGISTER: Final = struct.Struct(">H")
_pack_register, _unpack_register = _REGISTER.pack_into, _REGISTER.unpack_from


class Run(Protocol):
    """Interface of registers or bits at consecutive addresses, in memory that Modbus and the application share."""

    @property
    def first(self) -> int:
        """Address of the first register or bit."""

    @property
    def count(self) -> int:
        """Number of registers or bits."""

    @property
    def memory(self) -> "RegisterRun | BitRun":
        """The run that stores the bytes: this run itself.

        For registers shown as bits (`RegisterBits`), the run of those registers.
        """

    def fetch(self, data: bytearray, position: int, count: int) -> bytes:
        """Return ``count`` items from ``position`` on, in wire order, out of ``data`` instead of the memory.

        ``data``: the bytes of ``memory``, or a copy of them that may have been changed.
        """

    def patch(self, data: bytearray, position: int, count: int, items: bytes) -> None:
        """Write ``items`` (``count`` of them, in wire order) from ``position`` on into ``data``.

        ``data``: the bytes of ``memory``, or a copy of them. It is changed in one assignment, so no reader sees half of
        the items.
        """

    def get(self, position: int, count: int) -> bytes:
        """Return ``count`` current items from ``position`` on, as bytes in the wire order of a reply.

        ``position`` counts from the first item of the run.
        """

    def put(self, position: int, count: int, data: bytes) -> None:
        """Replace ``count`` items from ``position`` on by ``data``, which is in wire order. Safe from any thread.

        ``position`` counts from the first item of the run.
        """


class RegisterRun:
    """Registers of a device at consecutive addresses, stored big-endian.

    Args:
        first: address of the first register.
        data: two bytes for each register.
        lock: taken for every change.
    """

    __slots__ = ("_lock", "count", "data", "first")

    def __init__(self, first: int, data: bytearray, lock: threading.RLock) -> None:
        self.first: int = first
        self.count: int = len(data) // 2
        self.data: bytearray = data
        self._lock = lock

    @property
    def memory(self) -> "RegisterRun":
        """The run that stores the bytes of these registers: always this run itself."""
        return self

    def fetch(self, data: bytearray, position: int, count: int) -> bytes:
        """Return ``count`` registers from ``position`` on out of ``data``: this run's bytes, or a changed copy."""
        return bytes(data[2 * position : 2 * (position + count)])

    def patch(self, data: bytearray, position: int, count: int, items: bytes) -> None:
        """Write ``count`` registers from ``position`` on into ``data``: this run's bytes, or a copy of them."""
        data[2 * position : 2 * (position + count)] = items

    def get(self, position: int, count: int) -> bytes:
        """Return ``count`` current registers from ``position`` on, as big-endian bytes."""
        return bytes(self.data[2 * position : 2 * (position + count)])

    def put(self, position: int, count: int, data: bytes) -> None:
        """Replace ``count`` registers from ``position`` on by big-endian bytes; safe from any thread."""
        if count <= _PACKED:
            with self._lock:
                _PACK[count](self.data, 2 * position, data)
        else:
            with self._lock:
                self.data[2 * position : 2 * (position + count)] = data

    def exchange(self, position: int, count: int, data: bytes) -> bytes:
        """Replace ``count`` registers (at most 125) from ``position`` on, and return the old ones as big-endian bytes.

        No other thread can change them in between.
        """
        start = 2 * position
        with self._lock:
            items = self.data
            old: bytes
            (old,) = _UNPACK[count](items, start)
            _PACK[count](items, start, data)
        return old

    def mask(self, position: int, and_mask: int, or_mask: int) -> None:
        """Set a register to (current AND and_mask) OR (or_mask AND NOT and_mask), in one step for all threads."""
        with self._lock:
            items = self.data
            (current,) = _unpack_register(items, 2 * position)
            _pack_register(items, 2 * position, current & and_mask | or_mask & ~and_mask)

    def put_then_get(self, position: int, count: int, data: bytes, start: int, size: int) -> bytes:
        """Replace ``count`` registers from ``position`` on, then return ``size`` registers from ``start`` on.

        No other thread can change them in between. ``position`` and ``start`` count from the first register of this
        run; ``count`` and ``size`` are at most 125.
        """
        with self._lock:
            items = self.data
            _PACK[count](items, 2 * position, data)
            read: bytes
            (read,) = _UNPACK[size](items, 2 * start)
        return read


class BitRun:
    """Coils or discrete inputs at consecutive addresses, packed: the first bit is the lowest bit of the first byte.

    Args:
        first: address of the first bit.
        count: number of bits.
        data: the packed bits.
        lock: taken for every change.
    """

    __slots__ = ("_lock", "count", "data", "first")

    def __init__(self, first: int, count: int, data: bytearray, lock: threading.RLock) -> None:
        self.first: int = first
        self.count: int = count
        self.data: bytearray = data
        self._lock = lock

    @property
    def memory(self) -> "BitRun":
        """The run that stores the bytes of these bits: always this run itself."""
        return self

    def fetch(self, data: bytearray, position: int, count: int) -> bytes:
        """Return ``count`` packed bits from ``position`` on out of ``data``: this run's bytes, or a changed copy."""
        return slice_bits(data, position, count)

    def patch(self, data: bytearray, position: int, count: int, items: bytes) -> None:
        """Write ``count`` packed bits from ``position`` on into ``data``: this run's bytes, or a copy of them."""
        splice_bits(data, position, count, items)

    def get(self, position: int, count: int) -> bytes:
        """Return ``count`` current bits from ``position`` on, packed from the lowest bit of the first byte."""
        return slice_bits(self.data, position, count)

    def put(self, position: int, count: int, data: bytes) -> None:
        """Replace ``count`` bits from ``position`` on by packed bytes; safe from any thread."""
        if count == 1:
            place, bit = position >> 3, 1 << (position & 7)
            with self._lock:
                items = self.data
                items[place] = items[place] | bit if data[0] & 1 else items[place] & ~bit
        else:
            with self._lock:
                splice_bits(self.data, position, count, data)

    def exchange(self, position: int, count: int, data: bytes) -> bytes:
        """Replace ``count`` bits from ``position`` on by the packed bits ``data``, and return the old ones packed.

        No other thread can change them in between.
        """
        with self._lock:
            old = slice_bits(self.data, position, count)
            splice_bits(self.data, position, count, data)
        return old


class RegisterBits:
    """A bit table that is a view of registers: bit ``n`` is bit ``n % 16`` of register ``start + n // 16``.

    Bit 0 of a register is its least significant (Application Protocol V1.1b3 §4.3, figure 7: one block of memory).

    Args:
        memory: the registers.
        start: the register, counted from the first of ``memory``, that contains bits 0…15.
        count: number of bits.
        lock: the lock of ``memory``, taken for every change.
    """

    __slots__ = ("_lock", "_start", "count", "first", "memory")

    def __init__(self, memory: RegisterRun, start: int, count: int, lock: threading.RLock) -> None:
        self.first: int = 0
        self.count: int = count
        self.memory: RegisterRun = memory
        self._start = start
        self._lock = lock

    def fetch(self, data: bytearray, position: int, count: int) -> bytes:
        """Return ``count`` packed bits from ``position`` on out of ``data``: the registers' bytes or a changed copy."""
        low, high = self._bytes_of(position, count)
        return slice_bits(_bytes_swapped(data[low:high]), position & 15, count)

    def patch(self, data: bytearray, position: int, count: int, items: bytes) -> None:
        """Write ``count`` packed bits from ``position`` on into ``data``: the registers' bytes, or a copy of them."""
        low, high = self._bytes_of(position, count)
        words = _bytes_swapped(data[low:high])
        splice_bits(words, position & 15, count, items)
        data[low:high] = _bytes_swapped(words)

    def get(self, position: int, count: int) -> bytes:
        """Return ``count`` bits from bit ``position`` on, packed: the first is the lowest bit of the first byte."""
        return self.fetch(self.memory.data, position, count)

    def put(self, position: int, count: int, data: bytes) -> None:
        """Replace ``count`` bits from bit ``position`` on in the registers; safe from any thread."""
        with self._lock:
            self.patch(self.memory.data, position, count, data)

    def _bytes_of(self, position: int, count: int) -> tuple[int, int]:
        """Return where in memory the whole registers lie that contain a range of bits: first byte, byte after the last.

        Always even: callers swap the two bytes of each register. ``position`` counts from the first bit of this view.
        """
        return 2 * (self._start + position // 16), 2 * (self._start + (position + count + 15) // 16)


def replace_all(fresh: Mapping[RegisterRun | BitRun, bytearray]) -> None:
    """Replace the bytes of several runs at once; the caller holds the lock.

    ``fresh`` has the new bytes by run. No other thread sees some runs replaced and others not: readers hold no lock, so
    all are replaced inside one call of C code (``deque`` exhausts ``map``), during which no other thread runs Python.
    """
    deque(map(setattr, fresh.keys(), repeat("data"), fresh.values()), maxlen=0)


def _bytes_swapped(words: bytearray) -> bytearray:
    """Swap the two bytes of each register: turns big-endian registers into packed bits, and back."""
    swapped = bytearray(len(words))
    swapped[0::2] = words[1::2]
    swapped[1::2] = words[0::2]
    return swapped
