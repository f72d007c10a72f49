"""The backend of modbus-connection, for Home Assistant's integrations, over asyncio links of busway. Needs Python 3.12.

Knows the classes, parameters and errors of modbus-connection 4; knows no frames and no connection.

1. A `ModbusConnection` has a link of its own. modbus-connection decides when to connect and disconnect, the spacing of
   requests and the timeout. With the preset ``passive`` the link repeats no request and recycles no connection.
2. Every error of busway becomes one of modbus-connection, or a ``ValueError``; its text names the operation.
3. A late reply is never given to another request. So `ModbusDesyncError` is never raised; a timeout is
   `ModbusTimeoutError`.
"""

import asyncio
import functools
import ssl
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from typing import Any, Concatenate, Final, ParamSpec, TypeAlias, TypeVar
from urllib.parse import quote

from ..extras import require

require("modbus_connection", "the backend of modbus-connection (Python 3.12 or newer)")

from modbus_connection._client import (
    BaseModbusConnection,
    ModbusSerialParams,
    ModbusTcpParams,
    ModbusTlsParams,
    ModbusUdpParams,
)
from modbus_connection.exceptions import (
    ClientClosedError,
    ModbusConnectionError,
    ModbusError,
    ModbusExceptionError,
    ModbusProtocolError,
    ModbusTimeoutError,
    _describe,
)

from ..client.aio import AsyncLink, AsyncUnit, open_link
from ..client.settings import options_of
from ..errors import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkClosed,
    LinkDown,
    NoReply,
    WriteOutcomeUnknown,
)
from ..errors import ModbusError as BuswayError
from ..options.endpoints import parse_endpoint
from ..options.presets import Preset
from ..pdu.server_id import ServerId
from ..session.reconnect import ConnectionState

__all__ = [
    "SUPPORTED_FRAMINGS",
    "BuswayConnection",
    "BuswayUnit",
    "ModbusConnection",
    "connect_serial",
    "connect_tcp",
    "connect_tls",
    "connect_udp",
]

SUPPORTED_FRAMINGS: Final[Mapping[str, tuple[str, ...]]] = {
    "tcp": ("socket", "rtu", "ascii"),
    "udp": ("socket", "rtu", "ascii"),
    "tls": ("socket",),
    "serial": ("rtu", "ascii"),
}
"""The framings that this backend can speak on each transport, by modbus-connection's names."""
LEAST_TIMEOUT, LONGEST_TIMEOUT = 0.001, 3600.0
"""Shortest and longest timeout of a request, in seconds; a timeout outside is replaced by the nearer of the two."""
LEAST_CONNECT_TIMEOUT, LONGEST_CONNECT_TIMEOUT = 0.01, 600.0
"""Shortest and longest timeout of an attempt to connect, in seconds; a timeout outside is replaced likewise."""
_PARITY: Final = {"N": "none", "E": "even", "O": "odd"}
_FRAMING_SCHEME: Final = {"socket": "", "rtu": "rtu+", "ascii": "ascii+"}
Params: TypeAlias = "ModbusTcpParams | ModbusUdpParams | ModbusTlsParams | ModbusSerialParams"
P = ParamSpec("P")
R = TypeVar("R")


