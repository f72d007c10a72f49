"""The blocking interface: links and units for plain programs and threads.

Knows names, arguments and results; what happens on the wire is the business of `busway.client.blocking_link`. Names,
arguments and docstrings are those of the asynchronous interface (``aio``); a test holds them together.
"""

import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

from ..config.endpoints import Endpoint
from ..errors import ModbusError
from ..pdu.diagnostics import GetCommEventCounter, GetCommEventLog, ReadExceptionStatus, ReportServerId
from ..pdu.file_records import FileReference, ReadFileRecord, WriteFileRecord
from ..pdu.message import Message, Request
from ..pdu.read_items import (
    ReadCoils,
    ReadDiscreteInputs,
    ReadFifoQueue,
    ReadHoldingRegisters,
    ReadInputRegisters,
)
from ..pdu.write_items import (
    COIL_OFF,
    COIL_ON,
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ..session.client import ClientCounters
from ..values import Address, ValueType
from .aio import AsyncLink, AsyncUnit
from .blocking_link import BlockingLink
from .blocking_pool import BLOCKING_POOL
from .calls import LinkSettings, closed_error, default_unit, demand_for, link_settings
from .operations import (
    CallOptions,
    Operation,
    WriteFunction,
    diagnostic_data,
    diagnostic_request,
    read_identification,
    read_values,
    write_values,
)

Method = TypeVar("Method", bound=Callable[..., Any])


def documented_by(other: object) -> Callable[[Method], Method]:
    """Give a method or property the docstring of its asynchronous twin, so that there is one text for both."""

    def take(method: Method) -> Method:
        method.__doc__ = other.__doc__
        return method

    return take


class Unit:
    __slots__ = ("_link", "_number")

    def __init__(self, link: "Link", number: int) -> None:
        self._link = link
        self._number = number

    @property
    def number(self) -> int:
        """The unit identifier, 0…255."""
        return self._number

    @documented_by(AsyncUnit.execute)
    def execute(self, request: Request, **call: Unpack[CallOptions]) -> Message:
        (outcome,) = self._link.run(self._number, (request,), call)
        if isinstance(outcome, ModbusError):
            raise outcome
        assert isinstance(outcome, Message)
        return outcome

    @documented_by(AsyncUnit.execute_many)
    def execute_many(
        self, requests: Sequence[Request], *, return_errors: bool = False, **call: Unpack[CallOptions]
    ) -> list[Any]:
        if not requests:
            return []
        outcomes = self._link.run(self._number, requests, call)
        if not return_errors:
            for outcome in outcomes:
                if isinstance(outcome, ModbusError):
                    raise outcome
        return outcomes

    @documented_by(AsyncUnit.read)
    def read(
        self,
        address: int | str | Address,
        type: str | ValueType | None = None,
        *,
        order: str = "ABCD",
        count: int | None = None,
        split: bool = False,
        **call: Unpack[CallOptions],
    ) -> Any:
        return self._perform(read_values(address, type, order, count, split), call)

    @documented_by(AsyncUnit.write)
    def write(
        self,
        address: int | str | Address,
        value: Any,
        type: str | ValueType | None = None,
        *,
        order: str = "ABCD",
        function: WriteFunction = "auto",
        **call: Unpack[CallOptions],
    ) -> None:
        self._perform(write_values(address, value, type, order, function), call)

    @documented_by(AsyncUnit.read_device_identification)
    def read_device_identification(
        self, level: str = "basic", *, object_id: int | None = None, **call: Unpack[CallOptions]
    ) -> dict[int, bytes]:
        found: dict[int, bytes] = self._perform(read_identification(level, object_id), call)
        return found

    @documented_by(AsyncUnit.read_coils)
    def read_coils(self, address: int, *, count: int, **call: Unpack[CallOptions]) -> list[bool]:
        reply = self.execute(ReadCoils(address, count), **call)
        assert isinstance(reply, ReadCoils.Reply)
        return reply.bits(count)

    @documented_by(AsyncUnit.read_discrete_inputs)
    def read_discrete_inputs(self, address: int, *, count: int, **call: Unpack[CallOptions]) -> list[bool]:
        reply = self.execute(ReadDiscreteInputs(address, count), **call)
        assert isinstance(reply, ReadDiscreteInputs.Reply)
        return reply.bits(count)

    @documented_by(AsyncUnit.read_holding_registers)
    def read_holding_registers(self, address: int, *, count: int, **call: Unpack[CallOptions]) -> list[int]:
        reply = self.execute(ReadHoldingRegisters(address, count), **call)
        assert isinstance(reply, ReadHoldingRegisters.Reply)
        return reply.registers

    @documented_by(AsyncUnit.read_input_registers)
    def read_input_registers(self, address: int, *, count: int, **call: Unpack[CallOptions]) -> list[int]:
        reply = self.execute(ReadInputRegisters(address, count), **call)
        assert isinstance(reply, ReadInputRegisters.Reply)
        return reply.registers

    @documented_by(AsyncUnit.write_single_coil)
    def write_single_coil(self, address: int, value: bool, **call: Unpack[CallOptions]) -> None:
        self.execute(WriteSingleCoil(address, COIL_ON if value else COIL_OFF), **call)

    @documented_by(AsyncUnit.write_single_register)
    def write_single_register(self, address: int, value: int, **call: Unpack[CallOptions]) -> None:
        self.execute(WriteSingleRegister(address, value), **call)

    @documented_by(AsyncUnit.write_multiple_coils)
    def write_multiple_coils(self, address: int, values: Sequence[bool], **call: Unpack[CallOptions]) -> None:
        self.execute(WriteMultipleCoils.of(address, values), **call)

    @documented_by(AsyncUnit.write_multiple_registers)
    def write_multiple_registers(self, address: int, values: Sequence[int], **call: Unpack[CallOptions]) -> None:
        self.execute(WriteMultipleRegisters.of(address, values), **call)

    @documented_by(AsyncUnit.mask_write_register)
    def mask_write_register(self, address: int, *, and_mask: int, or_mask: int, **call: Unpack[CallOptions]) -> None:
        self.execute(MaskWriteRegister(address, and_mask, or_mask), **call)

    @documented_by(AsyncUnit.read_write_multiple_registers)
    def read_write_multiple_registers(
        self, read_address: int, *, count: int, write_address: int, values: Sequence[int], **call: Unpack[CallOptions]
    ) -> list[int]:
        reply = self.execute(ReadWriteMultipleRegisters.of(read_address, count, write_address, values), **call)
        assert isinstance(reply, ReadWriteMultipleRegisters.Reply)
        return reply.registers

    @documented_by(AsyncUnit.read_fifo_queue)
    def read_fifo_queue(self, address: int, **call: Unpack[CallOptions]) -> list[int]:
        reply = self.execute(ReadFifoQueue(address), **call)
        assert isinstance(reply, ReadFifoQueue.Reply)
        return reply.registers

    @documented_by(AsyncUnit.read_file_record)
    def read_file_record(self, file: int, record: int, *, count: int, **call: Unpack[CallOptions]) -> list[int]:
        reply = self.execute(ReadFileRecord.of((FileReference(file, record, count),)), **call)
        assert isinstance(reply, ReadFileRecord.Reply)
        return reply.contents[0].registers

    @documented_by(AsyncUnit.write_file_record)
    def write_file_record(self, file: int, record: int, values: Sequence[int], **call: Unpack[CallOptions]) -> None:
        self.execute(WriteFileRecord.of(file, record, values), **call)

    @documented_by(AsyncUnit.read_exception_status)
    def read_exception_status(self, **call: Unpack[CallOptions]) -> int:
        reply = self.execute(ReadExceptionStatus(), **call)
        assert isinstance(reply, ReadExceptionStatus.Reply)
        return reply.status

    @documented_by(AsyncUnit.diagnostics)
    def diagnostics(self, sub_function: int, data: bytes = b"\x00\x00", **call: Unpack[CallOptions]) -> bytes:
        reply = self.execute(diagnostic_request(sub_function, data), **call)
        return diagnostic_data(reply)

    @documented_by(AsyncUnit.get_comm_event_counter)
    def get_comm_event_counter(self, **call: Unpack[CallOptions]) -> GetCommEventCounter.Reply:
        reply = self.execute(GetCommEventCounter(), **call)
        assert isinstance(reply, GetCommEventCounter.Reply)
        return reply

    @documented_by(AsyncUnit.get_comm_event_log)
    def get_comm_event_log(self, **call: Unpack[CallOptions]) -> GetCommEventLog.Reply:
        reply = self.execute(GetCommEventLog(), **call)
        assert isinstance(reply, GetCommEventLog.Reply)
        return reply

    @documented_by(AsyncUnit.report_server_id)
    def report_server_id(self, **call: Unpack[CallOptions]) -> bytes:
        reply = self.execute(ReportServerId(), **call)
        assert isinstance(reply, ReportServerId.Reply)
        return reply.data

    def _perform(self, operation: Operation, call: CallOptions) -> Any:
        """Run an operation: send what it asks for, give it the replies, until it has its result."""
        try:
            requests = next(operation)
            while True:
                requests = operation.send(self.execute_many(requests, **call))
        except StopIteration as stop:
            return stop.value


class Link:
    """A link to an endpoint, as `busway.connect` gives it; a context manager, safe to use from many threads.

    It connects at the first need, and again when the connection was lost. By default all links of a process to one
    endpoint share one connection (Messaging on TCP/IP V1.0b §4.2.1).
    """

    def __init__(self, settings: LinkSettings, link: BlockingLink) -> None:
        self._settings = settings
        self._link = link
        self._closed = False

    @property
    @documented_by(AsyncLink.endpoint)
    def endpoint(self) -> Endpoint:
        return self._settings.endpoint

    @property
    @documented_by(AsyncLink.is_connected)
    def is_connected(self) -> bool:
        return self._link.is_connected

    @property
    @documented_by(AsyncLink.state)
    def state(self) -> str:
        return self._link.reconnect.state.value

    @property
    @documented_by(AsyncLink.counters)
    def counters(self) -> ClientCounters:
        return self._link.session.counters

    @documented_by(AsyncLink.unit)
    def unit(self, number: int | None = None) -> Unit:
        return Unit(self, default_unit(self._settings.endpoint, number))

    @documented_by(AsyncLink.connect)
    def connect(self) -> None:
        self._link.connect()

    @documented_by(AsyncLink.close)
    def close(self) -> None:
        if not self._closed:
            self._closed = True
            BLOCKING_POOL.release(self._settings, self._link)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @documented_by(AsyncLink.run)
    def run(self, unit: int, requests: Sequence[Request], call: CallOptions) -> list[Any]:
        if self._closed:
            raise closed_error(self._settings)
        link = self._link
        demand = demand_for(
            unit,
            requests,
            self._settings.parameters,
            call,
            caller=threading.get_ident(),
            now=link.now(),
        )
        link.run(demand)
        return demand.outcomes


Unit.__doc__ = AsyncUnit.__doc__


def connect(url: str | Endpoint, *, shared: bool = True, **options: Any) -> Link:
    """A link for blocking programs: ``with busway.connect("tcp://10.0.0.5") as link: …``.

    Nothing is sent, and no connection made, before the first request.

    Args:
        url: the endpoint; options behind ``?`` are those below.
        shared: use one connection for all links of this process to the endpoint; False gives a connection of its own
            (explicit connection management).
        options: fields of `ClientParameters` and `SocketParameters`, by name: ``timeout=2.0, retries=0``.

    Raises:
        ConfigError: the URL or an option can not be, or the endpoint is open with other settings of the connection.
    """
    settings = link_settings(url, options)
    return Link(settings, BLOCKING_POOL.acquire(settings, shared=shared))
