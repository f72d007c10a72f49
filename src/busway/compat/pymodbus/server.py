"""The servers of pymodbus: each is a server of `busway.serve` whose responder asks the program's contexts for values.

Knows contexts and how requests read and write them; knows no bytes and no socket.

1. Each request calls ``getValues`` or ``setValues`` of the unit's context when it is received, in the event loop of the
   server. So it sees every change that the program has made, and methods that the program overrides are called.
2. Addresses that a context does not have are answered 02, an error that it raises 04. If it returns an exception code,
   that is the answer.
3. Functions that a context does not have (files, queues) are answered 01. Functions 43/14 and 17 are answered from the
   identification.
"""

import asyncio
import contextlib
import logging
from collections.abc import Mapping
from typing import Any, ClassVar

from ...codes import ExceptionCode, Table
from ...options.endpoints import Endpoint
from ...options.tls import TlsParameters
from ...pdu.bits import pack_bits, unpack_bits
from ...pdu.device_interface import Context, Refusal
from ...pdu.exception_response import ExceptionResponse
from ...pdu.functions import STANDARD, AnyRequest, FunctionTable
from ...pdu.malformed_request import MalformedRequest
from ...pdu.message import Message
from ...pdu.unknown_functions import OpaqueRequest
from ...server.server import Server
from ...server.serving import serve
from ...session.responder import SILENCE, RequestContext, ResponderAnswer, ServedUnit
from .client import PREFIX, SERIAL_SCHEMES, TlsFiles
from .datastore import ModbusServerContext
from .device import ModbusDeviceIdentification
from .exceptions import NoSuchIdException, ParameterException
from .framer import FramerType, framer_type_of

_LOG = logging.getLogger(__name__)

READING_CODE = {Table.COILS: 1, Table.DISCRETE_INPUTS: 2, Table.HOLDING_REGISTERS: 3, Table.INPUT_REGISTERS: 4}
BIT_TABLES = (Table.COILS, Table.DISCRETE_INPUTS)
RUNS = b"\xff"
IGNORED = frozenset(
    {
        "allow_reuse_address",
        "allow_reuse_port",
        "auto_reconnect",
        "backlog",
        "console",
        "custom_functions",
        "defer_start",
        "handler",
        "handle_local_echo",
        "name",
        "reqclicert",
        "timeout",
        "trace_connect",
        "trace_packet",
        "trace_pdu",
    }
)
"""Arguments of some release of pymodbus that have no effect here."""


