"""A Modbus device: its tables, files, queues and identification, and the hooks of its application.

Knows the accesses of requests (`DataModel`, `DirectModel`) and of its application; knows no connection, no unit number
and no function beyond its code.

1. An access by Modbus has four steps: check that the items exist and may be written (02), hooks before, the items,
   hooks after. A failure before the items are touched changes nothing.
2. Changes of items hold ``lock``; reading takes no lock, because a read is one slice (`busway.server.memory_runs`).
   The executor of a request holds ``lock`` around it, so that functions 22 and 23 are one step for every thread.
3. Hooks are for Modbus. The application's own accesses call none.
4. ``generation`` changes when a function compiled earlier to answer requests from bytes is no longer right.
"""

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Any, Final, TypeVar, overload
from weakref import WeakMethod

from ..codes import TABLE_SIZE, ExceptionCode, Table
from ..errors import ConfigError
from ..pdu.device_interface import Context, Refusal
from ..pdu.fast_answers import Block
from ..pdu.write_items import pack_registers
from ..values import Address, ValueType
from ..values.names import Order, TableName, WritableTableName
from ..values.unfit_values import shown
from .address_map import AddressMap, map_of_bits, map_of_registers
from .change_groups import Groups
from .file_records import RecordFile, RegisterQueue, build_files, build_queues
from .hooks import Access, Change, Hook, Hooks, Moment, ReadHook, When, WriteHook, call, function_of, role_of
from .identity import DEFAULT_SERVER_ID, ExceptionStatus, identification_objects, server_id_data, status_source
from .item_conversion import unpacked
from .memory_runs import BitRun, RegisterRun, Run
from .single_block import SingleBlock, as_table, maps_of_block
from .table_declaration import TableLike, lay_out
from .table_view import TableView
from .typed import TypedAccess

AnyReadFunction = TypeVar("AnyReadFunction", bound=ReadHook)
AnyWriteFunction = TypeVar("AnyWriteFunction", bound=WriteHook)

_HIGHEST_FUNCTION: Final = 127


