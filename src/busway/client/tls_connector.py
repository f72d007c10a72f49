"""The connector for TLS: opens connections of asyncio and blocking links (MODBUS/TCP Security, port 802).

Knows TCP, TLS and the meaning of their failures; knows no session.

1. The certificate of the server is verified: its chain, its dates, and its name against the host of the URL or
   ``server_name``. Nothing is sent to a server that fails; with ``verify=off-insecure`` each connection logs a warning.
2. Certificates are read when the link is created, and again when their files have changed. If ``cryptography`` is
   installed, the dates of the client's own certificate are checked then: a warning is logged before servers refuse it.
3. With TLS 1.3 a client is connected before the server has checked the client's certificate: a refusal is received with
   the first read, and ends the connection with the same message.
4. If a server's certificate is refused for its dates, they are read over a second connection, over which nothing is
   sent, and put into the error: the date shows an operator whether the certificate or the clock is wrong.
"""

import contextlib
import logging
import socket
import ssl
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError, LinkDown
from ..options.endpoints import Endpoint
from ..options.sockets import SocketParameters
from ..options.tls import TlsParameters, Verify
from ..transport.local_end import connect_failure
from ..transport.tcp import configure
from ..transport.tls.context import client_context, timeless_context
from ..transport.tls.failures import FailureKind, TlsFailure, dated
from ..transport.tls.renewal import WatchedContext

if TYPE_CHECKING:
    import asyncio

    from ..transport.tls.layer import TlsLayer
    from ..transport.tls.socket import TlsSocket

_log = logging.getLogger("busway.client")

_OF_TIME: Final = (FailureKind.EXPIRED, FailureKind.NOT_YET_VALID)
"""Failures after which a second connection reads the dates of the certificate: ``ssl`` does not tell them (rule 4)."""


