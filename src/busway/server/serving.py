"""Functions that run a server: `serve` in a coroutine, `serve_forever` in a blocking program, `serve_in_thread`."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Unpack

from ..access.addresses import HostAuthorizer, allow_all
from ..errors import ConfigError
from ..options.endpoints import Endpoint
from ..options.server import ListenerParameters, ServerParameters, UnitParameters, UnitPolicy
from ..options.sockets import SocketParameters
from ..pdu.functions import STANDARD, FunctionTable
from ..session.responder import Responder
from .device import Device
from .device_responder import DeviceResponder
from .listener import Listener
from .loops import run as run_on_new_loop
from .server import Server, ServerStatus
from .server_options import with_server_preset

if TYPE_CHECKING:
    from ..access.audit_log import AuditLog
    from ..access.rules import Policy
    from ..options.tls import TlsParameters
    from .option_types import ServerOptions

    class ServeArguments(ServerOptions, total=False):
        """The keyword arguments of `serve` that `serve_forever` and `serve_in_thread` accept too."""

        units: Mapping[int, Device] | Device | None
        responder: Responder | None
        functions: FunctionTable
        authorize: HostAuthorizer
        tls: "TlsParameters | None"
        policy: "Policy | None"
        audit: "AuditLog | None"
        local_connections: Callable[[], int] | None


DEFAULT_ENDPOINT = "tcp://127.0.0.1:5020"


def serve(
    *endpoints: str | Endpoint | Listener,
    units: Mapping[int, Device] | Device | None = None,
    responder: Responder | None = None,
    functions: FunctionTable = STANDARD,
    authorize: HostAuthorizer = allow_all,
    tls: "TlsParameters | None" = None,
    policy: "Policy | None" = None,
    audit: "AuditLog | None" = None,
    local_connections: Callable[[], int] | None = None,
    **options: "Unpack[ServerOptions]",
) -> Server:
    """Create a server that is not started yet: ``async with busway.serve("tcp://127.0.0.1:5020", units={1: device}):
    …``.

    Args:
        endpoints: URLs to listen on; ``tcp://127.0.0.1:5020`` if there are none. Port 0 means any free port. Serial
            ports (``rtu:///dev/ttyUSB0?baud=9600``) and listeners of every kind can be combined; the settings of a port
            are in its URL. A `Listener` has access rules, certificates or limits of its own.
        units: devices by unit identifier 0…255; or one device, which answers requests to any unit. On a serial line,
            and with RTU or ASCII framing over a network, only the listed units 1…247 are answered (a single device: 1).
        responder: instead of ``units``, an object that answers requests (`busway.session.responder.Responder`).
        functions: the table of functions; ``busway.STANDARD.with_functions(Mine)`` adds one.
        authorize: called with the host of each new connection (``"10.0.0.7"``), before a byte is parsed; if it returns
            False, the connection is closed and counted (Messaging on TCP/IP V1.0b §4.2.3).
        tls: certificate, key and authorities of ``tls://`` listeners.
        policy: which clients may make which requests; ``Policy.read_only()`` refuses all writes. Without a policy, a
            server that other hosts can reach accepts writes from all of them, and logs a warning.
        audit: the audit log, which records denied requests and writes.
        local_connections: called for a status; returns how many connections this program has open towards other
            devices. None counts the connections that this process's links have open.
        options: fields of `UnitParameters`, `ServerParameters`, `ListenerParameters` and `SocketParameters`
            (`busway.options`), by name; ``preset="strict"`` sets those that the specifications require.

    Raises:
        ConfigError: an endpoint, unit or option is not valid, or contradicts the preset.
    """
    places, chosen = with_server_preset(endpoints or (DEFAULT_ENDPOINT,), options)
    parameters = chosen.build(UnitParameters)
    if (units is None) == (responder is None):
        raise ConfigError("either units or a responder is needed", key="units")
    if responder is None:
        unit_policy = parameters.unit_policy
        if isinstance(units, Device):
            units, unit_policy = {1: units}, UnitPolicy.ANY
        assert units is not None
        responder = DeviceResponder(units, unit_policy=unit_policy, unlisted=parameters.unlisted, functions=functions)
    return Server(
        places,
        responder,
        parameters=chosen.build(ServerParameters),
        listener=chosen.build(ListenerParameters),
        sockets=chosen.build(SocketParameters),
        authorize=authorize,
        tls=tls,
        policy=policy,
        audit=audit,
        standard_port=parameters.standard_port,
        local_connections=local_connections,
    )


def serve_forever(
    *endpoints: str | Endpoint | Listener,
    started: Callable[[Server], None] | None = None,
    **options: "Unpack[ServeArguments]",
) -> None:
    """Run a server in a blocking program until it is interrupted (Ctrl-C), then stop it and return.

    Args:
        endpoints: as in `serve`.
        started: called once with the running server, for example to print its endpoints.
        options: as in `serve`.

    Raises:
        ConfigError, LinkDown: as in `serve` and `Server.start`.
    """

    async def run() -> None:
        async with serve(*endpoints, **options) as server:
            if started is not None:
                started(server)
            await asyncio.get_running_loop().create_future()

    with contextlib.suppress(KeyboardInterrupt):
        run_on_new_loop(run())


class ServerThread:
    """A running server in a thread of its own; `serve_in_thread` creates it.

    Its methods block until the server's thread has answered, so that thread itself must not call them.
    """

    def __init__(self, server: Server, loop: asyncio.AbstractEventLoop) -> None:
        self._server = server
        self._loop = loop

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners with their bound addresses and ports."""
        return self._server.endpoints

    def status(self) -> ServerStatus:
        """Return the current status of the server, from any thread but the server's own."""

        async def ask() -> ServerStatus:
            return self._server.status()

        return asyncio.run_coroutine_threadsafe(ask(), self._loop).result()

    def reset(self) -> None:
        """Stop the server, clear its counters, and start it again, from any thread but the server's own.

        Raises what `Server.reset` raises.
        """
        asyncio.run_coroutine_threadsafe(self._server.reset(), self._loop).result()

    def reload_security(self) -> None:
        """Read the certificates of the ``tls://`` listeners again, and wait until it is done.

        From any thread but the server's own. Raises `ConfigError`, as `Server.reload_security` does.
        """

        async def reload() -> None:
            self._server.reload_security()

        asyncio.run_coroutine_threadsafe(reload(), self._loop).result()

    def end_unauthorized(self) -> int:
        """Abort connections of hosts that may no longer connect, as `Server.end_unauthorized` does.

        From any thread but the server's own.

        Returns how many connections, TLS handshakes and peers were ended.
        """

        async def end() -> int:
            return self._server.end_unauthorized()

        return asyncio.run_coroutine_threadsafe(end(), self._loop).result()


@contextlib.contextmanager
def serve_in_thread(
    *endpoints: str | Endpoint | Listener, **options: "Unpack[ServeArguments]"
) -> Iterator[ServerThread]:
    """Serve in a thread beside a blocking program: ``with busway.serve_in_thread(units={1: device}) as server: …``.

    Devices may be read and written from any thread. Leaving the block stops the server within a second.

    Args:
        endpoints: as in `serve`.
        options: as in `serve`.

    Raises:
        ConfigError, LinkDown: as in `serve` and `Server.start`.
        OSError: the system has no descriptors for another event loop.
    """
    server = serve(*endpoints, **options)
    ready = _Ready()

    async def run() -> None:
        stop = asyncio.Event()
        await server.start()
        ready.loop, ready.stop = asyncio.get_running_loop(), stop
        ready.event.set()
        await stop.wait()
        await server.stop()

    def run_until_stopped() -> None:
        try:
            run_on_new_loop(run())
        except BaseException as error:
            if ready.event.is_set():
                raise
            ready.error = error
            ready.event.set()

    thread = threading.Thread(target=run_until_stopped, name="busway server", daemon=True)
    thread.start()
    ready.event.wait()
    if ready.error is not None:
        thread.join()
        raise ready.error
    assert ready.loop is not None
    assert ready.stop is not None
    try:
        yield ServerThread(server, ready.loop)
    finally:
        ready.loop.call_soon_threadsafe(ready.stop.set)
        thread.join()


class _Ready:
    """The result of starting a server in a thread: the running server, or the error that stopped it."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.loop: asyncio.AbstractEventLoop | None = None
        self.stop: asyncio.Event | None = None
        self.error: BaseException | None = None


__all__ = ["DEFAULT_ENDPOINT", "ServerThread", "serve", "serve_forever", "serve_in_thread"]