class ModbusConnection(BaseModbusConnection):
    """The class ``ModbusConnection`` of modbus-connection, implemented with a link of busway.

    Creating it opens nothing.

    Args:
        params: where to connect: one of the parameter classes of modbus-connection.
        timeout, message_spacing, connect_delay: seconds to wait for a reply, between two requests, and after
            connecting, as modbus-connection defines them; None for its defaults.

    Raises:
        ConfigError: busway cannot make such a connection, for example because RTU needs 8 data bits; it is a
            ``ValueError``. Nothing was opened.
    """

    def __init__(
        self,
        params: Params,
        *,
        timeout: float | None = None,
        message_spacing: float | None = None,
        connect_delay: float | None = None,
    ) -> None:
        super().__init__(params, timeout=timeout, message_spacing=message_spacing, connect_delay=connect_delay)
        self._link: AsyncLink = self._new_link()
        self._is_ready = False
        self._client: AsyncLink | None = None

    def for_unit(self, unit_id: int) -> "BuswayUnit":
        """Return the object that reads and writes the unit ``unit_id``. Nothing is sent.

        ``unit_id`` is 0…255, over serial framing 0…247.

        Raises:
            InvalidRequest: there cannot be such a unit on this connection; it is a ``ValueError``.
        """
        return BuswayUnit(self, unit_id)

    def _new_link(self, context: ssl.SSLContext | None = None) -> AsyncLink:
        url, options = _endpoint_of(self._params)
        if "connect_timeout" in options_of(parse_endpoint(url)):
            options["connect_timeout"] = min(max(self._timeout, LEAST_CONNECT_TIMEOUT), LONGEST_CONNECT_TIMEOUT)
        chosen: Any = {"preset": Preset.PASSIVE, **options}  # their names were looked up, their values are checked
        return open_link(url, shared=False, ssl_context=context, **chosen)

    def _call_timeout(self) -> float:
        wanted: float = self._timeout
        return min(max(wanted, LEAST_TIMEOUT), LONGEST_TIMEOUT)

    async def _connect_client(self) -> AsyncLink:
        try:
            if not self._is_ready:
                if isinstance(self._params, ModbusTlsParams):
                    self._link = self._new_link(await self._params.create_ssl_context())
                self._link.on_state(self._on_state)
                self._is_ready = True
            driver = self._link._bound()
            # A link that has just failed refuses to connect during a pause of milliseconds, which no event ends. Timers
            # of uvloop are rounded and may end too early.
            while pause := driver.next_attempt:  # noqa: ASYNC110
                await asyncio.sleep(pause)
            await self._link.connect()
        except LinkDown as error:
            serial = isinstance(self._params, ModbusSerialParams)
            where = f"open serial port {self._target}" if serial else f"connect to {self._target}"
            kind = ModbusTimeoutError if error.kind == "timeout" else ModbusConnectionError
            raise kind(f"could not {where}: {error}") from error
        except BuswayError as error:
            raise ModbusConnectionError(str(error)) from error
        return self._link

    async def _close_client(self, client: AsyncLink) -> None:
        try:
            await client.disconnect()
        except BuswayError as error:
            raise ModbusConnectionError(str(error)) from error

    async def close(self) -> None:
        """Close the connection permanently: it cannot be opened again."""
        await super().close()
        await self._link.close()

    def _on_state(self, state: str, reason: str) -> None:
        if state in (ConnectionState.DOWN.value, ConnectionState.BACKING_OFF.value):
            self._on_connection_lost(None)

    def _on_connection_lost(self, exc: Exception | None) -> None:
        # Our own teardown takes the client away before the link goes down.
        if self._closed or self._client is None:
            return
        self._client = None
        self._lost_callbacks.fire()


BuswayConnection = ModbusConnection


def _endpoint_of(params: Params) -> tuple[str, dict[str, object]]:
    """Return the URL and the options, by name, of a link for parameters of modbus-connection."""
    if isinstance(params, ModbusSerialParams):
        if params.device.startswith("socket://"):
            return f"{params.framer}+tcp://{_checked(params.device.removeprefix('socket://'))}", {}
        return f"{params.framer}://{quote(params.device, safe='/:')}", {
            "baud": params.baudrate,
            "data_bits": params.bytesize,
            "parity": _PARITY[params.parity],
            "stop_bits": params.stopbits,
        }
    host = _checked(f"[{params.host}]" if ":" in params.host else params.host)
    if isinstance(params, ModbusTlsParams):
        return f"tls://{host}:{params.port}", {}
    carrier = "tcp" if isinstance(params, ModbusTcpParams) else "udp"
    return f"{_FRAMING_SCHEME[params.framer or 'socket']}{carrier}://{host}:{params.port}", {}


def _checked(host: str) -> str:
    """Return a host, with or without a port. Raises `ConfigError` if it would bring another part of a URL with it."""
    if any(one in "/?#@" or one.isspace() for one in host):
        raise ConfigError(f"{host!r} is no host name or address", key="host")
    return host