class TlsConnector:
    """Opens the TLS connections of a link. Creating it reads the certificates; nothing is opened.

    Args:
        endpoint: host and port of the server.
        sockets: options of the TCP connection under TLS.
        security: certificates and other settings of TLS; with ``context``, only ``server_name`` and
            ``handshake_timeout`` of them count.
        context: a context that the program created itself; None to create one from ``security``.

    Raises:
        ConfigError: a file cannot be used, or ``authority`` is missing although the server is to be verified.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        sockets: SocketParameters,
        security: TlsParameters,
        context: ssl.SSLContext | None = None,
    ) -> None:
        self._endpoint = endpoint
        self._sockets = sockets
        self._security = security
        self._host = endpoint.host
        self._port = endpoint.port or 0
        self._local = (sockets.local_address, 0) if sockets.local_address else None
        self._own_context = context
        self._context = None if context else WatchedContext(security, client_context, name=endpoint.url)
        self._server_name = security.server_name or self._host
        self._looked_at = -1
        self._look_at_own()

    async def connect(self, protocol: Callable[[], "asyncio.BufferedProtocol"]) -> Any:  # a `TlsLayer`, as a transport
        """Connect, complete the TLS handshake and return the transport. Raises `LinkDown`.

        ``protocol`` is called after the handshake, and returns the object that gets the events of the transport.
        """
        try:
            return await self._agree(self._context_now(), protocol)
        except TlsFailure as failure:
            if failure.kind not in _OF_TIME or self._own_context:
                raise self._down(failure) from failure
            raise self._down(await self._look_at_date(failure)) from failure
        except (OSError, ValueError) as error:
            raise self._down(error) from error

    async def _agree(self, context: ssl.SSLContext, protocol: Callable[[], "asyncio.BufferedProtocol"]) -> "TlsLayer":
        """Connect under asyncio, complete the handshake and return the transport.

        Raises `TlsFailure`, `OSError`, `ValueError`.
        """
        import asyncio  # here: blocking programs, and every start of the command line, do without it

        from ..transport.tls.layer import TlsLayer

        loop = asyncio.get_running_loop()
        agreed: asyncio.Future[None] = loop.create_future()

        def established(layer: TlsLayer) -> asyncio.BufferedProtocol:
            if not agreed.done():
                agreed.set_result(None)
            return protocol()

        def failed(layer: TlsLayer, failure: TlsFailure) -> None:
            if not agreed.done():
                agreed.set_exception(failure)

        def new_layer() -> TlsLayer:
            return TlsLayer(
                loop,
                context,
                server_side=False,
                server_name=self._server_name,
                timeout=self._security.handshake_timeout,
                established=established,
                failed=failed,
            )

        async with asyncio.timeout(self._sockets.connect_timeout):
            below, layer = await loop.create_connection(new_layer, self._host, self._port, local_addr=self._local)
        try:
            with contextlib.suppress(OSError):  # a peer that is gone already says so to the handshake
                configure(below.get_extra_info("socket"), self._sockets)
            await agreed
        except BaseException:
            layer.abort()
            raise
        return layer

    async def _look_at_date(self, failure: TlsFailure) -> TlsFailure:
        """Return a failure whose text says which certificate is out of date, and its date; for an asyncio link.

        The server's certificate is read over a second connection, which accepts any dates and over which nothing is
        sent (rule 4). If its dates are good, the text names the certificate of an authority above it. If that
        connection fails, ``failure`` is returned unchanged.
        """
        try:
            layer = await self._agree(timeless_context(self._security), _silent_protocol)
        except (OSError, ValueError):
            return failure
        certificate = layer.get_extra_info("ssl_object").getpeercert()
        layer.close()
        return dated(failure, certificate, time.time())

    def dial(self) -> "TlsSocket":
        """Connect, complete the TLS handshake and return the socket, for a blocking link. Raises `LinkDown`."""
        try:
            return self._agree_now(self._context_now())
        except TlsFailure as failure:
            if failure.kind not in _OF_TIME or self._own_context:
                raise self._down(failure) from failure
            raise self._down(self._look_at_date_now(failure)) from failure
        except (OSError, ValueError) as error:
            raise self._down(error) from error

    def _agree_now(self, context: ssl.SSLContext) -> "TlsSocket":
        """Connect and complete the handshake, blocking, and return the socket.

        Raises `TlsFailure`, `OSError`, `ValueError`.
        """
        from ..transport.tls.socket import TlsSocket

        connection = socket.create_connection((self._host, self._port), self._sockets.connect_timeout, self._local)
        with contextlib.suppress(OSError):  # a peer that is gone already says so at the first read
            configure(connection, self._sockets)
        return TlsSocket(connection, context, server_name=self._server_name, timeout=self._security.handshake_timeout)

    def _look_at_date_now(self, failure: TlsFailure) -> TlsFailure:
        """Return a failure whose text says which certificate is out of date, and its date; for a blocking link.

        The date is found out as by `_look_at_date`.
        """
        try:
            connection = self._agree_now(timeless_context(self._security))
        except (OSError, ValueError):
            return failure
        certificate = connection.ssl_object.getpeercert()
        connection.close()
        return failure if certificate is None else dated(failure, certificate, time.time())

    def release(self) -> None:
        """Do nothing: a TLS connector holds no resources."""

    def _context_now(self) -> ssl.SSLContext:
        if self._context is None:
            assert self._own_context is not None
            return self._own_context
        if self._security.verify is Verify.OFF_INSECURE:
            _log.warning(
                "%s: any host that answers there is taken for the server (verify=off-insecure): "
                "anyone on the way can read and change the traffic",
                self._endpoint.url,
            )
        context = self._context.current()
        self._look_at_own()
        return context

    def _look_at_own(self) -> None:
        """Log a warning if the client's own certificate is not valid now or expires soon.

        It is logged once for each version of the file; never if the program created the context itself.
        """
        name = self._security.certificate
        if name is None or self._context is None or self._looked_at == self._context.generation:
            return
        from ..transport.tls.certificates.facts import facts_of_file

        self._looked_at = self._context.generation
        with contextlib.suppress(ConfigError):  # TLS can use it even if its dates cannot be read
            problem = facts_of_file(name)[0].validity()
            if problem:
                _log.warning("%s: our certificate %s %s", self._endpoint.url, name, problem)

    def _down(self, error: BaseException) -> LinkDown:
        return connect_failure(
            error, endpoint=self._endpoint.url, host=self._host, local_address=self._sockets.local_address
        )


def _silent_protocol() -> "asyncio.BufferedProtocol":
    """Return an asyncio protocol that ignores all events and data, for a connection over which nothing is sent."""
    import asyncio

    class Silent(asyncio.BufferedProtocol):
        def get_buffer(self, sizehint: int) -> bytearray:
            return bytearray(1024)

    return Silent()