class Device:
    """A Modbus device: tables, files, queues and identification. A server offers it under one or several units.

    Args:
        holding_registers: the items of the table: their number from address 0 on, a list of their values, a mapping of
            address to value or values (then exactly these exist), or `Cells`. None or 0: the table has no items, and
            every access is answered with exception 02.
        input_registers: declared like ``holding_registers``.
        coils: declared like ``holding_registers``.
        discrete_inputs: declared like ``holding_registers``.
        files: records by file number 1…65535, each declared like a table; records are 0…9999.
        fifos: queued registers by address 0…65535, oldest first.
        identification: identification objects by number 0…255, text (sent as UTF-8) or bytes, at most 244 bytes each.
            Objects 0, 1 and 2 (vendor, product, revision) have defaults, because every device has them.
        server_id: the data of function 17, at most 251 bytes, run indicator (FF on, 00 off) included.
        exception_status: eight status bits 0…255, or a function that gives them each time they are asked.
        canopen: answers a CANopen general reference (43/13), bytes to bytes; None: exception 01.
        functions: function codes that the device offers, 1…127; the others are answered with exception 01. None: all.
        block: one block of memory that several tables share; the tables it serves must not be declared as well.

    Raises:
        ConfigError: a declaration is wrong; names the argument.

    Attributes:
        holding_registers, input_registers, coils, discrete_inputs: the tables for the application (`TableView`).
        files: files by number (`RecordFile`).
        fifos: queues by address (`RegisterQueue`).
        lock: held while a request is executed and while items change. The application holds it, from any thread, to
            change a value that depends on its old value: ``with device.lock: device.holding_registers[0] += 1``. While
            it is held, requests that are not plain reads wait, and the event loop with them: keep it short.
    """

    def __init__(
        self,
        *,
        holding_registers: TableLike = None,
        input_registers: TableLike = None,
        coils: TableLike = None,
        discrete_inputs: TableLike = None,
        files: Mapping[int, TableLike] | None = None,
        fifos: Mapping[int, Sequence[int]] | None = None,
        identification: Mapping[int, str | bytes] | None = None,
        server_id: bytes = DEFAULT_SERVER_ID,
        exception_status: ExceptionStatus = 0,
        canopen: Callable[[bytes], bytes] | None = None,
        functions: Collection[int] | None = None,
        block: SingleBlock | None = None,
    ) -> None:
        self.lock: threading.RLock = threading.RLock()
        self._groups = Groups(self.lock)
        self._address_maps = _build_address_maps(
            {
                Table.HOLDING_REGISTERS: holding_registers,
                Table.INPUT_REGISTERS: input_registers,
                Table.COILS: coils,
                Table.DISCRETE_INPUTS: discrete_inputs,
            },
            block,
            self.lock,
        )
        views = {
            table: TableView(table.value, addresses, self._groups, bits=table.holds_bits)
            for table, addresses in self._address_maps.items()
        }
        self._typed = TypedAccess(views, self.lock)
        self.holding_registers: TableView = views[Table.HOLDING_REGISTERS]
        self.input_registers: TableView = views[Table.INPUT_REGISTERS]
        self.coils: TableView = views[Table.COILS]
        self.discrete_inputs: TableView = views[Table.DISCRETE_INPUTS]
        self.files: Mapping[int, RecordFile] = MappingProxyType(build_files(files, self.lock, self._groups))
        self.fifos: Mapping[int, RegisterQueue] = MappingProxyType(build_queues(fifos, self.lock))
        self._identification = identification_objects(identification)
        self._server_id = server_id_data(server_id)
        self._exception_status = status_source(exception_status)
        self._canopen = canopen
        self._functions = _checked_functions(functions)
        self._read_hooks = Hooks()
        self._write_hooks = Hooks()
        self._generation = 0
        self._watchers: list[WeakMethod[Callable[[], object]]] = []

    # ---- the application: values

    def update(self) -> AbstractContextManager[None]:
        """Context manager for changes that clients see all at once: ``with device.update(): …``.

        No Modbus client and no other thread sees some of the group's changes to tables and files without the others,
        not even by several requests one after the other. The changes take effect when the block ends; if it ends with
        an exception, none of them does. Inside the block, the thread or task sees its own changes. Modbus requests are
        served meanwhile, and nothing that they write is lost; on an item that both wrote, the group's value remains. A
        group inside a group is part of it. Queues change at once, inside a group as well.
        """
        return self._groups.update()

    @overload
    def read(self, table: Table, address: int, count: int, context: Context) -> bytes: ...
    @overload
    def read(
        self,
        address: str | Address,
        type: str | ValueType[Any] | None = None,
        *,
        order: Order = "ABCD",
        count: int | None = None,
    ) -> Any: ...  # Any: what the type says

    def read(self, *arguments: Any, **options: Any) -> Any:  # Any: as the two signatures above
        """Read one value or several of the device: ``device.read("4x101", "float32", order="CDAB")``.

        With a `Table` first, it is a read by Modbus as `DataModel.read` says, hooks included.

        Args:
            address: item in a notation that names the table: ``4x101``, ``holding:100``, ``%MW100``; one bit of a
                register as ``4x101.3``.
            type: a type of `busway.values`; None for the items themselves (``int`` for registers, ``bool`` for bits).
            order: byte and register order.
            count: number of values, 1 or more; for one bit of a register, the same bit of so many registers. None for
                one value, returned alone and not in a list.

        Returns:
            The value; a list of them if ``count`` is given.

        Raises:
            InvalidRequest: an item does not exist, or address, type, order or count is not valid.
            BadReply: the registers are no valid value of this type: a BCD digit above 9, or bytes outside a string's
                encoding.
        """
        if arguments and isinstance(arguments[0], Table):
            return self._read_by_modbus(*arguments, **options)
        return self._typed.read(*arguments, **options)

    @overload
    def write(self, table: Table, address: int, count: int, data: bytes, context: Context) -> None: ...
    @overload
    def write(
        self, address: str | Address, value: object, type: str | ValueType[Any] | None = None, *, order: Order = "ABCD"
    ) -> None: ...

    def write(self, *arguments: Any, **options: Any) -> None:  # Any: as the two signatures above
        """Write one value or several of the device in one step: ``device.write("4x101", 3.5, "float32")``.

        With a `Table` first, it is a write by Modbus as `DataModel.write` says, hooks included.

        Args:
            address: as for ``read``; one bit of a register (``4x101.3``) is changed without touching the others.
            value: the value, or a list of values for the items from ``address`` on.
            type: a type of `busway.values`; None for the items themselves.
            order: byte and register order.

        Raises:
            InvalidRequest: an item does not exist, a value does not fit, or address, type or order is not valid.
                Then nothing has changed.
        """
        if arguments and isinstance(arguments[0], Table):
            self._write_by_modbus(*arguments, **options)
        else:
            self._typed.write(*arguments, **options)

    # ---- the application: hooks and settings

    @overload
    def on_read(
        self,
        table: Table | TableName,
        function: AnyReadFunction,
        *,
        when: Moment = "before",
        address: int | None = None,
        count: int | None = None,
    ) -> AnyReadFunction: ...
    @overload
    def on_read(
        self, table: Table | TableName, *, when: Moment = "before", address: int | None = None, count: int | None = None
    ) -> Callable[[AnyReadFunction], AnyReadFunction]: ...

    def on_read(
        self,
        table: Table | TableName,
        function: AnyReadFunction | None = None,
        *,
        when: Moment = "before",
        address: int | None = None,
        count: int | None = None,
    ) -> AnyReadFunction | Callable[[AnyReadFunction], AnyReadFunction]:
        """Call a function at every read by Modbus: ``@device.on_read("input_registers")``, or with the function second.

        Called ``before`` the read, the function may set the items that will be read, or raise `Refusal`; called
        ``after``, it gets the values that were read. Any other exception is answered with 04. The read inside function
        22 calls it too. Function 23 calls it twice: ahead of its write, so that a refusal leaves everything as it was,
        and at the read itself.

        Args:
            table: the table that is read, ``holding_registers`` or `Table.HOLDING_REGISTERS`.
            function: takes an `Access`; called in the thread that executes the request, under ``lock``.
            when: ``before`` or ``after``.
            address: first item of the range: only reads that touch the range call the function; None for all reads.
            count: number of items from ``address`` on; None for one, or for all without an address.

        Returns:
            The function, or without one a decorator that gives it back.

        Raises:
            ConfigError: no such table or moment, or an impossible range.
        """
        hook = self._hook_maker(self._read_hooks, as_table(table), when, address, count)
        return hook if function is None else hook(function)

    @overload
    def on_write(
        self,
        table: Table | WritableTableName,
        function: AnyWriteFunction,
        *,
        when: Moment = "before",
        address: int | None = None,
        count: int | None = None,
    ) -> AnyWriteFunction: ...
    @overload
    def on_write(
        self,
        table: Table | WritableTableName,
        *,
        when: Moment = "before",
        address: int | None = None,
        count: int | None = None,
    ) -> Callable[[AnyWriteFunction], AnyWriteFunction]: ...

    def on_write(
        self,
        table: Table | WritableTableName,
        function: AnyWriteFunction | None = None,
        *,
        when: Moment = "before",
        address: int | None = None,
        count: int | None = None,
    ) -> AnyWriteFunction | Callable[[AnyWriteFunction], AnyWriteFunction]:
        """Call a function at every write by Modbus: ``@device.on_write("coils")``, or with the function second.

        Called ``before`` the write, the function may raise `Refusal` with an exception code (04 without one), and
        nothing changes; it cannot replace the value. Called ``after``, the items have changed, and stay changed
        whatever the function raises. Any other exception is answered with 04.

        Args:
            table: the table that is written, ``coils`` or ``holding_registers``.
            function: takes a `Change`; called in the thread that executes the request, under ``lock``.
            when: ``before`` or ``after``.
            address: first item of the range: only writes that touch the range call the function; None for all writes.
            count: number of items from ``address`` on; None for one, or for all without an address.

        Returns:
            The function, or without one a decorator that gives it back.

        Raises:
            ConfigError: no such table or moment, a table that Modbus cannot write, or an impossible range.
        """
        written = as_table(table)
        if not written.is_writable:
            raise ConfigError(f"no function writes {written.label}s")
        hook = self._hook_maker(self._write_hooks, written, when, address, count)
        return hook if function is None else hook(function)

    def remove_hook(self, function: Callable[..., object]) -> None:
        """Remove a function from the hooks of all tables. Raises `ConfigError` if it is no hook of this device."""
        with self.lock:
            found = [hooks.remove(function) for hooks in (self._read_hooks, self._write_hooks)]
            if not any(found):
                raise ConfigError(f"{shown(function)} is no hook of this device")
            self._offers_changed()

    @property
    def functions(self) -> frozenset[int] | None:
        """The function codes that the device offers; None for all. Settable at any time to any collection of codes."""
        return self._functions

    @functions.setter
    def functions(self, functions: Collection[int] | None) -> None:
        with self.lock:
            self._functions = _checked_functions(functions)
            self._offers_changed()

    def enabled(self, code: int) -> bool:
        """Whether the device offers the function with this code to clients."""
        return self._functions is None or code in self._functions

    def set_identification(self, objects: Mapping[int, str | bytes]) -> None:
        """Replace all identification objects (function 43/14); objects 0, 1 and 2 that are left out get their defaults.

        Numbers and values as in the constructor's ``identification``. Raises `ConfigError` for an invalid object.
        """
        self._identification = identification_objects(objects)

    def set_server_id(self, data: bytes) -> None:
        """Replace the data of function 17, at most 251 bytes. Raises `ConfigError` if they are longer or no bytes."""
        self._server_id = server_id_data(data)

    def set_exception_status(self, status: ExceptionStatus) -> None:
        """Replace the status bits of function 07: a number 0…255, or a function that returns it at each request.

        Raises `ConfigError` for anything else.
        """
        self._exception_status = status_source(status)

    def _hook_maker(
        self, hooks: Hooks, table: Table, when: str, address: int | None, count: int | None
    ) -> Callable[[Any], Any]:
        """Return a decorator that adds a function to ``hooks`` and returns it unchanged (of any type, hence Any)."""
        moment = _moment(when)
        first, end = _hooked_range(address, count)

        def hook(function: Any) -> Any:
            with self.lock:
                hooks.add(Hook(function, table, moment, first, end))
                self._offers_changed()
            return function

        return hook

    # ---- requests

    @property
    def generation(self) -> int:
        """A number that changes when earlier results of `plain_block` or `enabled` may no longer be right."""
        return self._generation

    def watch(self, changed: Callable[[], object]) -> None:
        """Call a bound method whenever ``generation`` changes, in the thread that has changed it.

        The method's object is held weakly: once it is gone, nothing is called.
        """
        self._watchers.append(WeakMethod(changed))

    def _offers_changed(self) -> None:
        self._generation += 1
        for watcher in list(self._watchers):
            changed = watcher()
            if changed is None:
                self._watchers.remove(watcher)
            else:
                changed()

    def plain_block(self, table: Table, *, writes: bool) -> Block | None:
        """Return a table's memory, for reads (or ``writes``) that need no hook and no check of read-only ranges.

        None if there is no such memory: the items are not in exactly one piece, they are bits of another table's
        registers, the table has hooks for this access, or for ``writes`` some items are read-only.
        """
        addresses = self._address_maps[table]
        if len(addresses.runs) != 1 or (self._write_hooks if writes else self._read_hooks).has_any(table):
            return None
        run = addresses.runs[0]
        if not isinstance(run, RegisterRun | BitRun) or (writes and addresses.read_only):
            return None
        return run

    def find_run(self, table: Table, address: int, count: int) -> Run | None:
        """Return the memory of a range of items, for an application that changes many items as bytes.

        None unless all items exist. The rules of `busway.server.memory_runs` hold: change it under ``lock``, and
        several runs only by `replace_all`.
        """
        return self._address_maps[table].find(address, count)

    def peek(self, table: Table, address: int, count: int) -> bytes | None:
        """Return the current items of a range in wire order, without calling a hook; None unless all exist."""
        run = self._address_maps[table].find(address, count)
        return None if run is None else run.get(address - run.first, count)

    def peek_file(self, file: int, record: int, count: int) -> bytes | None:
        """Return the current records of a file as big-endian bytes; None unless all exist, or if the file is damaged.

        ``record`` is the number of the first record.
        """
        found = self.files.get(file)
        try:
            run = None if found is None else found.accessed(record, count, writes=False)
        except Refusal:
            run = None
        return None if run is None else run.get(record - run.first, count)

    def check(self, table: Table, address: int, count: int, writes: bool, context: Context | None = None) -> None:
        """Check that a range of a table exists and, if the request ``writes``, is not read-only (`DataModel.check`).

        For a read with a ``context``, the hooks before a read are called too, and may refuse it.

        Raises:
            Refusal: 02 if an item does not exist or is read-only; from a hook, the code that the hook has chosen.
        """
        self._address_maps[table].accessed(table, address, count, writes=writes)
        if context is not None and not writes:
            hooks = self._read_hooks.wanted(table, address, count)
            if hooks:
                who = (context.peer, context.unit, table, address, count)
                call(hooks, When.BEFORE, Access(*who, [], function_of(context), role_of(context)))

    def _read_by_modbus(self, table: Table, address: int, count: int, context: Context) -> bytes:
        run = self._address_maps[table].accessed(table, address, count, writes=False)
        hooks = self._read_hooks.wanted(table, address, count)
        if not hooks:
            return run.get(address - run.first, count)
        who = (context.peer, context.unit, table, address, count)
        how = (function_of(context), role_of(context))
        with self.lock:
            call(hooks, When.BEFORE, Access(*who, [], *how))
            data = run.get(address - run.first, count)
            call(hooks, When.AFTER, Access(*who, unpacked(data, count, bits=table.holds_bits), *how))
        return data

    def _write_by_modbus(self, table: Table, address: int, count: int, data: bytes, context: Context) -> None:
        run = self._address_maps[table].accessed(table, address, count, writes=True)
        position = address - run.first
        hooks = self._write_hooks.wanted(table, address, count)
        if not hooks:
            run.put(position, count, data)
            return
        with self.lock:
            change = Change(
                context.peer,
                context.unit,
                table,
                address,
                count,
                unpacked(run.get(position, count), count, bits=table.holds_bits),
                unpacked(data, count, bits=table.holds_bits),
                function_of(context),
                role_of(context),
            )
            call(hooks, When.BEFORE, change)
            run.put(position, count, data)
            call(hooks, When.AFTER, change)

    def read_file(self, file: int, record: int, count: int, context: Context) -> bytes:
        """Read records of a file for function 20, as big-endian bytes.

        Raises `Refusal`: 02 if the file or a record does not exist, 03 if ``count`` is 0, 08 if the file is damaged.
        """
        run = self._file(file).accessed(record, count, writes=False)
        return run.get(record - run.first, count)

    def write_file(self, file: int, record: int, data: bytes, context: Context, *, dry: bool = False) -> None:
        """Write records of a file for function 21, from big-endian bytes.

        With ``dry`` the records are only checked, and nothing is written. Raises `Refusal`: 02 if the file or a record
        does not exist or is read-only, 03 if ``data`` is empty, 08 if the file is damaged.
        """
        count = len(data) // 2
        run = self._file(file).accessed(record, count, writes=True)
        if not dry:
            run.put(record - run.first, count, data)

    def _file(self, number: int) -> RecordFile:
        file = self.files.get(number)
        if file is None:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS, f"there is no file {number}")
        return file

    def read_fifo(self, address: int, context: Context) -> bytes:
        """Return all registers of the queue at an address, for function 24, as big-endian bytes, the oldest first.

        They stay in the queue. Raises `Refusal` (02) if there is no queue at the address.
        """
        queue = self.fifos.get(address)
        if queue is None:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS, f"there is no queue at {address}")
        return pack_registers(list(queue))

    def exception_status(self) -> int:
        """Return the eight status bits that function 07 reads, 0…255."""
        return self._exception_status()

    def server_id(self) -> bytes:
        """Return the data that function 17 (report server ID) reads."""
        return self._server_id

    def identification(self) -> Mapping[int, bytes]:
        """Return the identification objects by number that function 43/14 reads."""
        return self._identification

    def canopen(self, data: bytes) -> bytes:
        """Answer a CANopen request (function 43/13). Raises `Refusal` (01) if the device was made without ``canopen``.

        Args:
            data: the bytes of the request after function code and type 13. The returned bytes follow them in the reply.
        """
        if self._canopen is None:
            raise Refusal(ExceptionCode.ILLEGAL_FUNCTION, "no CANopen behind this device")
        return self._canopen(data)