def _translated(error: BaseException, prefix: str) -> ModbusError:
    """Return the error of modbus-connection for an error of busway; its text begins with ``prefix``, the operation.

    A write of unknown outcome becomes what its cause becomes; a timeout if it has no cause.
    """
    message = f"{prefix}: {error}"
    match error:
        case WriteOutcomeUnknown() if error.__cause__ is not None:
            return _translated(error.__cause__, f"{prefix}: {error}")
        case LinkClosed():
            return ClientClosedError(message)
        case LinkDown():
            return ModbusConnectionError(message)
        case NoReply() | WriteOutcomeUnknown():
            return ModbusTimeoutError(message)
        case ExceptionReply():
            found: ModbusError = ModbusExceptionError.from_code(int(error.code), message)
            return found
        case BadReply():
            return ModbusProtocolError(message)
        case _:
            return ModbusError(message)


def _operation(
    function: "Callable[Concatenate[BuswayUnit, P], Awaitable[R]]",
) -> "Callable[Concatenate[BuswayUnit, P], Coroutine[Any, Any, R]]":
    """Decorator of a method of a unit: it connects first, keeps the spacing of requests, and translates errors."""

    @functools.wraps(function)
    async def operation(self: "BuswayUnit", /, *args: P.args, **kwargs: P.kwargs) -> R:
        connection = self._connection
        await connection.connect()
        prefix = _describe(function.__name__, args, kwargs)
        try:
            async with connection._pacer.paced(self._unit_id):
                await connection.connect()  # the link may have been dropped while this request waited its turn
                return await function(self, *args, **kwargs)
        except ModbusError as error:
            error.args = (f"{prefix}: {error}",)
            raise
        except InvalidRequest as error:
            raise ValueError(f"{prefix}: {error}") from error
        except BuswayError as error:
            raise _translated(error, prefix) from error

    return operation


