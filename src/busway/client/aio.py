"""The asynchronous interface of the client: links and units for asyncio programs.

Knows names, arguments and results; `busway.client.link` does the communication. Names, arguments and docstrings are
those of the blocking interface (`busway.client.blocking`); a test ensures that.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self, SupportsFloat, SupportsIndex, TypeVar, Unpack, overload

from ..errors import LinkDown, ModbusError, NoReply, Overloaded
from ..options.client import ClientParameters, LinkSelection, selection
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
from .blocking import BlockingLink, BlockingUnit
from .connection_choice import check_selected, no_connection_of_its_own
from .link import AsyncLinkDriver
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
from .pool import LinkPool, pool_of_running_loop
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
Method = TypeVar("Method", bound=Callable[..., Any])


def documented_by(other: object) -> Callable[[Method], Method]:
    """Return a decorator that gives an asyncio method the docstring of ``other``, the blocking method of that name."""

    def take(method: Method) -> Method:
        method.__doc__ = other.__doc__
        return method

    return take


class AsyncUnit:
    __doc__ = BlockingUnit.__doc__

    __slots__ = ("_holding", "_input", "_is_assumed", "_link", "_number", "_parameters", "_width")

    def __init__(self, link: "AsyncLink", number: int, is_assumed: bool = False) -> None:
        self._link = link
        self._number = number
        self._is_assumed = is_assumed  # the default: the caller named no unit
        self._parameters = link.parameters
        self._width = link.register_width
        self._holding = wide(ReadHoldingRegisters, self._width)
        self._input = wide(ReadInputRegisters, self._width)

    def __repr__(self) -> str:
        return f"<AsyncUnit {self._number} of {self._link.endpoint.url}>"

    @property
    @documented_by(BlockingUnit.number)
    def number(self) -> int:
        return self._number

    @documented_by(BlockingUnit.execute)
    async def execute(self, request: TypedRequest[Reply], **call_options: Unpack[CallOptions]) -> Reply:
        reply: Reply = await self._ask(request, call_options)
        return reply

    async def _ask(self, request: Any, call_options: CallOptions) -> Any:  # as `execute`, which types them
        """Send one request and return its reply, as `execute` does, with the call options as one mapping.

        Raises the error of the request. If the caller is cancelled, the call is given up. The code of `AsyncLink.run`
        is repeated here, because awaiting that coroutine would cost 0.5 of 7 µs.
        """
        link = self._link._bound()
        now = link.now()
        call = call_for(self._number, (request,), self._parameters, call_options, now)
        future = link.start(call, now)
        try:
            await future
        except asyncio.CancelledError:
            link.give_up(call)
            raise
        outcome = call.outcomes[0]
        if isinstance(outcome, ModbusError):
            self._add_hint(outcome)
            try:
                raise outcome
            finally:
                del outcome, call  # else the error and this frame, which it names, keep each other alive
        assert outcome is not None
        return outcome

    @documented_by(BlockingUnit.execute_many)
    async def execute_many(
        self, requests: Sequence[Request], *, return_errors: bool = False, **call_options: Unpack[CallOptions]
    ) -> list[Any]:
        if not requests:
            return []
        outcomes: list[Any]
        try:
            outcomes = await self._link.run(self._number, requests, call_options)
        except (LinkDown, Overloaded, NoReply) as refusal:
            if not return_errors:
                raise
            outcomes = refused(refusal, requests)
        for error in errors_among(outcomes):
            self._add_hint(error)
            if return_errors:
                continue
            try:
                raise error
            finally:
                del error  # as in `_ask`
                outcomes = []
        return outcomes

    def _add_hint(self, error: ModbusError) -> None:
        """Add a hint to the message of an error that an assumed unit, baud rate or parity may have caused.

        Assumed are those that the user did not give. Other errors stay unchanged.
        """
        if self._is_assumed:
            with_assumed_unit(error, self._number)
        with_assumed_line(error, self._link._settings, self._link.counters)

    @overload
    async def read(
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
    async def read(
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
    async def read(
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
    async def read(
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
    async def read(
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
    async def read(
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
    async def read(
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
    async def read(
        self,
        address: int | str | Address,
        type: str | None = None,
        *,
        order: Order = "ABCD",
        count: int,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> list[Any]: ...

    @documented_by(BlockingUnit.read)
    async def read(
        self,
        address: int | str | Address,
        type: str | ValueType[Any] | None = None,
        *,
        order: Order = "ABCD",
        count: int | None = None,
        split: bool = False,
        **call_options: Unpack[CallOptions],
    ) -> Any:
        return await self._perform(read_values(address, type, order, count, split, self._width), call_options)

    @documented_by(BlockingUnit.read_many)
    async def read_many(
        self, wanted: "Mapping[str, NamedRead]", *, order: Order = "ABCD", **call_options: Unpack[CallOptions]
    ) -> dict[str, Any]:
        from .read_many import read_together

        found: dict[str, Any] = await self._perform(read_together(wanted, order, self._width), call_options)
        return found

    @overload
    async def write(
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
    async def write(
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
    async def write(
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
    async def write(
        self,
        address: int | str | Address,
        value: Any,
        type: str,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None: ...

    @documented_by(BlockingUnit.write)
    async def write(
        self,
        address: int | str | Address,
        value: Any,
        type: str | ValueType[Any] | None = None,
        *,
        order: Order = "ABCD",
        function: WriteFunctionChoice = "auto",
        **call_options: Unpack[CallOptions],
    ) -> None:
        await self._perform(write_values(address, value, type, order, function), call_options)

    @documented_by(BlockingUnit.read_device_identification)
    async def read_device_identification(
        self, level: IdentificationLevel = "basic", *, object_id: int | None = None, **call_options: Unpack[CallOptions]
    ) -> dict[int, bytes]:
        found: dict[int, bytes] = await self._perform(read_identification(level, object_id), call_options)
        return found

    @documented_by(BlockingUnit.read_coils)
    async def read_coils(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[bool]:
        reply: ReadCoils.Reply = await self._ask(read_request(ReadCoils, address, count), call_options)
        return reply.bits(count)

    @documented_by(BlockingUnit.read_discrete_inputs)
    async def read_discrete_inputs(
        self, address: int, *, count: int, **call_options: Unpack[CallOptions]
    ) -> list[bool]:
        reply: ReadDiscreteInputs.Reply = await self._ask(
            read_request(ReadDiscreteInputs, address, count), call_options
        )
        return reply.bits(count)

    @documented_by(BlockingUnit.read_holding_registers)
    async def read_holding_registers(
        self, address: int, *, count: int, **call_options: Unpack[CallOptions]
    ) -> list[int]:
        reply: ReadHoldingRegisters.Reply = await self._ask(read_request(self._holding, address, count), call_options)
        return reply.registers

    @documented_by(BlockingUnit.read_input_registers)
    async def read_input_registers(self, address: int, *, count: int, **call_options: Unpack[CallOptions]) -> list[int]:
        reply: ReadInputRegisters.Reply = await self._ask(read_request(self._input, address, count), call_options)
        return reply.registers

    @documented_by(BlockingUnit.write_single_coil)
    async def write_single_coil(self, address: int, value: bool, **call_options: Unpack[CallOptions]) -> None:
        await self._ask(WriteSingleCoil.of(address, value), call_options)

    @documented_by(BlockingUnit.write_single_register)
    async def write_single_register(self, address: int, value: int, **call_options: Unpack[CallOptions]) -> None:
        await self._ask(WriteSingleRegister(address, value), call_options)

    @documented_by(BlockingUnit.write_multiple_coils)
    async def write_multiple_coils(
        self, address: int, values: Iterable[bool], **call_options: Unpack[CallOptions]
    ) -> None:
        await self._ask(WriteMultipleCoils.of(address, values), call_options)

    @documented_by(BlockingUnit.write_multiple_registers)
    async def write_multiple_registers(
        self, address: int, values: Iterable[int], **call_options: Unpack[CallOptions]
    ) -> None:
        await self._ask(WriteMultipleRegisters.of(address, values), call_options)

    @documented_by(BlockingUnit.mask_write_register)
    async def mask_write_register(
        self, address: int, *, and_mask: int, or_mask: int, **call_options: Unpack[CallOptions]
    ) -> None:
        await self._ask(MaskWriteRegister(address, and_mask, or_mask), call_options)

    @documented_by(BlockingUnit.read_write_multiple_registers)
    async def read_write_multiple_registers(
        self,
        read_address: int,
        *,
        count: int,
        write_address: int,
        values: Iterable[int],
        **call_options: Unpack[CallOptions],
    ) -> list[int]:
        reply: ReadWriteMultipleRegisters.Reply = await self._ask(
            ReadWriteMultipleRegisters.of(read_address, count, write_address, values), call_options
        )
        return reply.registers

    @documented_by(BlockingUnit.read_fifo_queue)
    async def read_fifo_queue(self, address: int, **call_options: Unpack[CallOptions]) -> list[int]:
        reply: ReadFifoQueue.Reply = await self._ask(ReadFifoQueue(address), call_options)
        return reply.registers

    @documented_by(BlockingUnit.read_file_record)
    async def read_file_record(
        self, file: int, record: int, *, count: int, **call_options: Unpack[CallOptions]
    ) -> list[int]:
        reply: ReadFileRecord.Reply = await self._ask(
            ReadFileRecord.of((FileReference(file, record, count),)), call_options
        )
        return reply.contents[0].registers

    @documented_by(BlockingUnit.write_file_record)
    async def write_file_record(
        self, file: int, record: int, values: Iterable[int], **call_options: Unpack[CallOptions]
    ) -> None:
        await self._ask(WriteFileRecord.of(file, record, values), call_options)

    @documented_by(BlockingUnit.read_exception_status)
    async def read_exception_status(self, **call_options: Unpack[CallOptions]) -> int:
        reply: ReadExceptionStatus.Reply = await self._ask(ReadExceptionStatus(), call_options)
        return reply.status

    @documented_by(BlockingUnit.diagnostics)
    async def diagnostics(
        self, sub_function: int, data: bytes = b"\x00\x00", **call_options: Unpack[CallOptions]
    ) -> bytes:
        reply = await self._ask(diagnostic_request(sub_function, data), call_options)
        return diagnostic_data(reply)

    @documented_by(BlockingUnit.get_comm_event_counter)
    async def get_comm_event_counter(self, **call_options: Unpack[CallOptions]) -> GetCommEventCounter.Reply:
        reply: GetCommEventCounter.Reply = await self._ask(GetCommEventCounter(), call_options)
        return reply

    @documented_by(BlockingUnit.get_comm_event_log)
    async def get_comm_event_log(self, **call_options: Unpack[CallOptions]) -> GetCommEventLog.Reply:
        reply: GetCommEventLog.Reply = await self._ask(GetCommEventLog(), call_options)
        return reply

    @documented_by(BlockingUnit.report_server_id)
    async def report_server_id(self, **call_options: Unpack[CallOptions]) -> bytes:
        reply: ReportServerId.Reply = await self._ask(ReportServerId(), call_options)
        return reply.data

    @documented_by(BlockingUnit._perform)
    async def _perform(self, operation: Operation, call_options: CallOptions) -> Any:
        try:
            requests = next(operation)
            while True:
                requests = operation.send(await self.execute_many(requests, **call_options))
        except StopIteration as stop:
            return stop.value


class AsyncLink:
    """A link to an endpoint for asyncio programs, returned by `busway.open`; an asynchronous context manager.

    The link connects at the first request, and reconnects at the next request after a lost connection. By default all
    links of an event loop to one endpoint share one connection (Messaging on TCP/IP V1.0b §4.2.1).
    """

    def __init__(self, settings: LinkSettings, *, shared: bool, rule: LinkSelection | None = None) -> None:
        self._settings = settings
        self.parameters: ClientParameters = settings.parameters
        self._shared = shared
        self._rule = rule
        self._pool: LinkPool | None = None
        self._link: AsyncLinkDriver | None = None
        self._may_send: Callable[[], bool] | None = None
        self._closed = False

    def _bound(self) -> AsyncLinkDriver:
        """Return the driver for the next request: this link's own, or the one that ``select`` chooses.

        At the first use the link gets its driver from the pool of the running event loop.

        Raises:
            LinkClosed: the program has closed this link.
            LinkDown: with ``select``, no other link to the endpoint is open.
            ConfigError, Overloaded: at the first use, as in `LinkPool.acquire`; `ConfigError` also outside a coroutine.
        """
        link = self._link
        if link is not None and not self._closed:
            return link
        if self._closed:
            raise closed_error(self._settings)
        if self._rule is not None:
            return pool_of_running_loop().choose(self._settings, self._rule)
        if self._link is None:
            self._pool = pool_of_running_loop()
            self._link = self._pool.acquire(self._settings, shared=self._shared)
            if self._may_send is not None:
                self._link.send_only_while(self._may_send)
        return self._link

    def _looked_at(self) -> AsyncLinkDriver | None:
        """Return the driver whose status this link shows: its own, which is None before the first use.

        A link opened with ``select`` shows the driver that the next request would use; None if there is none.
        """
        if self._rule is None:
            return self._link
        try:
            return self._bound()
        except ModbusError:
            return None

    def __repr__(self) -> str:
        return f"<AsyncLink {self._settings.endpoint.url} {'closed' if self._closed else SHOWN_STATE[self.state]}>"

    @property
    @documented_by(BlockingLink.endpoint)
    def endpoint(self) -> Endpoint:
        return self._settings.endpoint

    @property
    @documented_by(BlockingLink.register_width)
    def register_width(self) -> int:
        return self._settings.parameters.register_width

    @property
    @documented_by(BlockingLink.is_connected)
    def is_connected(self) -> bool:
        link = self._looked_at()
        return link is not None and link.is_connected

    @property
    @documented_by(BlockingLink.state)
    def state(self) -> str:
        link = self._looked_at()
        return ConnectionState.DOWN.value if link is None else link.reconnect.state.value

    @property
    @documented_by(BlockingLink.counters)
    def counters(self) -> ClientCounters:
        link = self._looked_at()
        return ClientCounters() if link is None else link.session.counters

    @documented_by(BlockingLink.unit)
    def unit(self, number: int | None = None) -> AsyncUnit:
        return AsyncUnit(self, default_unit(self._settings.endpoint, number), is_assumed=number is None)

    @documented_by(BlockingLink.connect)
    async def connect(self) -> None:
        await self._bound().connect()

    @documented_by(BlockingLink.disconnect)
    async def disconnect(self) -> None:
        if self._rule is not None:
            raise no_connection_of_its_own(self._settings)
        await self._bound().disconnect()

    @documented_by(BlockingLink.on_state)
    def on_state(self, callback: OnState) -> Callable[[], None]:
        if self._rule is not None:
            raise no_connection_of_its_own(self._settings)
        return self._bound().on_state(callback)

    @documented_by(BlockingLink.close)
    async def close(self) -> None:
        if not self._closed:
            self._closed = True
            if self._pool is not None and self._link is not None:
                await self._pool.release(self._settings, self._link)

    async def __aenter__(self) -> Self:
        if self._rule is None:
            self._bound()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @documented_by(BlockingLink.run)
    async def run(self, unit: int, requests: Sequence[Request], call_options: CallOptions) -> list[Any]:
        link = self._bound()
        now = link.now()
        call = call_for(unit, requests, self.parameters, call_options, now)
        future = link.start(call, now)
        try:
            await future
        except asyncio.CancelledError:
            link.give_up(call)
            raise
        return call.outcomes


def open_link(
    url: str | Endpoint,
    *,
    shared: bool = True,
    select: Literal["first", "oldest"] | LinkSelection | None = None,
    ssl_context: "ssl.SSLContext | None" = None,
    **options: "Unpack[LinkOptions]",
) -> AsyncLink:
    """Open a link for asyncio programs: ``async with busway.open("tcp://10.0.0.5") as link: …``.

    Nothing is sent, and no connection made, before the first request or `AsyncLink.connect`. The first use, which is
    the beginning of ``async with`` or a request, binds the link to the running event loop.

    Args:
        url: the endpoint; the query after ``?`` may set the options below.
        shared: use one connection for all links of this event loop to the endpoint; False gives this link its own
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
        ConfigError: the URL or an option is invalid. At the first use: the endpoint is open already with other
            connection settings, the serial port is in use in this process, or a file for TLS cannot be used.
        Overloaded: at the first use: the endpoint already has ``max_connections`` links with ``shared=False``. Nothing
            was sent.
        LinkDown: at a use, with ``select``: no other link to the endpoint is open. Nothing was sent.
    """
    settings = link_settings(url, options, ssl_context)
    rule = selection(select)
    if rule is not None:
        check_selected(settings, options, shared=shared)
    return AsyncLink(settings, shared=shared, rule=rule)


def send_only_while(link: AsyncLink, may_send: Callable[[], bool]) -> None:
    """Let a link that is not used yet send only while ``may_send`` returns True (`busway.client.permitted_sending`).

    ``may_send`` is called before each connection and each write of frames. If it returns False, nothing leaves: no
    connection is opened, or the open one is reset, and the call fails with `LinkDown`, a write that was to be sent on
    an open connection with `WriteOutcomeUnknown`. It has no effect on a link that was used before.
    """
    link._may_send = may_send
