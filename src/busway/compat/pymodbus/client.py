"""The eight clients of pymodbus: blocking ones use links of `busway.connect`, asyncio ones links of `busway.open`.

Knows where a client connects and how pymodbus reports the outcome; knows no bytes.

1. A client has a connection of its own. ``connect`` opens it; in blocking clients the first request does too.
2. ``retries`` repeat reads alone. A write that may have been executed is repeated only with ``write_retries=``, which
   pymodbus does not have.
3. An exception of the device is a response whose ``isError()`` is True. Without a valid reply `ModbusIOException` is
   raised, without a connection `ConnectionException`.
"""

import asyncio
import logging
import types
from collections.abc import Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Self

from ...client.aio import AsyncLink, open_link
from ...client.blocking import BlockingLink, connect
from ...errors import ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoAnswer
from ...options.endpoints import Endpoint
from .calls import ModbusClientMixin
from .exceptions import ConnectionException, MessageRegisterException, ParameterException, exception_for
from .framer import FramerType, framer_type_of
from .pdu import ExceptionResult, ModbusPDU

_LOG = logging.getLogger(__name__)

IGNORED = frozenset(
    {
        "broadcast_enable",
        "close_comm_on_error",
        "method",
        "name",
        "no_resend_on_retry",
        "on_connect_callback",
        "on_reconnect_callback",
        "reset_socket",
        "retry_on_empty",
        "strict",
        "trace_packet",
    }
)
"""Arguments of some release of pymodbus that have no effect here."""
MOST_CONNECTIONS = 10_000
SHORTEST_PAUSE = 0.001
PREFIX = {FramerType.RTU: "rtu+", FramerType.ASCII: "ascii+"}
SERIAL_SCHEMES = {FramerType.RTU: "rtu", FramerType.ASCII: "ascii"}


@dataclass
class CommParams:
    """Where a client connects and how long it waits; programs read it as ``client.comm_params``.

    Attributes:
        host, port: host and port of the server; for a serial port ``host`` is its name, and ``port`` None.
        timeout_connect: seconds allowed for connecting, and for each reply.
        reconnect_delay: seconds before the first attempt to connect again; at least 0.001. No effect on a serial port.
        reconnect_delay_max: has no effect.
        source_address: (address, port): local address of the connection; the port has no effect. None for any.
        baudrate, parity, bytesize, stopbits: settings of a serial port; None for other clients.
    """

    host: str
    port: int | None
    timeout_connect: float
    reconnect_delay: float = 0.1
    reconnect_delay_max: float = 300.0
    source_address: tuple[str, int] | None = None
    baudrate: int | None = None
    parity: str | None = None
    bytesize: int | None = None
    stopbits: float | None = None

    @property
    def timeout(self) -> float:
        """Seconds allowed for connecting, and for each reply: ``timeout_connect`` by its name in older releases."""
        return self.timeout_connect


