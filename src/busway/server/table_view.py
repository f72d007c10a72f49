"""The application's view of a table or file: items by address, usable from any thread.

Knows a table's addresses and memory (`AddressMap`) and groups of changes (`Device.update`); knows no hook and no
request: the application's own accesses call no hook.
"""

from collections.abc import Iterator, Sequence
from typing import overload

from ..errors import InvalidRequest
from ..values.unfit_values import shown
from .address_map import AddressMap
from .change_groups import Groups
from .item_conversion import packed, unpacked
from .memory_runs import Run


class TableView:
    """The items of a table by address, 0-based as on the wire: ``view[5]``, ``view[5:9]``, read or assigned.

    Registers are ``int`` 0…65535, bits ``bool``. A slice reads and writes its items in one step: no other thread and no
    Modbus client sees half of it. A slice without a start begins at the first item of the table, one without an end
    includes the last; all of its addresses must exist. Read-only ranges are read-only for Modbus, not here.

    Raises:
        IndexError: an item does not exist, or the slice has a step.
        InvalidRequest: a value does not fit, or a slice is given another number of values than it has items.
    """

    __slots__ = ("_address_map", "_bits", "_groups", "_name")

    def __init__(self, name: str, address_map: AddressMap, groups: Groups, *, bits: bool) -> None:
        self._name = name
        self._address_map = address_map
        self._groups = groups
        self._bits = bits

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        """First address and count of each group of consecutive items in the table, ascending."""
        return tuple((run.first, run.count) for run in self._address_map.runs)

    def __len__(self) -> int:
        """Number of items in the table."""
        return self._address_map.count

    def __iter__(self) -> Iterator[int]:
        """Iterate over the values of the table, in the order of their addresses."""
        for run in self._address_map.runs:
            yield from unpacked(self._groups.get(run, 0, run.count), run.count, bits=self._bits)

    @overload
    def __getitem__(self, key: int) -> int: ...
    @overload
    def __getitem__(self, key: slice) -> list[int]: ...

    def __getitem__(self, key: int | slice) -> int | list[int]:
        if isinstance(key, slice):
            first, count = self._range(key)
            return self.read(first, count)
        return self.read(key, 1)[0]

    @overload
    def __setitem__(self, key: int, value: int) -> None: ...
    @overload
    def __setitem__(self, key: slice, value: Sequence[int]) -> None: ...

    def __setitem__(self, key: int | slice, value: int | Sequence[int]) -> None:
        if isinstance(key, slice):
            first, count = self._range(key)
            if isinstance(value, int | str | bytes) or len(value) != count:
                raise InvalidRequest(f"{self._name}: {count} values are needed, not {shown(value)}")
            self.write(first, value)
        elif isinstance(value, list | tuple):
            raise InvalidRequest(f"{self._name}: one item takes one value, not {shown(value)}")
        else:
            self.write(key, [value])  # type: ignore[list-item]  # whatever else it is, packing judges it

    def read(self, address: int, count: int) -> list[int]:
        """Read ``count`` items from ``address`` on, in one step. Raises `IndexError` if one does not exist."""
        return unpacked(self.read_wire(address, count), count, bits=self._bits)

    def write(self, address: int, values: Sequence[int]) -> None:
        """Replace the items of the table from ``address`` on by ``values``, in one step.

        Raises `IndexError` if an item does not exist, `InvalidRequest` if a value does not fit; nothing changes then.
        """
        self.write_wire(address, len(values), packed(values, bits=self._bits))

    def read_wire(self, address: int, count: int) -> bytes:
        """Read ``count`` items from ``address`` on as bytes: registers big-endian, bits packed from the lowest bit.

        Raises `IndexError` if an item does not exist. A count of 0 gives no bytes.
        """
        if not count:
            return b""
        run = self._run(address, count)
        return self._groups.get(run, address - run.first, count)

    def write_wire(self, address: int, count: int, data: bytes) -> None:
        """Replace ``count`` items from ``address`` on by bytes: registers big-endian, bits packed from the lowest bit.

        Raises `IndexError` if an item does not exist; then nothing changes. A count of 0 does nothing.
        """
        if count:
            run = self._run(address, count)
            self._groups.put(run, address - run.first, count, data)

    def _run(self, address: int, count: int) -> Run:
        run = self._address_map.find(address, count)
        if run is None:
            asked = f"{address}" if count == 1 else f"{address}…{address + count - 1}"
            there = ", ".join(f"{each.first}…{each.first + each.count - 1}" for each in self._address_map.runs[:8])
            more = ", …" if len(self._address_map.runs) > 8 else ""
            raise IndexError(f"{self._name}: there is no {asked}; there is {there or 'nothing'}{more}")
        return run

    def _range(self, key: slice) -> tuple[int, int]:
        """Return the first address and the number of items of a slice such as ``view[5:9]``."""
        if key.step not in (None, 1):
            raise IndexError(f"{self._name}: a slice of items has no step")
        runs = self._address_map.runs
        first: int = key.start if key.start is not None else runs[0].first if runs else 0
        end: int = key.stop if key.stop is not None else runs[-1].first + runs[-1].count if runs else 0
        if first < 0 or end < first:
            raise IndexError(f"{self._name}: {first}…{end} is no range of addresses")
        return first, end - first
