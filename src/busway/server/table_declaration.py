"""Checks how a user declared the items of a table or file: addresses, initial values, read-only ranges.

Knows numbers, sequences and mappings; knows no lock, no memory and no request.

1. A wrong declaration is refused here, at construction, with `ConfigError`: an address outside 0…65535, two values for
   one address, a value that does not fit, a read-only range of items that do not exist.
2. Items of adjacent addresses become one run, however they were declared: a request may cross where they meet.
"""

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ..codes import TABLE_SIZE
from ..errors import ConfigError
from ..values.unfit_values import shown

CellValues = Sequence[int] | Mapping[int, int | Sequence[int]]
Ranges = Iterable[tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Cells:
    """A user's declaration of a table's items or a file's records: initial values by address, or just their number.

    Args:
        first: address of the first item, 0-based; 0 if ``values`` is a mapping and there is no ``count``.
        count: number of items from ``first`` on; None for as many as ``values`` has.
        values: the initial values: a sequence, from ``first`` on; or a mapping of an address to its value, or to a list
            of values from that address on. With a mapping and no ``count``, exactly the addresses in the mapping exist.
            Items without a value are zero. Registers take 0…65535, bits ``bool`` or 0 and 1.
        read_only: ranges, each first address and count, that Modbus cannot write (exception 02); the application can.
    """

    first: int = 0
    count: int | None = None
    values: CellValues | None = None
    read_only: Ranges = ()


TableLike = int | CellValues | Cells | None
"""What declares a table: a number of items from address 0 on, a list or mapping of their values, or `Cells`. None and 0
declare a table without items.
"""


@dataclass(frozen=True, slots=True)
class Piece:
    """Initial values of a table's items at consecutive addresses; ``first`` is the address of the first value."""

    first: int
    values: list[int]

    @property
    def end(self) -> int:
        """The address after the last item of this piece."""
        return self.first + len(self.values)


@dataclass(frozen=True, slots=True)
class CellLayout:
    """The checked declaration of a table: pieces of initial values, and read-only ranges, both ascending.

    A read-only range is its first address and the address after its last.
    """

    pieces: tuple[Piece, ...]
    read_only: tuple[tuple[int, int], ...]


def lay_out(declared: TableLike, *, key: str, bits: bool = False, size: int = TABLE_SIZE) -> CellLayout:
    """Check the declaration of a table or file, and turn it into initial values and read-only ranges.

    Args:
        declared: the items.
        key: the argument that declares them, named in errors.
        bits: whether an item is one bit; else it is a register.
        size: number of possible addresses, from 0 on.

    Raises:
        ConfigError: the declaration is wrong; names ``key``.
    """
    cells = _as_cells(declared, key)
    pieces = _merged(_pieces(cells, key, bits, size), key)
    for piece in pieces:
        if piece.first < 0 or piece.end > size:
            raise ConfigError(
                f"addresses are 0…{size - 1}, but {piece.first}…{piece.end - 1} are declared",
                key=key,
            )
    read_only = sorted(_range(each, key) for each in cells.read_only)
    for first, end in read_only:
        if not any(piece.first <= first and end <= piece.end for piece in pieces):
            raise ConfigError(f"the read-only range {first}…{end - 1} holds addresses that do not exist", key=key)
    return CellLayout(tuple(pieces), tuple(read_only))


def _as_cells(declared: TableLike, key: str) -> Cells:
    if declared is None:
        return Cells(count=0)
    if isinstance(declared, Cells):
        return declared
    if isinstance(declared, int) and not isinstance(declared, bool):
        return Cells(count=declared)
    if isinstance(declared, Mapping):
        return Cells(values=declared)
    if isinstance(declared, Sequence) and not isinstance(declared, str | bytes | bytearray):
        return Cells(values=declared)
    raise ConfigError(
        f"{shown(declared)} declares no items; give their number, a list of values, or a mapping of address to value",
        key=key,
    )


def _pieces(cells: Cells, key: str, bits: bool, size: int) -> list[Piece]:
    """Return the declared values as pieces of consecutive addresses; a declared count becomes one piece."""
    first = _whole("the first address", cells.first, key)
    values = cells.values
    if cells.count is None:
        if isinstance(values, Mapping):
            if first:
                raise ConfigError("first goes with a count or a list; a mapping names its own addresses", key=key)
            return [_piece(address, value, key, bits) for address, value in values.items()]
        return [_piece(first, values if values is not None else [], key, bits)]
    count = _whole("the count", cells.count, key)
    if not 0 <= count <= size:
        raise ConfigError(f"a number of items is 0…{size}, not {shown(count)}", key=key)
    given: list[Piece] = []
    if isinstance(values, Mapping):
        given = [_piece(address, value, key, bits) for address, value in values.items()]
    elif values is not None:
        given = [_piece(first, values, key, bits)]
    whole = Piece(first, [0] * count)
    for piece in _merged(given, key):
        if piece.first < whole.first or piece.end > whole.end:
            raise ConfigError(
                f"values for {piece.first}…{piece.end - 1}, but {count} items from {first} on are declared", key=key
            )
        whole.values[piece.first - first : piece.end - first] = piece.values
    return [whole]


def _piece(address: int, values: int | Sequence[int], key: str, bits: bool) -> Piece:
    first = _whole("an address", address, key)
    if isinstance(values, str | bytes | bytearray):
        raise ConfigError(f"address {first}: {shown(values)} is no list of values", key=key)
    listed = list(values) if isinstance(values, Iterable) else [values]
    return Piece(first, [_value(first + position, value, key, bits) for position, value in enumerate(listed)])


def _value(address: int, value: object, key: str, bits: bool) -> int:
    """Return one declared initial value as ``int``. Raises `ConfigError` if it is no whole number in its range."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if not 0 <= number <= (1 if bits else 0xFFFF):
        expected = "a bit is True or False" if bits else "a register holds 0…65535"
        raise ConfigError(f"address {address}: {expected}, not {shown(value)}", key=key)
    return number


def _merged(pieces: list[Piece], key: str) -> list[Piece]:
    """Sort pieces of initial values by address and join adjacent ones. Raises `ConfigError` if two overlap."""
    found: list[Piece] = []
    for piece in sorted(pieces, key=lambda each: each.first):
        if not piece.values:
            continue
        if found and piece.first < found[-1].end:
            raise ConfigError(f"address {piece.first} is declared twice", key=key)
        if found and piece.first == found[-1].end:
            found[-1].values.extend(piece.values)
        else:
            found.append(Piece(piece.first, list(piece.values)))
    return found


def _range(declared: tuple[int, int], key: str) -> tuple[int, int]:
    if not isinstance(declared, Sequence) or isinstance(declared, str | bytes) or len(declared) != 2:
        raise ConfigError(f"a range is its first address and a count, not {shown(declared)}", key=key)
    first, count = (_whole("a range's first address and count", each, key) for each in declared)
    if first < 0 or count < 1:
        raise ConfigError(f"a range has a first address from 0 and a count from 1, not {shown(declared)}", key=key)
    return first, first + count


def _whole(name: str, value: object, key: str) -> int:
    if isinstance(value, bool):
        raise ConfigError(f"{name} is a whole number, not {value}", key=key)
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise ConfigError(f"{name} is a whole number, not {shown(value)}", key=key) from None
