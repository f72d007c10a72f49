"""Reads and writes of typed values, such as ``float32``, in a device's tables by an address in text form.

Knows views, notations and types; knows no request.
"""

import threading
from collections.abc import Mapping
from typing import Any

from ..codes import Table
from ..errors import InvalidRequest
from ..pdu.bits import as_state
from ..values import Address, ValueType, parse_address, value_type
from ..values.unfit_values import shown
from .table_view import TableView


class TypedAccess:
    """Reads and writes typed values in the tables of one device, for `Device.read` and `Device.write`.

    Args:
        views: the tables.
        lock: the lock of the device.
    """

    __slots__ = ("_lock", "_views")

    def __init__(self, views: Mapping[Table, TableView], lock: threading.RLock) -> None:
        self._views = views
        self._lock = lock

    def read(
        self,
        address: str | Address,
        type: str | ValueType[Any] | None = None,
        *,
        order: str = "ABCD",
        count: int | None = None,
    ) -> Any:  # Any: what the type says
        """Read the value at an address of the device, or a list of ``count`` values.

        Arguments and errors as in `Device.read`.
        """
        where, view = self._located(address)
        items = _item_type(where, type, order)
        number = 1 if count is None else count
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise InvalidRequest(f"count is a number of values, 1 or more, not {shown(number)}")
        try:
            if items is not None:
                values = items.decode(view.read_wire(where.offset, items.registers_for(number)))
            elif where.bit is not None:
                values = [bool(each >> where.bit & 1) for each in view.read(where.offset, number)]
            else:
                values = list(view.read(where.offset, number))
        except IndexError as error:
            raise InvalidRequest(str(error)) from error
        return values[0] if count is None else values

    def write(
        self, address: str | Address, value: object, type: str | ValueType[Any] | None = None, *, order: str = "ABCD"
    ) -> None:
        """Write a value, or a list of values, to an address of the device in one step.

        Arguments and errors as in `Device.write`.
        """
        where, view = self._located(address)
        items = _item_type(where, type, order)
        values: list[Any] = value if isinstance(value, list) else [value]  # Any: the type judges them
        try:
            if items is not None:
                data = items.encode(values)
                view.write_wire(where.offset, len(data) // 2, data)
            elif where.bit is not None:
                self._write_bit(view, where.offset, where.bit, value)
            else:
                view.write(where.offset, values)
        except IndexError as error:
            raise InvalidRequest(str(error)) from error

    def _write_bit(self, view: TableView, offset: int, bit: int, value: object) -> None:
        state = as_state("a bit", value)
        with self._lock:
            view[offset] = view[offset] & ~(1 << bit) | state << bit

    def _located(self, address: str | Address) -> tuple[Address, TableView]:
        where = parse_address(address)
        if where.table is None:
            raise InvalidRequest(f"{where} does not say which table; write for example holding:{where.offset}")
        return where, self._views[where.table]


def _item_type(where: Address, type: str | ValueType[Any] | None, order: str) -> ValueType[Any] | None:
    """Return the type of the values at an address; None if no type was given: then they are plain registers or bits.

    Raises `InvalidRequest` if there is no such type, or bits are asked for with a type.
    """
    if type is None:
        return None
    if where.table is not None and where.table.holds_bits:
        raise InvalidRequest(f"address {where}: a {where.table.label} is one bit and has no type")
    if where.bit is not None:
        raise InvalidRequest(f"address {where}: one bit of a register has no type")
    return value_type(type, order)