class _Client(ModbusClientMixin):
    """Base of blocking and asyncio clients: the endpoint, the options of the link, and the response to each outcome."""

    carrier: ClassVar[str]
    default_port: ClassVar[int | None] = 502
    default_framer: ClassVar[FramerType] = FramerType.SOCKET

    def __init__(
        self,
        host: str,
        port: int | None = None,
        framer: object = None,
        *,
        timeout: float = 3,
        retries: int = 3,
        write_retries: int = 0,
        source_address: tuple[str, int] | None = None,
        reconnect_delay: float = 0.1,
        reconnect_delay_max: float = 300.0,
        trace_pdu: Callable[[bool, ModbusPDU], ModbusPDU] | None = None,
        trace_connect: Callable[[bool], None] | None = None,
        **older: Any,  # arguments of other releases, and the settings of a serial line or of TLS
    ) -> None:
        framing = framer_type_of(self.default_framer if framer is None else framer)
        port = self.default_port if port is None else int(port)
        self.comm_params: CommParams = CommParams(
            host, port, timeout, reconnect_delay, reconnect_delay_max, source_address
        )
        self.params: CommParams = self.comm_params
        self.retries: int = retries
        self._trace_pdu = trace_pdu
        self._trace_connect = trace_connect
        self._own_responses: dict[int, type[ModbusPDU]] = {}
        self._options: dict[str, Any] = {
            "timeout": float(timeout),
            "retries": int(retries),
            "write_retries": int(write_retries),
            **self._carrier_options(older),
        }
        self._endpoint = self._endpoint_of(host, port, framing)
        if self._endpoint.framing != "mbap":
            self._options["open_after"] = 0
        if self._endpoint.carrier != "serial":
            self._options["max_connections"] = MOST_CONNECTIONS
            self._options["reconnect_first"] = max(float(reconnect_delay), SHORTEST_PAUSE)
        if self._endpoint.carrier in ("tcp", "tls"):
            self._options["connect_timeout"] = float(timeout)
        if source_address is not None and source_address[0]:
            self._options["local_address"] = source_address[0]
        if older.get("trace_packet") is not None:
            _LOG.warning("trace_packet is not called; the log of busway.TRACE has the bytes")
        for name in older:
            if name not in IGNORED:
                raise TypeError(f"{type(self).__name__}() got an unexpected keyword argument {name!r}")

    def _carrier_options(self, older: dict[str, Any]) -> dict[str, Any]:
        """Remove the settings of a serial port or of TLS from ``older``, and return them as options of a link.

        ``older`` are the keyword arguments of the client, by the names of older releases too.
        """
        return {}

    def _endpoint_of(self, host: str, port: int | None, framing: FramerType) -> Endpoint:
        return Endpoint(f"{PREFIX.get(framing, '')}{self.carrier}", host=host.strip("[]"), port=port)

    def __str__(self) -> str:
        return f"{type(self).__name__} {self.comm_params.host}:{self.comm_params.port}"

    def register(self, custom_response_class: type[ModbusPDU]) -> None:
        """Register a response class of the program for its ``function_code``.

        The reply to a request of the program's own class with that code becomes an object of this class. Requests of
        standard functions keep their response classes.

        Raises:
            MessageRegisterException: it is no subclass of `ModbusPDU`.
        """
        if not (isinstance(custom_response_class, type) and issubclass(custom_response_class, ModbusPDU)):
            raise MessageRegisterException(f"{custom_response_class!r} is no subclass of ModbusPDU")
        self._own_responses[custom_response_class.function_code] = custom_response_class

    def set_max_no_responses(self, max_count: int) -> None:
        """Do nothing: a link's option ``recycle_after_timeouts`` decides when a silent connection is closed."""

    def _traced(self, sending: bool, pdu: ModbusPDU) -> ModbusPDU:
        return pdu if self._trace_pdu is None else self._trace_pdu(sending, pdu)

    def _told(self, is_connected: bool) -> bool:
        if self._trace_connect is not None:
            self._trace_connect(is_connected)
        return is_connected

    def _response(self, request: ModbusPDU, reply: Any) -> ModbusPDU:
        response = request.response(reply, self._own_responses)
        return self._traced(False, response)

    def _failed(self, request: ModbusPDU, error: ModbusError, silent: bool) -> ModbusPDU | None:
        """Return an exception response if the device answered with an exception, or None; raise any other error.

        None if no valid reply came and ``silent`` is True; that is the argument ``no_response_expected`` of
        ``execute``. The exception of pymodbus for the error is raised; `InvalidRequest` and `ConfigError` are raised
        unchanged.
        """
        if isinstance(error.__cause__, ExceptionReply):  # 0B of a gateway to a write
            error = error.__cause__
        if isinstance(error, ExceptionReply):
            return self._traced(False, ExceptionResult(request.function_code, error.code, request.dev_id))
        if isinstance(error, InvalidRequest | ConfigError):
            raise error
        if silent and isinstance(error, NoAnswer):
            return None
        raise exception_for(error) from error


def _request_of(no_response_expected: Any, request: ModbusPDU | None) -> tuple[bool, ModbusPDU]:
    """Return the two arguments of ``execute``: ``no_response_expected`` as a bool, and the request.

    Before release 3.8 of pymodbus the request was the only argument; then ``no_response_expected`` is False.
    """
    if request is None:
        return False, no_response_expected
    return bool(no_response_expected), request