class ContextModel:
    """Lets requests read and write the context of one unit as a data model of `busway.pdu.device_interface`.

    Args:
        store: the context.
        function: function code of the request.
        identity: identification objects by number.
    """

    def __init__(self, store: Any, function: int, identity: Mapping[int, bytes]) -> None:
        self._store = store
        self._function = function
        self._identity = identity

    def _code(self, table: Table) -> int:
        """Return the function code to pass to the context, so that it uses a table.

        It is that of the request, if the context has the same table for it; otherwise the code that reads the table.
        """
        decode = getattr(self._store, "decode", None)
        reading = READING_CODE[table]
        if decode is None:
            return self._function
        with contextlib.suppress(KeyError):
            if decode(self._function) == decode(reading):
                return self._function
        return reading

    def check(self, table: Table, address: int, count: int, writes: bool, context: Context | None = None) -> None:
        """Raise `Refusal` with code 02 for a range that the context does not have; return None otherwise."""
        validate = getattr(self._store, "validate", None)
        if address + count > 0x10000 or (validate is not None and not validate(self._code(table), address, count)):
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)

    def read(self, table: Table, address: int, count: int, context: Context) -> bytes:
        """Return the values of a range, from ``getValues`` of the context, in wire order.

        Bits are packed, eight in a byte; a register has two bytes, the higher first.

        Raises:
            Refusal: with code 02 if the context does not have the range; with its own code if it returns one.
        """
        self.check(table, address, count, False)
        values = self._store.getValues(self._code(table), address, count)
        if isinstance(values, int):
            raise Refusal(values)
        found = list(values)
        if len(found) != count:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
        if table in BIT_TABLES:
            return pack_bits([bool(value) for value in found])
        return b"".join((int(value) & 0xFFFF).to_bytes(2, "big") for value in found)

    def write(self, table: Table, address: int, count: int, data: bytes, context: Context) -> None:
        """Pass the values of a write, ``data`` in wire order, to ``setValues`` of the context.

        If the context returns an exception code, it is raised as `Refusal`.
        """
        values: list[int] | list[bool] = (
            unpack_bits(data, count)
            if table in BIT_TABLES
            else [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]
        )
        code = self._store.setValues(self._code(table), address, values)
        if isinstance(code, int) and code:
            raise Refusal(code)

    def read_file(self, file: int, record: int, count: int, context: Context) -> bytes:
        """Raise `Refusal` with code 01: contexts have no files."""
        raise Refusal(ExceptionCode.ILLEGAL_FUNCTION)

    def write_file(self, file: int, record: int, data: bytes, context: Context, *, dry: bool = False) -> None:
        """Raise `Refusal` with code 01: contexts have no files."""
        raise Refusal(ExceptionCode.ILLEGAL_FUNCTION)

    def read_fifo(self, address: int, context: Context) -> bytes:
        """Raise `Refusal` with code 01: contexts have no queues."""
        raise Refusal(ExceptionCode.ILLEGAL_FUNCTION)

    def exception_status(self) -> int:
        """Return the status bits of function 07: always 0, because contexts have none."""
        return 0

    def server_id(self) -> bytes:
        """Return the data of function 17: the identification objects joined by ``-``, and the run indicator FF.

        ``busway`` stands for an empty identification; at most 250 bytes come before the run indicator.
        """
        return (b"-".join(self._identity.values()) or b"busway")[:250] + RUNS

    def identification(self) -> Mapping[int, bytes]:
        """Return the identification objects by number."""
        return self._identity

    def canopen(self, data: bytes) -> bytes:
        """Raise `Refusal` with code 01: contexts have no CANopen."""
        raise Refusal(ExceptionCode.ILLEGAL_FUNCTION)