def _build_address_maps(
    declared: Mapping[Table, TableLike], block: SingleBlock | None, lock: threading.RLock
) -> dict[Table, AddressMap]:
    served: Mapping[Table, AddressMap] = {} if block is None else maps_of_block(block, lock)
    address_maps = {}
    for table, cells in declared.items():
        if table in served:
            if cells is not None:
                raise ConfigError("the table is served by the block already", key=table.value)
            address_maps[table] = served[table]
        else:
            layout = lay_out(cells, key=table.value, bits=table.holds_bits)
            address_maps[table] = map_of_bits(layout, lock) if table.holds_bits else map_of_registers(layout, lock)
    return address_maps


def _checked_functions(functions: Collection[int] | None) -> frozenset[int] | None:
    if functions is None:
        return None
    for code in functions:
        if isinstance(code, bool) or not isinstance(code, int) or not 1 <= code <= _HIGHEST_FUNCTION:
            raise ConfigError(f"a function code is 1…{_HIGHEST_FUNCTION}, not {shown(code)}", key="functions")
    return frozenset(int(code) for code in functions)


def _moment(when: str) -> When:
    try:
        return When(when)
    except ValueError as error:
        raise ConfigError(f"a hook comes before or after, not {shown(when)}", key="when") from error


def _hooked_range(address: int | None, count: int | None) -> tuple[int, int]:
    """Return the address range of a table that a hook is registered for: first address, and the one after the last.

    Without an address, the whole table. Raises `ConfigError` for a range that is not within a table.
    """
    if address is None:
        if count is not None:
            raise ConfigError("a count of items needs their first address", key="address")
        return 0, TABLE_SIZE
    length = 1 if count is None else count
    if not 0 <= address < TABLE_SIZE or not 1 <= length <= TABLE_SIZE - address:
        raise ConfigError(f"{length} items from {address} on are not within 0…{TABLE_SIZE - 1}", key="address")
    return address, address + length