class ModbusBaseSyncClient(_Client):
    """Base of the blocking clients. As a context manager it connects at the beginning and closes at the end."""

    _link: BlockingLink | None = None

    @property
    def connected(self) -> bool:
        """Whether the client is connected now."""
        return self._link is not None and self._link.is_connected

    @property
    def socket(self) -> object | None:
        """An object while the client is connected, else None, to test for a connection; it is not the socket itself."""
        return self._link if self.connected else None

    def is_socket_open(self) -> bool:
        """Whether the client is connected now."""
        return self.connected

    def connect(self) -> bool:
        """Connect unless the client is connected, and return whether it is now.

        A failure to connect is logged, not raised; ``ConfigError`` is raised for an option that no link accepts.
        """
        if self._link is None:
            self._link = connect(self._endpoint, shared=False, **self._options)
        if self._link.is_connected:
            return True
        try:
            self._link.connect()
        except LinkDown as error:
            _LOG.error("%s", error)
            return False
        return self._told(True)

    def close(self) -> None:
        """Close the connection; ``connect`` or the next request opens another one."""
        link, self._link = self._link, None
        if link is not None:
            was_connected = link.is_connected
            link.close()
            if was_connected:
                self._told(False)

    def execute(self, no_response_expected: Any, request: ModbusPDU | None = None) -> Any:
        """Send a request, connecting first if necessary, and return the response.

        Args:
            no_response_expected: True: a missing reply is no error, and the result is None, unless the device answers
                with an exception. False: the response is returned.
            request: the request. As in older releases, the request may also be the first and only argument.

        Raises:
            InvalidRequest: a value of the request is out of range (a ``ValueError``); nothing was sent.
            ConnectionException: there is no connection, or it ended; bytes may have gone out.
            ModbusIOException: no valid reply, after all attempts.
        """
        silent, request = _request_of(no_response_expected, request)
        request = self._traced(True, request)
        message = request.to_request()
        if not self.connect():
            raise ConnectionException(f"Failed to connect[{self}]")
        assert self._link is not None
        try:
            reply = self._link.unit(request.dev_id).execute(message)
        except ModbusError as error:
            return self._failed(request, error, silent)
        return None if silent else self._response(request, reply)

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_what: object) -> None:
        self.close()


class ModbusBaseClient(_Client):
    """Base of the asyncio clients. As an asynchronous context manager it connects first and closes at the end."""

    _link: AsyncLink | None = None
    _closing: "asyncio.Task[None] | None" = None

    @property
    def connected(self) -> bool:
        """Whether the client is connected now."""
        return self._link is not None and self._link.is_connected

    async def connect(self) -> bool:
        """Connect unless the client is connected, and return whether it is now.

        A failure to connect is logged, not raised; ``ConfigError`` is raised for an option that no link accepts.
        """
        if self._link is None:
            self._link = open_link(self._endpoint, shared=False, **self._options)
        if self._link.is_connected:
            return True
        try:
            await self._link.connect()
        except LinkDown as error:
            _LOG.error("%s", error)
            return False
        return self._told(True)

    def close(self, reconnect: bool = False) -> None:
        """Close the connection, within the next turns of the event loop; ``connect`` opens another one.

        ``reconnect`` has no effect.
        """
        link, self._link = self._link, None
        if link is None:
            return
        was_connected = link.is_connected
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # the loop has ended, and its connections with it
            return
        self._closing = begun(link.close())
        if was_connected:
            self._told(False)

    async def execute(self, no_response_expected: Any, request: ModbusPDU | None = None) -> Any:
        """Send a request and return the response; arguments and errors are those of `ModbusBaseSyncClient.execute`.

        `ConnectionException` is raised too if ``connect`` was not called before.
        """
        silent, request = _request_of(no_response_expected, request)
        request = self._traced(True, request)
        message = request.to_request()
        if self._link is None:
            raise ConnectionException(f"Not connected[{self}]")
        try:
            reply = await self._link.unit(request.dev_id).execute(message)
        except ModbusError as error:
            return self._failed(request, error, silent)
        return None if silent else self._response(request, reply)

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(self, *_what: object) -> None:
        self.close()
        if self._closing is not None:
            await self._closing


def begun(work: Coroutine[Any, Any, None]) -> "asyncio.Task[None] | None":
    """Run a coroutine at once up to its first ``await`` that waits, and the rest in a task; return the task.

    Return None if the coroutine has ended without waiting. So a connection is closed even if a program closes its
    client and leaves the event loop at once.
    """
    try:
        awaited = work.send(None)
    except StopIteration:
        return None
    return asyncio.get_running_loop().create_task(_rest(work, awaited))


async def _rest(work: Coroutine[Any, Any, None], awaited: Any) -> None:
    await _resumed(work, awaited)


@types.coroutine
def _resumed(work: Coroutine[Any, Any, None], awaited: Any) -> Generator[Any, Any, None]:
    while True:
        go_on = partial(work.send, None)
        try:
            yield awaited
        except BaseException as error:  # a cancellation, above all, is for the work
            go_on = partial(work.throw, error)
        try:
            awaited = go_on()
        except StopIteration:
            return


# --- carriers ---------------------------------------------------------------------------------------------------------