class ContextResponder:
    """Responder that executes requests on the contexts of a program.

    Args:
        context: the contexts by unit.
        identity: identification of the server; None for an empty one.
        silent: whether requests to units without a context get no reply; otherwise they are answered 0B.
    """

    def __init__(self, context: ModbusServerContext, identity: ModbusDeviceIdentification | None, silent: bool) -> None:
        self.functions: FunctionTable = STANDARD
        self.generation: int = 0
        self._context = context
        self._identity = ModbusDeviceIdentification() if identity is None else identity
        self._silent = silent

    def serves(self, unit: int) -> ServedUnit | None:
        """Return the unit if a context answers for it; otherwise None."""
        return ServedUnit(unit) if unit in self._context else None

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Execute a request on the context of its unit, and return the reply; `SILENCE` if no reply is to be sent.

        An exception that the context raises is logged, and the reply is exception 04.

        Raises:
            Refusal: the request is answered with this exception code.
        """
        try:
            store = self._context[context.unit]
        except (NoSuchIdException, KeyError):
            absent = ExceptionResponse(context.function, ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND)
            return SILENCE if self._silent else absent
        if context.executed is not None:  # a broadcast of a serial line, once for each context
            if id(store) in context.executed:
                return SILENCE
            context.executed.add(id(store))
        if isinstance(request, OpaqueRequest):
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_FUNCTION)
        if isinstance(request, MalformedRequest):
            return ExceptionResponse(context.function, request.code)
        model = ContextModel(store, context.function, self._identity.encoded())
        try:
            reply: Message = request.apply(model, context)
        except Refusal:
            raise
        except Exception:  # whatever the program's own code raises is a failure of the device
            _LOG.exception("the context of unit %s failed", context.unit)
            return ExceptionResponse(context.function, ExceptionCode.SERVER_DEVICE_FAILURE)
        return reply


class ModbusBaseServer:
    """Base of the servers: created in a running event loop, started by ``serve_forever``, ended by ``shutdown``.

    Args:
        context: the contexts by unit.
        framer: the framing, in a form that `framer_type_of` accepts; None for that of the class.
        identity: identification of the server.
        address: host and port to listen on; None for all addresses and the port of the class.
        ignore_missing_devices, ignore_missing_slaves: whether requests to units without a context get no reply.
        broadcast_enable: has no effect.
        custom_pdu: must be empty; busway serves functions of the program by ``busway.serve(functions=…)``.

    Raises:
        TypeError: an argument that no release of pymodbus has.
        ParameterException: ``custom_pdu`` is not empty, or ``framer`` names no framing.
        RuntimeError: no event loop is running.
    """

    carrier: ClassVar[str]
    default_framer: ClassVar[FramerType] = FramerType.SOCKET
    default_port: ClassVar[int] = 502
    active_server: "ClassVar[ModbusBaseServer | None]" = None

    def __init__(
        self,
        context: ModbusServerContext | None = None,
        framer: object = None,
        identity: ModbusDeviceIdentification | None = None,
        address: tuple[str, int] | None = None,
        ignore_missing_devices: bool = False,
        broadcast_enable: bool = False,
        *,
        ignore_missing_slaves: bool = False,
        custom_pdu: object = None,
        **older: Any,  # arguments of other releases, and the settings of a serial line or of TLS
    ) -> None:
        if custom_pdu:
            raise ParameterException("custom_pdu is not served; busway.serve(functions=…) takes functions of your own")
        self.context: ModbusServerContext = ModbusServerContext() if context is None else context
        framing = framer_type_of(self.default_framer if framer is None else framer)
        host, port = address or ("", self.default_port)
        names: dict[str, Any] = {"tls": self._tls(older)}
        endpoint = self._endpoint(framing, host, port, older)
        for name in older:
            if name not in IGNORED:
                raise TypeError(f"{type(self).__name__}() got an unexpected keyword argument {name!r}")
        silent = ignore_missing_devices or ignore_missing_slaves
        self._server: Server = serve(endpoint, responder=ContextResponder(self.context, identity, silent), **names)
        self._ended: asyncio.Event = asyncio.Event()  # set by ``shutdown``; each ``serve_forever`` has its own
        self.loop: asyncio.AbstractEventLoop = asyncio.get_running_loop()
        ModbusBaseServer.active_server = self

    def _tls(self, older: dict[str, Any]) -> TlsParameters | None:
        return None

    def _endpoint(self, framing: FramerType, host: str, port: int, older: dict[str, Any]) -> Endpoint:
        return Endpoint(f"{PREFIX.get(framing, '')}{self.carrier}", host=host.strip("[]"), port=port)

    @property
    def endpoints(self) -> list[str]:
        """The URLs that the server listens on, with the ports that are bound."""
        return self._server.endpoints

    async def serve_forever(self, *, background: bool = False) -> None:
        """Serve until ``shutdown`` is called; with ``background``, return as soon as the server listens.

        A server that was shut down can serve again.

        Raises:
            RuntimeError: the server is running already.
        """
        if self._server.is_running:
            raise RuntimeError("Can't call serve_forever on an already running server object")
        ended = self._ended = asyncio.Event()
        await self._server.start()
        if background:
            return
        try:
            await ended.wait()
        finally:
            if self._ended is ended:  # otherwise it serves again already
                await self._server.stop()

    async def shutdown(self) -> None:
        """Stop the server and wait until it has stopped; a waiting ``serve_forever`` returns then."""
        try:
            await self._server.stop()
        finally:
            self._ended.set()  # last: the loop may end with ``serve_forever``, and takes down what still waits


class ModbusTcpServer(ModbusBaseServer):
    """Server over TCP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "tcp"


class ModbusUdpServer(ModbusBaseServer):
    """Server over UDP, with MBAP, RTU or ASCII framing."""

    carrier: ClassVar[str] = "udp"


