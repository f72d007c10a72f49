"""The blocking interface: links and units for plain programs and threads.

Knows names, arguments and results; `busway.client.blocking_link` does the communication. The asynchronous interface
(`busway.client.aio`) has the same names, arguments and docstrings; a test ensures that.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self, SupportsFloat, SupportsIndex, TypeVar, Unpack, overload

from ..errors import LinkDown, ModbusError, NoReply, Overloaded
from ..options.client import LinkSelection, selection
from ..options.endpoints import Endpoint
from ..pdu.diagnostics import GetCommEventCounter, GetCommEventLog, ReadExceptionStatus, ReportServerId
from ..pdu.file_records import FileReference, ReadFileRecord, WriteFileRecord
from ..pdu.message import Message, Request, TypedRequest
from ..pdu.read_items import (
    ReadCoils,
    ReadDiscreteInputs,
    ReadFifoQueue,
    ReadHoldingRegisters,
    ReadInputRegisters,
    read_request,
)
from ..pdu.wide_registers import wide
from ..pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ..session.call import CallOptions, call_for
from ..session.client_counters import ClientCounters
from ..session.reconnect import ConnectionState
from ..values import Address, ValueType
from ..values.names import FloatName, IdentificationLevel, IntegerName, Order
from .assumed_settings import default_unit, with_assumed_line, with_assumed_unit
from .blocking_link import BlockingLinkDriver
from .blocking_pool import BLOCKING_POOL
from .connection_choice import check_selected, no_connection_of_its_own
from .operations import (
    Operation,
    WriteFunctionChoice,
    diagnostic_data,
    diagnostic_request,
    errors_among,
    read_identification,
    read_values,
    write_values,
)
from .refused_calls import closed_error, refused
from .settings import LinkSettings, link_settings
from .shown_state import SHOWN_STATE
from .state_observers import OnState

if TYPE_CHECKING:
    import ssl
    from collections.abc import Mapping

    from .option_types import LinkOptions
    from .read_many import NamedRead

Reply = TypeVar("Reply", bound=Message)
Value = TypeVar("Value")


class BlockingUnit:
    """One unit (device) reached through a link; has the methods that read and write it.

    Every method sends one request (`read`, `read_many`, `read_device_identification` and `execute_many` can send
    several), waits for the reply, and returns plain Python values. Every method can raise:

    * `InvalidRequest`: an argument is out of range; nothing was sent.
    * `ExceptionReply`: the device refused the request.
    * `NoReply`: no answer came in time, after all attempts. `UnitSuspended`, a kind of it: nothing was sent, because
      the unit's breaker is open.
    * `BadReply`: the answer breaks the protocol, or its bytes are no value of the type.
    * `LinkDown`: there is no connection, or it ended before the answer. `LinkClosed`, a kind of it: the program has
      closed this link.
    * `Overloaded`: too many calls wait already; nothing was sent.
    * `WriteOutcomeUnknown`: only requests that write; the request was sent, and no valid answer came: it may have been
      executed or not.
    """

    __slots__ = ("_holding", "_input", "_is_assumed", "_link", "_number", "_width")

    def __init__(self, link: "BlockingLink", number: int, is_assumed: bool = False) -> None:
        self._link = link
        self._number = number
        self._is_assumed = is_assumed  # the default: the caller named no unit
        self._width = link.register_width
        self._holding = wide(ReadHoldingRegisters, self._width)
        self._input = wide(ReadInputRegisters, self._width)

    def __repr__(self) -> str:
        return f"<Unit {self._number} of {self._link.endpoint.url}>"

    @property
    def number(self) -> int:
        """The unit identifier, 0…255, that requests of this unit carry."""
        return self._number

    def execute(self, request: TypedRequest[Reply], **call_options: Unpack[CallOptions]) -> Reply:
        """Send any request message and return its reply, for functions that have no method of their own here.

        Args:
            request: a request of a standard function, or of a function that you declared.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Returns:
            The reply message. An exception reply of the device is raised as `ExceptionReply`.
        """
        requests: tuple[Any] = (request,)  # `TypedRequest` is for type checkers; these are complete requests
        outcome: Any
        (outcome,) = self._link.run(self._number, requests, call_options)
        if isinstance(outcome, ModbusError):
            self._add_hint(outcome)
            raise outcome
        reply: Reply = outcome
        return reply

    def execute_many(
        self, requests: Sequence[Request], *, return_errors: bool = False, **call_options: Unpack[CallOptions]
    ) -> list[Any]:
        """Send many requests, as many at once as the link allows, and return their replies in the same order.

        Args:
            requests: any number of request messages; for none, nothing is sent and the result is empty.
            return_errors: what happens if requests fail. True: the list has an error in place of each missing reply; if
                nothing could be sent (`LinkDown`, `Overloaded`, `UnitSuspended`), each request has that error. False:
                after all requests have ended, the first error is raised. `InvalidRequest` for invalid arguments is
                always raised.
            call_options: `CallOptions`; the deadline is for all requests together.
        """
        if not requests:
            return []
        outcomes: list[Any]
        try:
            outcomes = self._link.run(self._number, requests, call_options)
        except (LinkDown, Overloaded, NoReply) as refusal:
            if not return_errors:
                raise
            outcomes = refused(refusal, requests)
        for error in errors_among(outcomes):
            self._add_hint(error)
            if not return_errors:
                raise error
        return outcomes

    def _add_hint(self, error: ModbusError) -> None:
        """Add a hint to the message of an error that an assumed unit, baud rate or parity may have caused.

        Assumed are those that the user did not give. Other errors stay unchanged.
        """
        if self._is_assumed:
            with_assumed_unit(error, self._number)
        with_assumed_line(error, self._link._settings, self._link.counters)

    @overload
    def read(
        self,
        address: int | str | Address,
        type: IntegerName,
        *,
        order: Order = "ABCD",
        count: None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> int: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: IntegerName,
        *,
        order: Order = "ABCD",
        count: int,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> list[int]: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: FloatName,
        *,
        order: Order = "ABCD",
        count: None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> float: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: FloatName,
        *,
        order: Order = "ABCD",
        count: int,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> list[float]: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: ValueType[Value],
        *,
        order: Order = "ABCD",
        count: None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> Value: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: ValueType[Value],
        *,
        order: Order = "ABCD",
        count: int,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> list[Value]: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: str | None = None,
        *,
        order: Order = "ABCD",
        count: None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> Any: ...

    @overload
    def read(
        self,
        address: int | str | Address,
        type: str | None = None,
        *,
        order: Order = "ABCD",
        count: int,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> list[Any]: ...

    def read(
        self,
        address: int | str | Address,
        type: str | ValueType[Any] | None = None,
        *,
        order: Order = "ABCD",
        count: int | None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> Any:
        """Read one value, or ``count`` values, from an address in any notation, such as ``4x101``.

        Args:
            address: such as ``4x101``, ``40101``, ``holding:0x64``, ``%MW100``, ``0x1`` for coil 1 (`parse_address`).
                ``4x101.3`` reads one bit of a register, as a bool, with ``count`` the same bit of so many registers;
                ``type`` has no effect then.
            type: type of the values in registers, such as ``float32`` or ``string:8``; None for ``uint16``. It must be
                None for coils and discrete inputs, which are bools.
            order: order of bytes and registers in a value, ``ABCD`` (big-endian) by default.
            count: number of values, which are returned as a list; None returns one value, not in a list.
            split: whether several requests may be sent if one cannot read ``count`` values; if not, such a count is
                `InvalidRequest`.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        return self._perform(read_values(address, type, order, count, split, self._width), call_options)

    def read_many(
        self, wanted: "Mapping[str, NamedRead]", *, order: Order = "ABCD", **call_options: Unpack[CallOptions]
    ) -> dict[str, Any]:
        """Read values from several addresses, by name, with as few requests as their addresses allow.

        Ranges that touch or overlap are read by one request; addresses between other ranges are not read. The requests
        are sent as by `execute_many`, so values of different requests may be of different moments.

        Args:
            wanted: by name, an address in any notation, or a tuple of address and type, or of address, type and count:
                ``{"power": ("4x1", "float32"), "on": "0x1", "names": ("4x9", "string:8", 2)}``.
            order: order of bytes and registers in all values; without it a `ValueType` keeps its own order.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Returns:
            The values by name, in the order of ``wanted``; a list where a count was given.
        """
        from .read_many import read_together  # here: programs that do without it do not wait for it

        found: dict[str, Any] = self._perform(read_together(wanted, order, self._width), call_options)
        return found

    @overload
    def write(
        self,
        address: int | str | Address,
        value: SupportsIndex | Iterable[SupportsIndex],
        type: IntegerName | None = None,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None: ...

    @overload
    def write(
        self,
        address: int | str | Address,
        value: SupportsFloat | Iterable[SupportsFloat],
        type: FloatName,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None: ...

    @overload
    def write(
        self,
        address: int | str | Address,
        value: Value | Iterable[Value],
        type: ValueType[Value],
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None: ...

    @overload
    def write(
        self,
        address: int | str | Address,
        value: Any,
        type: str,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None: ...

    def write(
        self,
        address: int | str | Address,
        value: Any,
        type: str | ValueType[Any] | None = None,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None:
        """Write one value, or several, to an address in any notation, with one request.

        A value out of range raises `InvalidRequest`, and nothing is sent.

        Args:
            address: as in `read`; ``4x1.3`` writes one bit of a register by a mask write (function 22), with True or
                False; ``type``, ``order`` and ``function`` have no effect then.
            value: one value, or any iterable of values for consecutive addresses.
            type: type of the values in registers; None for ``uint16``. It must be None for coils.
            order: order of bytes and registers in a value, ``ABCD`` (big-endian) by default.
            function: ``single`` (05, 06) or ``multiple`` (15, 16), for devices that have only one of the two; ``auto``
                uses the single function for one coil or register.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self._perform(write_values(address, value, type, order, function), call_options)

    def read_device_identification(
        self, level: IdentificationLevel = "basic", *, object_id: int | None = None, **call_options: Unpack[CallOptions]
    ) -> dict[int, bytes]:
        """Read identification objects as a dict of bytes by object number, function 43/14 (§6.21).

        As many requests are sent as the objects need.

        Args:
            level: ``basic`` (objects 0–2), ``regular`` (to 0x7F) or ``extended`` (to 0xFF).
            object_id: read only this object, 0…255, whatever ``level`` is; None reads all objects of the level.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        found: dict[int, bytes] = self._perform(read_identification(level, object_id), call_options)
        return found

    def read_coils(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[bool]:
        """Read coils as a list of bools, the first at ``address`` (MODBUS Application Protocol V1.1b3 §6.1).

        Args:
            address: first coil, 0…65535.
            count: number of coils, 1…2000.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadCoils.Reply = self.execute(read_request(ReadCoils, address, count), **call_options)
        return reply.bits(count)

    def read_discrete_inputs(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[bool]:
        """Read discrete inputs as a list of bools, the first at ``address`` (MODBUS Application Protocol V1.1b3 §6.2).

        Args:
            address: first input, 0…65535.
            count: number of inputs, 1…2000.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadDiscreteInputs.Reply = self.execute(read_request(ReadDiscreteInputs, address, count), **call_options)
        return reply.bits(count)

    def read_holding_registers(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[int]:
        """Read holding registers as ints 0…65535, the first at ``address`` (MODBUS Application Protocol V1.1b3 §6.3).

        If the option ``register_width`` of the link is above 2, they are unsigned ints of so many bytes.

        Args:
            address: first register, 0…65535.
            count: number of registers, 1…125; with a larger ``register_width`` at most 250 bytes in all.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadHoldingRegisters.Reply = self.execute(read_request(self._holding, address, count), **call_options)
        return reply.registers

    def read_input_registers(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[int]:
        """Read input registers as ints 0…65535, the first at ``address`` (MODBUS Application Protocol V1.1b3 §6.4).

        If the option ``register_width`` of the link is above 2, they are unsigned ints of so many bytes.

        Args:
            address: first register, 0…65535.
            count: number of registers, 1…125; with a larger ``register_width`` at most 250 bytes in all.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadInputRegisters.Reply = self.execute(read_request(self._input, address, count), **call_options)
        return reply.registers

    def write_single_coil(self, address: int, value: bool, **call_options: Unpack[CallOptions]) -> None:
        """Write one coil, function 05 (MODBUS Application Protocol V1.1b3 §6.5).

        Args:
            address: the coil, 0…65535.
            value: True (or 1) for on, False (or 0) for off; anything else is `InvalidRequest`, and nothing is sent.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(WriteSingleCoil.of(address, value), **call_options)

    def write_single_register(self, address: int, value: int, **call_options: Unpack[CallOptions]) -> None:
        """Write one holding register, function 06 (MODBUS Application Protocol V1.1b3 §6.6).

        Args:
            address: the register, 0…65535.
            value: 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(WriteSingleRegister(address, value), **call_options)

    def write_multiple_coils(self, address: int, values: Iterable[bool], **call_options: Unpack[CallOptions]) -> None:
        """Write coils, function 15 (MODBUS Application Protocol V1.1b3 §6.11).

        Args:
            address: first coil, 0…65535.
            values: 1…1968 bools (or 0 and 1); anything else is `InvalidRequest`, and nothing is sent.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(WriteMultipleCoils.of(address, values), **call_options)

    def write_multiple_registers(
        self, address: int, values: Iterable[int], **call_options: Unpack[CallOptions]
    ) -> None:
        """Write holding registers, function 16 (MODBUS Application Protocol V1.1b3 §6.12).

        Args:
            address: first register, 0…65535.
            values: 1…123 numbers 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(WriteMultipleRegisters.of(address, values), **call_options)

    def mask_write_register(
        self, address: int, *, and_mask: int, or_mask: int, **call_options: Unpack[CallOptions]
    ) -> None:
        """Set a register to (current AND and_mask) OR (or_mask AND NOT and_mask), function 22 (§6.16).

        Args:
            address: the register, 0…65535.
            and_mask: bits to keep, 0…65535.
            or_mask: values of the other bits, 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(MaskWriteRegister(address, and_mask, or_mask), **call_options)

    def read_write_multiple_registers(
        self,
        read_address: int,
        *,
        count: int,
        write_address: int,
        values: Iterable[int],
        **call_options: Unpack[CallOptions],
    ) -> list[int]:
        """Write holding registers and then read holding registers, in one request, function 23 (§6.17).

        Returns the registers read, as ints 0…65535.

        Args:
            read_address: first register to read, 0…65535.
            count: number of registers to read, 1…125.
            write_address: first register to write, 0…65535.
            values: 1…121 numbers 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        reply: ReadWriteMultipleRegisters.Reply = self.execute(
            ReadWriteMultipleRegisters.of(read_address, count, write_address, values), **call_options
        )
        return reply.registers

    def read_fifo_queue(self, address: int, **call_options: Unpack[CallOptions]) -> list[int]:
        """Read up to 31 registers of a FIFO queue, the oldest first; they stay in the queue, function 24 (§6.18).

        Args:
            address: address of the queue's pointer register, 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadFifoQueue.Reply = self.execute(ReadFifoQueue(address), **call_options)
        return reply.registers

    def read_file_record(self, file: int, record: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[int]:
        """Read consecutive registers of a file as ints 0…65535, function 20 with one group (§6.14).

        Args:
            file: file number, 1…65535.
            record: number of the first record (register), 0…9999.
            count: number of registers, 1…124.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply: ReadFileRecord.Reply = self.execute(
            ReadFileRecord.of((FileReference(file, record, count),)), **call_options
        )
        return reply.contents[0].registers

    def write_file_record(
        self, file: int, record: int, values: Iterable[int], **call_options: Unpack[CallOptions]
    ) -> None:
        """Write consecutive registers of a file, function 21 with one group (§6.15).

        Args:
            file: file number, 1…65535.
            record: number of the first record (register), 0…9999.
            values: 1…122 numbers 0…65535.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).

        Raises:
            WriteOutcomeUnknown: the request was sent, and no valid answer came: it may have been executed or not.
                Other errors: those that every method raises (`BlockingUnit`).
        """
        self.execute(WriteFileRecord.of(file, record, values), **call_options)

    def read_exception_status(self, **call_options: Unpack[CallOptions]) -> int:
        """Read eight status bits, whose meaning the device defines, as a number 0…255, function 07 (§6.7)."""
        reply: ReadExceptionStatus.Reply = self.execute(ReadExceptionStatus(), **call_options)
        return reply.status

    def diagnostics(self, sub_function: int, data: bytes = b"\x00\x00", **call_options: Unpack[CallOptions]) -> bytes:
        """Send function 08 with a sub-function and return the data of the reply (§6.8).

        Args:
            sub_function: 0…65535; the standard ones are in `DiagnosticCode`.
            data: two bytes, of which the standard sub-functions accept only some values; for sub-function 00 any even
                number of bytes, 2…250; for one that is not standard any bytes, 0…250. Else `InvalidRequest`.
            call_options: ``timeout``, ``retries``, ``deadline``, ``idempotent`` of this call (`CallOptions`).
        """
        reply = self.execute(diagnostic_request(sub_function, data), **call_options)
        return diagnostic_data(reply)

    def get_comm_event_counter(self, **call_options: Unpack[CallOptions]) -> GetCommEventCounter.Reply:
        """Read the status word and the counter of successful messages, function 11 (§6.9).

        They are ``status`` (0xFFFF while the device is busy with a command, else 0) and ``event_count``, 0…65535.
        """
        reply: GetCommEventCounter.Reply = self.execute(GetCommEventCounter(), **call_options)
        return reply

    def get_comm_event_log(self, **call_options: Unpack[CallOptions]) -> GetCommEventLog.Reply:
        """Read status word, event and message counts and up to 64 event bytes, function 12 (§6.10).

        They are ``status``, ``event_count``, ``message_count`` and ``events``, the newest event first.
        """
        reply: GetCommEventLog.Reply = self.execute(GetCommEventLog(), **call_options)
        return reply

    def report_server_id(self, **call_options: Unpack[CallOptions]) -> bytes:
        """Read the device's description of itself as bytes, function 17 (§6.13); each device defines its layout.

        `ServerId.of` parses the bytes.
        """
        reply: ReportServerId.Reply = self.execute(ReportServerId(), **call_options)
        return reply.data

    def _perform(self, operation: Operation, call_options: CallOptions) -> Any:
        """Run a generator of `busway.client.operations`, and return its result.

        The requests that the generator yields are sent; the list of their replies is passed back into the generator.
        """
        try:
            requests = next(operation)
            while True:
                requests = operation.send(self.execute_many(requests, **call_options))
        except StopIteration as stop:
            return stop.value


class BlockingLink:
    """A link to an endpoint for blocking programs, returned by `busway.connect`; a context manager and thread-safe.

    The link connects at the first request, and reconnects at the next request after a lost connection. By default all
    links of a process to one endpoint share one connection (Messaging on TCP/IP V1.0b §4.2.1).
    """

    def __init__(
        self, settings: LinkSettings, link: BlockingLinkDriver | None, rule: LinkSelection | None = None
    ) -> None:
        self._settings = settings
        self._link = link
        self._rule = rule
        self._closed = False

    def _bound(self) -> BlockingLinkDriver:
        """Return the driver for the next request: this link's own, or the one that the option ``select`` chooses.

        Raises:
            LinkClosed: the program has closed this link.
            LinkDown: with ``select``, no other link to the endpoint is open.
        """
        if self._closed:
            raise closed_error(self._settings)
        if self._link is not None:
            return self._link
        return BLOCKING_POOL.choose(self._settings, self._rule or LinkSelection.FIRST)

    def _looked_at(self) -> BlockingLinkDriver | None:
        """Return the driver whose status this link shows: its own, even after `close`.

        A link opened with ``select`` shows the driver that the next request would use; None if there is none, or after
        `close`.
        """
        try:
            return self._link or self._bound()
        except ModbusError:
            return None

    def __repr__(self) -> str:
        return f"<Link {self._settings.endpoint.url} {'closed' if self._closed else SHOWN_STATE[self.state]}>"

    @property
    def endpoint(self) -> Endpoint:
        """The parsed URL that this link connects to."""
        return self._settings.endpoint

    @property
    def register_width(self) -> int:
        """Bytes of one register in replies: the option ``register_width``, which is 2 for standard devices."""
        return self._settings.parameters.register_width

    @property
    def is_connected(self) -> bool:
        """Whether the link has an open connection now."""
        link = self._looked_at()
        return link is not None and link.is_connected

    @property
    def state(self) -> str:
        """State of the connection: ``down``, ``connecting``, ``up``, ``suspect`` or ``backing off``.

        ``suspect`` is an open connection after a timeout, ``backing off`` a pause before an attempt to connect.
        """
        link = self._looked_at()
        return ConnectionState.DOWN.value if link is None else link.reconnect.state.value

    @property
    def counters(self) -> ClientCounters:
        """Counters of requests, replies and errors so far, of all users that share the connection.

        Before the first use, and with ``select`` while no other link is open, they are new counters that are all 0.
        """
        link = self._looked_at()
        return ClientCounters() if link is None else link.session.counters

    def unit(self, number: int | None = None) -> BlockingUnit:
        """Return an object whose methods send requests to one unit behind this link. Nothing is sent yet.

        Args:
            number: unit identifier. With Modbus TCP framing 0…255; None is 255, the device itself. With RTU or ASCII
                framing, 0…247, and required; 0 is the broadcast, for writes only (Serial Line V1.02 §2.2).

        Raises:
            InvalidRequest: the number is out of range, or missing with RTU or ASCII framing.
        """
        return BlockingUnit(self, default_unit(self._settings.endpoint, number), is_assumed=number is None)

    def connect(self) -> None:
        """Connect now, instead of at the first request. Does nothing if the link is connected.

        Raises:
            LinkDown: the attempt failed, or a pause after a failed attempt is not over; `LinkClosed` after `close`.
        """
        self._bound().connect()

    def disconnect(self) -> None:
        """Close the connection, for all links that share it; the next request opens another one.

        Use it if a connection is open but useless, such as one to a gateway that answers nothing. Requests in flight
        are treated as after a lost connection: reads are repeated as ``retries`` says, writes fail with
        `WriteOutcomeUnknown` unless ``write_retries`` lets them be repeated. Without a connection nothing happens.

        Raises:
            LinkClosed: the program has closed this link.
            InvalidRequest: the link was opened with ``select``, and has no connection of its own.
        """
        if self._rule is not None:
            raise no_connection_of_its_own(self._settings)
        self._bound().disconnect()

    def on_state(self, callback: OnState) -> Callable[[], None]:
        """Register a callback for changes of `state`. Returns a function that removes it.

        Args:
            callback: called with the new state and the reason in words, which may be empty, as soon as the change is
                noticed: in the thread that uses the link, or on the event loop. It must return at once and must not use
                the link. An error that it raises is logged.

        Raises:
            LinkClosed: the program has closed this link.
            InvalidRequest: the link was opened with ``select``, and has no connection of its own.
        """
        if self._rule is not None:
            raise no_connection_of_its_own(self._settings)
        return self._bound().on_state(callback)

    def close(self) -> None:
        """Close this link, and its connection if no other link uses that; no call can be made on this link any more.

        If the connection is closed, unfinished calls fail with `LinkDown`, and writes that were sent and not answered
        with `WriteOutcomeUnknown`. Otherwise they go on.
        """
        if not self._closed:
            self._closed = True
            if self._link is not None:
                BLOCKING_POOL.release(self._settings, self._link)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def run(self, unit: int, requests: Sequence[Request], call_options: CallOptions) -> list[Any]:
        """Send requests to a unit and return a list with a reply or a `ModbusError` for each, in order.

        All methods of a unit that send requests do so in this way. Each reply is a message, and each error is in the
        list. An error is raised only if nothing was sent for any of the requests: `LinkDown`, `Overloaded`,
        `UnitSuspended` or `InvalidRequest`.
        """
        link = self._link
        if link is None or self._closed:
            link = self._bound()
        call = call_for(
            unit,
            requests,
            self._settings.parameters,
            call_options,
            caller=threading.get_ident(),
            now=link.now(),
        )
        link.run(call)
        return call.outcomes


def connect(
    url: str | Endpoint,
    *,
    shared: bool = True,
    select: Literal["first", "oldest"] | LinkSelection | None = None,
    ssl_context: "ssl.SSLContext | None" = None,
    **options: "Unpack[LinkOptions]",
) -> BlockingLink:
    """Open a link for blocking programs: ``with busway.connect("tcp://10.0.0.5") as link: …``.

    Nothing is sent, and no connection made, before the first request or `BlockingLink.connect`.

    Args:
        url: the endpoint; the query after ``?`` may set the options below.
        shared: use one connection for all links of this process to the endpoint; False gives this link its own
            connection (explicit connection management), at most ``max_connections`` for one endpoint.
        select: open no connection, but send each request on a connection that another link has open to the endpoint:
            ``first``: that of the link created first; ``oldest``: the one open longest (Messaging on TCP/IP V1.0b
            §4.2.1.2). That connection has its settings already, so only ``timeout``, ``retries``, ``deadline`` and
            ``register_width`` may be given as well. Links, but none connected: the first one connects. None: the link
            has its own or a shared connection.
        ssl_context: for ``tls://``, the program's own context, such as ``ssl.create_default_context()`` for the
            authorities that the system trusts. It decides what is verified, which certificate the client sends, and
            the versions and ciphers of TLS; only the TLS options ``server_name`` and ``handshake_timeout`` may be given
            as well. None: the context is created from the TLS options.
        options: by name, such as ``timeout=2.0, retries=0``: fields of `ClientParameters` and `BreakerParameters`; over
            a network, also of `SocketParameters` and `ManagementParameters`; for ``tls://``, of `TlsParameters`; with
            RTU or ASCII framing, of `SerialClientParameters` and `FramingParameters`; for a serial port, of
            `SerialSettings` and `OpeningParameters`; and ``preset``. An option that has no effect for the scheme raises
            `ConfigError`. Where the URL gives the same option, the keyword counts.

    Raises:
        ConfigError: the URL or an option is invalid, the endpoint is open already with other connection settings, the
            serial port is in use in this process, or a file for TLS cannot be used.
        Overloaded: the endpoint already has ``max_connections`` links with ``shared=False``. Nothing was sent.
        LinkDown: at a use, with ``select``: no other link to the endpoint is open. Nothing was sent.
    """
    settings = link_settings(url, options, ssl_context)
    rule = selection(select)
    if rule is not None:
        check_selected(settings, options, shared=shared)
        return BlockingLink(settings, None, rule)
    return BlockingLink(settings, BLOCKING_POOL.acquire(settings, shared=shared))