class _Serial(_Client):
    """Base of the clients on a serial port, or on a serial server given as ``socket://host:port``."""

    carrier: ClassVar[str] = "serial"
    default_port: ClassVar[int | None] = None
    default_framer: ClassVar[FramerType] = FramerType.RTU

    def __init__(self, port: str, framer: object = None, **names: Any) -> None:
        if framer is None:
            framer = names.get("method")
        super().__init__(port, None, framer, **names)

    def _carrier_options(self, older: dict[str, Any]) -> dict[str, Any]:
        line = self.comm_params
        line.baudrate = older.pop("baudrate", 19200)
        line.parity = older.pop("parity", "N") or "N"
        line.bytesize = older.pop("bytesize", 8)
        line.stopbits = older.pop("stopbits", 1)
        options = {
            "baud": line.baudrate,
            "parity": line.parity,
            "data_bits": line.bytesize,
            "stop_bits": int(line.stopbits),
        }
        if older.pop("handle_local_echo", False):
            options["echo"] = "on"
        return {} if line.host.startswith("socket://") else options

    def _endpoint_of(self, host: str, port: int | None, framing: FramerType) -> Endpoint:
        if framing not in SERIAL_SCHEMES:
            raise TypeError("Only RTU/ASCII allowed.")
        if host.startswith("socket://"):
            name, _, number = host.removeprefix("socket://").rpartition(":")
            return Endpoint(f"{PREFIX[framing]}tcp", host=name.strip("[]"), port=int(number))
        return Endpoint(SERIAL_SCHEMES[framing], path=host)


class TlsFiles:
    """The files of a certificate, as ``generate_ssl`` of the TLS clients returns them for their ``sslctx``.

    Args:
        certfile, keyfile: paths of certificate and private key; None for none.
    """

    def __init__(self, certfile: str | None, keyfile: str | None) -> None:
        self.certfile: str | None = certfile
        self.keyfile: str | None = keyfile


class _Tls(_Client):
    """Base of the clients over TLS. As in pymodbus, the server is not verified by default.

    It is verified if ``authority`` names a file with the authority's certificate.
    """

    carrier: ClassVar[str] = "tls"
    default_port: ClassVar[int | None] = 802
    default_framer: ClassVar[FramerType] = FramerType.TLS

    @classmethod
    def generate_ssl(
        cls, certfile: str | None = None, keyfile: str | None = None, password: str | None = None
    ) -> TlsFiles:
        """Return the files of a certificate, for the argument ``sslctx`` of a client or server.

        Raises:
            ParameterException: a password is given; busway reads it only from a file (``password_file`` of a link).
        """
        if password is not None:
            raise ParameterException("a password is read from a file only: busway.connect(…, password_file=…)")
        return TlsFiles(certfile, keyfile)

    def _carrier_options(self, older: dict[str, Any]) -> dict[str, Any]:
        files = older.pop("sslctx", None) or TlsFiles(older.pop("certfile", None), older.pop("keyfile", None))
        if not isinstance(files, TlsFiles):
            raise ParameterException("sslctx must come from generate_ssl of this client, which names files")
        options = {
            "certificate": files.certfile,
            "key": files.keyfile,
            "server_name": older.pop("server_hostname", None),
        }
        authority = older.pop("authority", None)
        options |= {"verify": "off-insecure"} if authority is None else {"authority": authority}
        return {name: value for name, value in options.items() if value is not None}


class ModbusTcpClient(ModbusBaseSyncClient):
    """Blocking client over TCP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "tcp"


class ModbusUdpClient(ModbusBaseSyncClient):
    """Blocking client over UDP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "udp"


class ModbusSerialClient(_Serial, ModbusBaseSyncClient):
    """Blocking client on a serial port, with RTU or ASCII framing."""


class ModbusTlsClient(_Tls, ModbusBaseSyncClient):
    """Blocking client over TLS (Modbus/TCP Security)."""


class AsyncModbusTcpClient(ModbusBaseClient):
    """Asyncio client over TCP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "tcp"


class AsyncModbusUdpClient(ModbusBaseClient):
    """Asyncio client over UDP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "udp"


class AsyncModbusSerialClient(_Serial, ModbusBaseClient):
    """Asyncio client on a serial port, with RTU or ASCII framing."""


class AsyncModbusTlsClient(_Tls, ModbusBaseClient):
    """Asyncio client over TLS (Modbus/TCP Security)."""


__path__: list[str] = []
"""Empty: it makes this module a package for Python, so that `aliases` can serve names of modules below it."""