class ModbusTlsServer(ModbusBaseServer):
    """Server over TLS (Modbus/TCP Security).

    ``sslctx`` is what ``generate_ssl`` of a TLS client returned; or ``certfile`` and ``keyfile`` name the files.
    ``authority`` names the file with the authorities of clients' certificates; it is needed, because clients are always
    verified.
    """

    carrier: ClassVar[str] = "tls"
    default_framer: ClassVar[FramerType] = FramerType.TLS
    default_port: ClassVar[int] = 802

    def _tls(self, older: dict[str, Any]) -> TlsParameters | None:
        files = older.pop("sslctx", None) or TlsFiles(older.pop("certfile", None), older.pop("keyfile", None))
        if not isinstance(files, TlsFiles):
            raise ParameterException("sslctx must come from generate_ssl of a TLS client, which names files")
        return TlsParameters(certificate=files.certfile, key=files.keyfile, authority=older.pop("authority", None))


class ModbusSerialServer(ModbusBaseServer):
    """Server on a serial port, with RTU or ASCII framing; its ``port`` is the name of the port."""

    default_framer: ClassVar[FramerType] = FramerType.RTU

    def _endpoint(self, framing: FramerType, host: str, port: int, older: dict[str, Any]) -> Endpoint:
        if framing not in SERIAL_SCHEMES:
            raise TypeError("Only RTU/ASCII allowed.")
        settings = {
            "baud": older.pop("baudrate", 19200),
            "parity": older.pop("parity", "N") or "N",
            "data_bits": older.pop("bytesize", 8),
            "stop_bits": older.pop("stopbits", 1),
        }
        options = {name: str(value) for name, value in settings.items()}
        if "port" not in older:
            raise TypeError(f"{type(self).__name__}() missing 1 required keyword-only argument: 'port'")
        return Endpoint(SERIAL_SCHEMES[framing], path=older.pop("port"), options=options)


# --- starting and stopping --------------------------------------------------------------------------------------------


async def StartAsyncTcpServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over TCP until the task is cancelled or `ServerAsyncStop` is called; arguments of `ModbusTcpServer`."""
    await ModbusTcpServer(context, **names).serve_forever()


async def StartAsyncUdpServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over UDP until the task is cancelled or `ServerAsyncStop` is called; arguments of `ModbusUdpServer`."""
    await ModbusUdpServer(context, **names).serve_forever()


async def StartAsyncTlsServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over TLS until the task is cancelled or `ServerAsyncStop` is called; arguments of `ModbusTlsServer`."""
    await ModbusTlsServer(context, **names).serve_forever()


async def StartAsyncSerialServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve on a serial port until the task is cancelled or `ServerAsyncStop` is called.

    Arguments are those of `ModbusSerialServer`.
    """
    await ModbusSerialServer(context, **names).serve_forever()


def StartTcpServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over TCP until `ServerStop` is called from another thread; arguments of `ModbusTcpServer`."""
    asyncio.run(StartAsyncTcpServer(context, **names))


def StartUdpServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over UDP until `ServerStop` is called from another thread; arguments of `ModbusUdpServer`."""
    asyncio.run(StartAsyncUdpServer(context, **names))


def StartTlsServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve over TLS until `ServerStop` is called from another thread; arguments of `ModbusTlsServer`."""
    asyncio.run(StartAsyncTlsServer(context, **names))


def StartSerialServer(context: ModbusServerContext | None = None, **names: Any) -> None:
    """Serve on a serial port until `ServerStop` is called from another thread; arguments of `ModbusSerialServer`."""
    asyncio.run(StartAsyncSerialServer(context, **names))


async def ServerAsyncStop() -> None:
    """Stop the server that was created last; call it in the event loop of that server.

    Raises:
        RuntimeError: there is no server.
    """
    server, ModbusBaseServer.active_server = ModbusBaseServer.active_server, None
    if server is None:
        raise RuntimeError("Modbus server not running.")
    await server.shutdown()


def ServerStop() -> None:
    """Stop the server that was created last, and wait until it has stopped; call it in another thread.

    Raises:
        RuntimeError: there is no server.
    """
    server = ModbusBaseServer.active_server
    if server is None:
        raise RuntimeError("Modbus server not running.")
    asyncio.run_coroutine_threadsafe(ServerAsyncStop(), server.loop).result()


__path__: list[str] = []
"""Empty: it makes this module a package for Python, so that `aliases` can serve names of modules below it."""
