"""The data blocks and contexts of pymodbus: what programs fill, share, subclass and change while a server runs.

Knows values and addresses; knows no server.

1. A context adds 1 to the address of a request before it asks its blocks, unless ``zero_mode`` is set.
2. A block is never copied: it may belong to several contexts, and the server asks for its values when a request comes.
   But a block copies the list or dict that it is created from.
3. A subclass may override ``getValues`` and ``setValues`` of blocks and contexts. Both may return an exception code.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from .exceptions import NoSuchIdException, ParameterException

ITEMS = 65_536
LAST_UNIT = 255
TABLE_OF = {**dict.fromkeys((1, 5, 15), "c"), 2: "d", 4: "i", **dict.fromkeys((3, 6, 16, 22, 23), "h")}
"""The table that each function code reads or writes: coils, discrete inputs, input or holding registers."""


class BaseModbusDataBlock:
    """Base of the data blocks: values of one table, by address.

    Attributes:
        values: a list, or a dict by address.
        address: address of the first value of a list.
        default_value: what ``reset`` restores: one value for all addresses, or in a sparse block a dict by address.
    """

    values: Any  # a list in one kind of block, a dict in the other; subclasses of programs bring others
    address: int = 0
    default_value: Any = 0

    def validate(self, address: int, count: int = 1) -> bool:
        """Whether the block has all of ``count`` addresses from ``address`` on.

        Subclasses implement it; here it raises `NotImplementedError`.
        """
        raise NotImplementedError

    def getValues(self, address: int, count: int = 1) -> Any:
        """Return a list of ``count`` values from ``address`` on, or an exception code to refuse the request with.

        Subclasses implement it; here it raises `NotImplementedError`.
        """
        raise NotImplementedError

    def setValues(self, address: int, values: Any) -> Any:
        """Replace the values from ``address`` on. Returns None, or an exception code to refuse the request with.

        Subclasses implement it; here it raises `NotImplementedError`.
        """
        raise NotImplementedError

    async def async_getValues(self, address: int, count: int = 1) -> Any:
        """Return the result of `getValues`. For programs: a server calls `getValues` itself."""
        return self.getValues(address, count)

    async def async_setValues(self, address: int, values: Any) -> Any:
        """Call `setValues` and return its result. For programs: a server calls `setValues` itself."""
        return self.setValues(address, values)

    def __str__(self) -> str:
        return f"DataStore({len(self.values)}, {self.default_value})"

    def __iter__(self) -> Iterator[Any]:
        return iter(self.values.items()) if isinstance(self.values, dict) else enumerate(self.values, self.address)


class ModbusSequentialDataBlock(BaseModbusDataBlock):
    """Data block of consecutive addresses.

    Its default value is that of the first value's type (0 or False), until `default` sets another.

    Args:
        address: address of the first value.
        values: a list of values, or one value; a list is copied.
    """

    def __init__(self, address: int, values: Any) -> None:
        self.address: int = address
        self.values: Any = list(values) if isinstance(values, Iterable) else [values]
        self.default_value: Any = type(self.values[0])() if self.values else 0

    @classmethod
    def create(cls) -> "ModbusSequentialDataBlock":
        """Return a block with all 65 536 addresses, filled with 0."""
        return cls(0, [0] * ITEMS)

    def default(self, count: int, value: Any = False) -> None:
        """Replace the content of the block by ``count`` times ``value``, from address 0 on; `reset` restores it."""
        self.default_value, self.values, self.address = value, [value] * count, 0

    def reset(self) -> None:
        """Set all values of the block to its default value; the number of values stays."""
        self.values = [self.default_value] * len(self.values)

    def validate(self, address: int, count: int = 1) -> bool:
        """Whether the block has all of ``count`` addresses from ``address`` on."""
        return self.address <= address and address + count <= self.address + len(self.values)

    def getValues(self, address: int, count: int = 1) -> Any:
        """Return ``count`` values from ``address`` on, as a list.

        The addresses are not checked here: call `validate` before.
        """
        start = address - self.address
        return self.values[start : start + count]

    def setValues(self, address: int, values: Any) -> Any:
        """Replace the values from ``address`` on: one value, or a list or tuple of values.

        The addresses are not checked here: call `validate` before. Values beyond the end are appended, without a gap.
        """
        new = list(values) if isinstance(values, list | tuple) else [values]
        start = address - self.address
        self.values[start : start + len(new)] = new


class ModbusSparseDataBlock(BaseModbusDataBlock):
    """Data block whose addresses may have gaps.

    Args:
        values: a dict by address, in which a list stands for consecutive addresses; or a list from address 0 on.
        mutable: whether `setValues` may add addresses.
    """

    def __init__(self, values: Any = None, mutable: bool = True) -> None:
        self.values: Any = {}
        self.mutable: bool = mutable
        self._process_values(values)
        self.default_value: Any = dict(self.values)

    @classmethod
    def create(cls, values: Any = None) -> "ModbusSparseDataBlock":
        """Return a block with these values."""
        return cls(values)

    def _process_values(self, values: Any) -> None:
        if not isinstance(values, Mapping):
            if values is not None and not isinstance(values, Iterable):
                raise ParameterException("Values for datastore must be a list or dictionary")
            values = dict(enumerate(values or ()))
        for address, value in values.items():
            several = value if isinstance(value, list | tuple) else [value]
            self.values.update(enumerate(several, address))

    def reset(self) -> None:
        """Restore the values that the block had when it was created, or when ``use_as_default`` was last given."""
        self.values = dict(self.default_value)

    def validate(self, address: int, count: int = 1) -> bool:
        """Whether the block has all of ``count`` addresses from ``address`` on; False for no addresses."""
        return count > 0 and all(one in self.values for one in range(address, address + count))

    def getValues(self, address: int, count: int = 1) -> Any:
        """Return ``count`` values from ``address`` on, as a list. Raises ``KeyError`` for an address in a gap."""
        return [self.values[one] for one in range(address, address + count)]

    def setValues(self, address: int, values: Any, use_as_default: bool = False) -> Any:
        """Replace the values from ``address`` on; if ``values`` is a dict, the values at its keys, and not ``address``.

        ``use_as_default``: whether `reset` restores the values that the block has after this call.

        Raises:
            ParameterException: an address is new, and the block is not mutable.
        """
        if not isinstance(values, Mapping):
            several = values if isinstance(values, list | tuple) else [values]
            values = dict(enumerate(several, address))
        new = values.keys() - self.values.keys()
        if new and not self.mutable:
            raise ParameterException(f"Offsets {sorted(new)} not in range")
        self._process_values(values)
        if use_as_default:
            self.default_value = dict(self.values)


class ModbusBaseDeviceContext:
    """Base of the contexts: the values of one unit, by function code and address.

    The function code (``fc_as_hex``) of a request determines which table is read or written.
    """

    _fx_mapper: Mapping[int, str] = TABLE_OF

    def decode(self, fx: int) -> str:
        """Return the table of a function code: ``c``, ``d``, ``i`` or ``h``. Raises ``KeyError`` for other codes."""
        return self._fx_mapper[fx]

    def validate(self, fc_as_hex: int, address: int, count: int = 1) -> bool:
        """Return True: all addresses exist. Subclasses override this method to check ``count`` of them."""
        return True

    def getValues(self, fc_as_hex: int, address: int, count: int = 1) -> Any:
        """Return a list of the values that a request reads, or an exception code to refuse the request with."""
        raise NotImplementedError

    def setValues(self, fc_as_hex: int, address: int, values: Any) -> Any:
        """Replace the values that a request writes. Returns None, or an exception code to refuse the request with."""
        raise NotImplementedError

    async def async_getValues(self, fc_as_hex: int, address: int, count: int = 1) -> Any:
        """Return the result of `getValues`. For programs: a server calls `getValues` itself."""
        return self.getValues(fc_as_hex, address, count)

    async def async_setValues(self, fc_as_hex: int, address: int, values: Any) -> Any:
        """Call `setValues` and return its result. For programs: a server calls `setValues` itself."""
        return self.setValues(fc_as_hex, address, values)


class ModbusDeviceContext(ModbusBaseDeviceContext):
    """The four tables of one unit as blocks; a table that is left out has all addresses, filled with 0.

    Args:
        di, co, ir, hr: blocks of the discrete inputs, coils, input registers and holding registers.
        zero_mode: True: address 0 of a request is address 0 of a block. False: it is address 1, and so on.

    Attributes:
        store: the blocks, by the letter that `decode` returns.
    """

    def __init__(
        self,
        *_arguments: Any,  # some programs pass the context of an older release's base class
        di: BaseModbusDataBlock | None = None,
        co: BaseModbusDataBlock | None = None,
        ir: BaseModbusDataBlock | None = None,
        hr: BaseModbusDataBlock | None = None,
        zero_mode: bool = False,
    ) -> None:
        blocks = {"d": di, "c": co, "i": ir, "h": hr}
        self.store: dict[str, Any] = {
            name: ModbusSequentialDataBlock.create() if block is None else block for name, block in blocks.items()
        }
        self.zero_mode: bool = zero_mode

    def __str__(self) -> str:
        return "Modbus Device Context"

    def _placed(self, fc_as_hex: int, address: int) -> tuple[Any, int]:
        return self.store[self.decode(fc_as_hex)], address + (not self.zero_mode)

    def reset(self) -> None:
        """Reset all blocks to their default values."""
        for block in self.store.values():
            block.reset()

    def validate(self, fc_as_hex: int, address: int, count: int = 1) -> bool:
        """Whether the block of the function code has all of ``count`` addresses from ``address`` (of a request) on.

        Raises ``KeyError`` for a function code without a block.
        """
        block, at = self._placed(fc_as_hex, address)
        return bool(block.validate(at, count))

    def getValues(self, fc_as_hex: int, address: int, count: int = 1) -> Any:
        """Return ``count`` values of the function code's block from ``address`` of a request on.

        An exception code that the block returns instead is returned, to refuse the request with.
        """
        block, at = self._placed(fc_as_hex, address)
        return block.getValues(at, count)

    def setValues(self, fc_as_hex: int, address: int, values: Any) -> Any:
        """Replace the values of the function code's block from ``address`` of a request on.

        Returns None, or an exception code to refuse the request with.
        """
        block, at = self._placed(fc_as_hex, address)
        return block.setValues(at, values)

    def register(self, function_code: int, fc_as_hex: str, datablock: BaseModbusDataBlock | None = None) -> None:
        """Make a function code use a block of its own, under the key ``fc_as_hex`` of ``store``.

        Without ``datablock`` the block has all addresses, filled with 0.
        """
        self.store[fc_as_hex] = datablock or ModbusSequentialDataBlock.create()
        self._fx_mapper = {**self._fx_mapper, function_code: fc_as_hex}


# Names in releases before 3.10.
ModbusBaseSlaveContext = ModbusBaseDeviceContext
ModbusSlaveContext = ModbusDeviceContext


class ModbusServerContext:
    """The contexts of a server by unit; ``context[unit]`` raises `NoSuchIdException` for a unit without one.

    Args:
        devices: one context for all units, or a dict of contexts by unit; unit 0 in a dict answers for all units that
            are not listed. Without it no unit has a context, until one is set.
        single: whether ``devices`` is one context; has no effect if it is a dict.
        slaves: the name of ``devices`` in older releases.
    """

    def __init__(self, devices: Any = None, single: bool = True, *, slaves: Any = None) -> None:
        units = slaves if devices is None else devices
        self.single: bool = single and not isinstance(units, dict)
        self._units: dict[int, Any] = {0: units} if self.single and units is not None else dict(units or {})

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        return iter(self._units.items())

    def __contains__(self, unit: int) -> bool:
        return unit in self._units or 0 in self._units

    def __getitem__(self, unit: int) -> Any:
        found = self._units.get(unit, self._units.get(0))
        if found is None:
            raise NoSuchIdException(f"device_id - {unit} does not exist, or is out of range")
        return found

    def __setitem__(self, unit: int, context: Any) -> None:
        if not 0 <= unit <= LAST_UNIT:
            raise NoSuchIdException(f"device_id - {unit} is out of range")
        self._units[0 if self.single else unit] = context

    def __delitem__(self, unit: int) -> None:
        if self.single or unit not in self._units:
            raise NoSuchIdException(f"device_id - {unit} does not exist, or is out of range")
        del self._units[unit]

    def device_ids(self) -> list[int]:
        """Return the units that are listed; ``[0]`` if one context answers for all."""
        return list(self._units)

    slaves = device_ids


__path__: list[str] = []
"""Empty: it makes this module a package for Python, so that `aliases` can serve names of modules below it."""