class BuswayUnit:
    """One unit of a connection, with the operations of modbus-connection.

    Each operation that reads or writes connects first if necessary. Addresses are 0-based; values of registers are
    0…65535. An operation raises an error of modbus-connection, or ``ValueError`` if an argument is out of its range;
    then nothing was sent.

    Args:
        connection: the connection.
        unit_id: unit identifier, 0…255, over serial framing 0…247.

    Raises:
        InvalidRequest: there cannot be such a unit on this connection.
    """

    def __init__(self, connection: ModbusConnection, unit_id: int) -> None:
        if unit_id is None:
            raise InvalidRequest("the unit is missing: it is a number from 0 to 255")
        self._connection = connection
        self._unit_id = unit_id
        connection._link.unit(unit_id)  # one that cannot be is an error now

    @property
    def _unit(self) -> AsyncUnit:
        return self._connection._link.unit(self._unit_id)

    @property
    def _timeout(self) -> float:
        return self._connection._call_timeout()

    @property
    def connected(self) -> bool:
        """Whether the connection is open now."""
        return bool(self._connection.connected)

    def set_message_spacing(self, seconds: float) -> None:
        """Set the pause in seconds before and after each request to this unit, in which no other request is sent."""
        self._connection._pacer.set_unit_spacing(self._unit_id, seconds)

    def require_timeout(self, seconds: float | None) -> None:
        """Ask for a timeout of at least ``seconds`` on the connection; None cancels what this unit asked for before."""
        self._connection._require_timeout(self._unit_id, seconds)

    def require_connect_delay(self, seconds: float | None) -> None:
        """Ask for a pause of at least ``seconds`` after connecting; None cancels what this unit asked for before."""
        self._connection._require_connect_delay(self._unit_id, seconds)

    @_operation
    async def read_holding_registers(self, address: int, count: int) -> list[int]:
        """Return the values of ``count`` holding registers from ``address`` on, function 03."""
        return await self._unit.read_holding_registers(address, count=count, timeout=self._timeout)

    @_operation
    async def read_input_registers(self, address: int, count: int) -> list[int]:
        """Return the values of ``count`` input registers from ``address`` on, function 04."""
        return await self._unit.read_input_registers(address, count=count, timeout=self._timeout)

    @_operation
    async def write_register(self, address: int, value: int) -> None:
        """Write one holding register, function 06."""
        await self._unit.write_single_register(address, value, timeout=self._timeout)

    @_operation
    async def write_registers(self, address: int, values: list[int]) -> None:
        """Write holding registers from ``address`` on, function 16."""
        await self._unit.write_multiple_registers(address, values, timeout=self._timeout)

    @_operation
    async def read_coils(self, address: int, count: int) -> list[bool]:
        """Return the states of ``count`` coils from ``address`` on, function 01."""
        return await self._unit.read_coils(address, count=count, timeout=self._timeout)

    @_operation
    async def read_discrete_inputs(self, address: int, count: int) -> list[bool]:
        """Return the states of ``count`` discrete inputs from ``address`` on, function 02."""
        return await self._unit.read_discrete_inputs(address, count=count, timeout=self._timeout)

    @_operation
    async def write_coil(self, address: int, value: bool) -> None:
        """Write one coil, function 05."""
        await self._unit.write_single_coil(address, value, timeout=self._timeout)

    @_operation
    async def write_coils(self, address: int, values: list[bool]) -> None:
        """Write coils from ``address`` on, function 15."""
        await self._unit.write_multiple_coils(address, values, timeout=self._timeout)

    @_operation
    async def read_exception_status(self) -> int:
        """Return eight status bits of the device, 0…255, function 07."""
        return await self._unit.read_exception_status(timeout=self._timeout)

    @_operation
    async def report_server_id(self) -> bytes:
        """Return the server identifier of a device, function 17: the bytes before the run indicator (00 or FF).

        All bytes of the reply are returned if there is no run indicator.
        """
        return ServerId.of(await self._unit.report_server_id(timeout=self._timeout)).identification

    @_operation
    async def mask_write_register(self, address: int, and_mask: int, or_mask: int) -> None:
        """Change bits of a holding register, function 22.

        Its new value is (old AND ``and_mask``) OR (``or_mask`` AND NOT ``and_mask``).
        """
        await self._unit.mask_write_register(address, and_mask=and_mask, or_mask=or_mask, timeout=self._timeout)

    @_operation
    async def read_write_registers(
        self, read_address: int, read_count: int, write_address: int, write_values: list[int]
    ) -> list[int]:
        """Write holding registers, then read others or the same, and return the values read, function 23.

        ``write_values`` are written from ``write_address`` on; ``read_count`` registers are read from ``read_address``.
        """
        return await self._unit.read_write_multiple_registers(
            read_address, count=read_count, write_address=write_address, values=write_values, timeout=self._timeout
        )

    @_operation
    async def read_fifo_queue(self, address: int) -> list[int]:
        """Return the registers of a FIFO queue, at most 31 and the oldest first, function 24; they stay in the queue.

        ``address`` is that of the queue's pointer register.
        """
        return await self._unit.read_fifo_queue(address, timeout=self._timeout)

    @_operation
    async def read_device_identification(self) -> dict[int, bytes]:
        """Return the basic identification objects (numbers 0, 1, 2) as bytes by object number, function 43/14."""
        return await self._unit.read_device_identification(timeout=self._timeout)

    @_operation
    async def read_file_record(self, file: int, record: int, length: int) -> list[int]:
        """Return the values of ``length`` registers of a file from the record ``record`` on, function 20."""
        return await self._unit.read_file_record(file, record, count=length, timeout=self._timeout)

    @_operation
    async def write_file_record(self, file: int, record: int, values: list[int]) -> None:
        """Write ``values`` to registers of a file from the record ``record`` on, function 21."""
        await self._unit.write_file_record(file, record, values, timeout=self._timeout)

    @_operation
    async def diagnostics(self, sub_function: int, data: int = 0) -> int:
        """Send a sub-function of function 08 with a word of data, 0…65535, and return the word of the reply."""
        if not 0 <= data <= 0xFFFF:
            raise InvalidRequest(f"the data must be 0…65535, not {data}")
        reply = await self._unit.diagnostics(sub_function, data.to_bytes(2, "big"), timeout=self._timeout)
        return int.from_bytes(reply, "big")

    @_operation
    async def get_comm_event_counter(self) -> tuple[bool, int]:
        """Return whether the device is ready (status word 0), and its count of successful messages, function 11."""
        reply = await self._unit.get_comm_event_counter(timeout=self._timeout)
        return reply.status == 0, reply.event_count

    @_operation
    async def get_comm_event_log(self) -> bytes:
        """Return the log of communication events, one byte for each, the newest first, function 12."""
        reply = await self._unit.get_comm_event_log(timeout=self._timeout)
        return bytes(reply.events)

    def on_connection_lost(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Register a function that is called when the connection is lost. Returns a function that unregisters it.

        It is not called if the program itself closes the connection.
        """
        remove: Callable[[], None] = self._connection.on_connection_lost(callback)
        return remove

    async def disconnect(self) -> None:
        """Close the connection, for all units of it; the next request opens a new one."""
        await self._connection.disconnect()


async def _connected(params: Params, pacing: Mapping[str, Any]) -> ModbusConnection:
    connection = ModbusConnection(params, **pacing)
    await connection.connect()
    return connection


async def connect_tcp(host: str, *, port: int = 502, framer: Any = None, **pacing: float | None) -> ModbusConnection:
    """Return an open connection over TCP.

    Args:
        host: name or address of the device.
        port: TCP port.
        framer: ``socket`` (MBAP), ``rtu`` or ``ascii``; None for ``socket``.
        pacing: ``timeout``, ``message_spacing`` and ``connect_delay`` of `ModbusConnection`, in seconds.

    Raises:
        ModbusConnectionError, ModbusTimeoutError: the connection cannot be made.
        ValueError: an argument is invalid. Nothing was opened.
        TypeError: ``pacing`` has another name, or a value that is no number. Nothing was opened.
    """
    return await _connected(ModbusTcpParams(host=host, port=port, framer=framer), pacing)


async def connect_udp(
    host: str, *, port: int = 502, framer: Any = "socket", **pacing: float | None
) -> ModbusConnection:
    """Return an open connection over UDP; arguments and errors are those of `connect_tcp`."""
    return await _connected(ModbusUdpParams(host=host, port=port, framer=framer), pacing)


async def connect_tls(
    host: str,
    *,
    port: int = 802,
    verify: bool | str = True,
    check_hostname: bool = True,
    client_cert: str | None = None,
    client_key: str | None = None,
    client_key_password: str | None = None,
    sslctx: ssl.SSLContext | None = None,
    **pacing: float | None,
) -> ModbusConnection:
    """Return an open connection over TLS (Modbus/TCP Security); ``pacing`` and errors as for `connect_tcp`.

    Args:
        host: name or address of the device.
        port: TCP port.
        verify, check_hostname, client_cert, client_key, client_key_password, sslctx: as `ModbusTlsParams` has them.
        pacing: ``timeout``, ``message_spacing`` and ``connect_delay`` of `ModbusConnection`.
    """
    params = ModbusTlsParams(
        host=host,
        port=port,
        verify=verify,
        check_hostname=check_hostname,
        client_cert=client_cert,
        client_key=client_key,
        client_key_password=client_key_password,
        sslctx=sslctx,
    )
    return await _connected(params, pacing)


async def connect_serial(
    port: str,
    *,
    baudrate: int = 9600,
    bytesize: Any = 8,
    parity: Any = "N",
    stopbits: Any = 1,
    framer: Any = "rtu",
    **pacing: float | None,
) -> ModbusConnection:
    """Return an open connection on a serial port; ``pacing`` and errors as for `connect_tcp`.

    Args:
        port: name of the port, or ``socket://host:port`` of a serial server.
        baudrate: bit/s.
        bytesize: data bits, 7 or 8.
        parity: ``N``, ``E`` or ``O``.
        stopbits: stop bits, 1 or 2.
        framer: ``rtu`` or ``ascii``.
        pacing: ``timeout``, ``message_spacing`` and ``connect_delay`` of `ModbusConnection`.
    """
    params = ModbusSerialParams(
        device=port, baudrate=baudrate, bytesize=bytesize, parity=parity, stopbits=stopbits, framer=framer
    )
    return await _connected(params, pacing)
