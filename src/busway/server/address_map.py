"""Which addresses of a table or file exist, the memory run of each, and which ranges Modbus cannot write.

Knows runs and addresses, and refuses requests for others (exception 02); knows no hook and no group of changes.

1. Adjacent runs are one run, so a range exists only where one run holds all of it.
2. Runs and read-only ranges never change once the table exists; only the items in the runs change.
"""

import threading
from bisect import bisect_right
from typing import Final

from ..codes import ExceptionCode, Table
from ..pdu.bits import pack_bits
from ..pdu.device_interface import Refusal
from ..pdu.write_items import pack_registers
from .memory_runs import BitRun, RegisterRun, Run
from .table_declaration import CellLayout


class AddressMap:
    """The addresses of one table of a device (registers or bits), or of one file (records), with their memory.

    Args:
        runs: in ascending order, no two adjacent.
        read_only: ranges (first address, address after the last) that Modbus cannot write, ascending.

    Attributes:
        runs, read_only: as given.
        count: number of items in all runs.
    """

    __slots__ = ("_firsts", "count", "read_only", "runs")

    def __init__(self, runs: tuple[Run, ...] = (), read_only: tuple[tuple[int, int], ...] = ()) -> None:
        self.runs: tuple[Run, ...] = runs
        self.read_only: tuple[tuple[int, int], ...] = read_only
        self.count: int = sum(run.count for run in runs)
        self._firsts = [run.first for run in runs]

    def find(self, address: int, count: int) -> Run | None:
        """Return the run that holds all ``count`` items (1 or more) from ``address`` on, for reading and writing.

        None if no run holds all of them.
        """
        index = bisect_right(self._firsts, address) - 1
        if index < 0:
            return None
        run = self.runs[index]
        return run if 0 < count <= run.first + run.count - address else None

    def accessed(self, table: Table, address: int, count: int, *, writes: bool) -> Run:
        """Return the run that holds a range, for a request to read it or, if it ``writes``, to write it.

        ``table`` is named in the message of a refusal.

        Raises:
            Refusal: 02 if an item does not exist, or is read-only and ``writes`` is True.
        """
        index = bisect_right(self._firsts, address) - 1  # as in `find`, because a call for each request takes time
        run = self.runs[index] if index >= 0 else None
        if run is None or not 0 < count <= run.first + run.count - address:
            raise Refusal(
                ExceptionCode.ILLEGAL_DATA_ADDRESS, f"{table.label}s {address}…{address + count - 1} do not all exist"
            )
        if writes and self.read_only and self.is_read_only(address, count):
            raise Refusal(
                ExceptionCode.ILLEGAL_DATA_ADDRESS, f"{table.label}s {address}…{address + count - 1} are read-only"
            )
        return run

    def is_read_only(self, address: int, count: int) -> bool:
        """Whether at least one item of a range is read-only for Modbus."""
        return any(first < address + count and address < end for first, end in self.read_only)


_NO_ADDRESSES: Final = AddressMap()
"""The map of every table without items."""


def map_of_registers(layout: CellLayout, lock: threading.RLock) -> AddressMap:
    """Create the address map of registers, with the declared initial values in their memory."""
    runs = tuple(RegisterRun(piece.first, bytearray(pack_registers(piece.values)), lock) for piece in layout.pieces)
    return AddressMap(runs, layout.read_only) if runs else _NO_ADDRESSES


def map_of_bits(layout: CellLayout, lock: threading.RLock) -> AddressMap:
    """Create the address map of bits, with the declared initial values in their memory."""
    runs = tuple(
        BitRun(piece.first, len(piece.values), bytearray(pack_bits([bool(value) for value in piece.values])), lock)
        for piece in layout.pieces
    )
    return AddressMap(runs, layout.read_only) if runs else _NO_ADDRESSES
