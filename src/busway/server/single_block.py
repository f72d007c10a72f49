"""A device with one block of memory: bit functions and word functions reach the same registers.

Application Protocol V1.1b3 §4.3, figure 7. Knows the mapping; knows no request.

1. Register ``n`` is register ``n`` of every word table that the block serves.
2. Bit ``n`` of a bit table is bit ``n % 16`` of register ``first + n // 16``; bit 0 is the least significant.
3. The bits of a read-only register are read-only too.
"""

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from ..codes import TABLE_SIZE, Table
from ..errors import ConfigError
from ..values.counts import counted
from ..values.names import TableName
from ..values.unfit_values import shown
from .address_map import AddressMap, map_of_registers
from .memory_runs import RegisterBits, RegisterRun
from .table_declaration import TableLike, lay_out


@dataclass(frozen=True, slots=True)
class SingleBlock:
    """A declaration of one block of registers that several tables of a device share.

    Args:
        registers: the registers, without gaps: a number of them from address 0 on, their values, or `Cells`.
        coils_at: address of the register with coils 0…15, and the number of coils; None for all bits of the block.
        discrete_inputs_at: address of the register with discrete inputs 0…15, and their number; None for all bits of
            the block.
        tables: the tables that the block serves, by name or as `Table`; the other tables can be declared beside it.
    """

    registers: TableLike
    coils_at: tuple[int, int] | None = None
    discrete_inputs_at: tuple[int, int] | None = None
    tables: Collection[Table | TableName] = tuple(Table)


def maps_of_block(block: SingleBlock, lock: threading.RLock) -> Mapping[Table, AddressMap]:
    """Return the memory of each table that the block serves. Raises `ConfigError` if the block is declared wrongly."""
    words = map_of_registers(lay_out(block.registers, key="block.registers"), lock)
    if len(words.runs) != 1:
        raise ConfigError(f"a block is one run of registers, not {len(words.runs)}", key="block.registers")
    memory = words.runs[0].memory
    assert isinstance(memory, RegisterRun)
    address_maps: dict[Table, AddressMap] = {}
    for table in map(as_table, block.tables):
        if not table.holds_bits:
            address_maps[table] = words
        else:
            declared = block.coils_at if table is Table.COILS else block.discrete_inputs_at
            address_maps[table] = _bits_of(memory, words, declared, f"block.{table.value}_at", lock)
    return MappingProxyType(address_maps)


def as_table(table: Table | str) -> Table:
    """Return the table with a name such as ``holding_registers``; a `Table` is returned unchanged.

    Raises `ConfigError` for an unknown name.
    """
    try:
        return Table(table)
    except ValueError as error:
        names = ", ".join(each.value for each in Table)
        raise ConfigError(f"there is no table {shown(table)}, but {names}") from error


def _bits_of(
    memory: RegisterRun, words: AddressMap, declared: tuple[int, int] | None, key: str, lock: threading.RLock
) -> AddressMap:
    register, count = declared or (memory.first, min(16 * memory.count, TABLE_SIZE))
    start = register - memory.first
    if start < 0 or not 1 <= count <= TABLE_SIZE or start + (count + 15) // 16 > memory.count:
        raise ConfigError(
            f"{counted(count, 'bit')} from register {register} on do not lie in registers"
            f" {memory.first}…{memory.first + memory.count - 1}",
            key=key,
        )
    read_only = tuple(
        (max(0, 16 * (first - register)), 16 * (end - register)) for first, end in words.read_only if end > register
    )
    return AddressMap((RegisterBits(memory, start, count, lock),), read_only)
