"""The connector for serial ports: opens a port for a link, waits for a missing port, and makes it look like a stream.

Knows ports, and tells the session when the last character of its frame has left; knows no request.

1. If the port is missing, it is waited for, up to ``port_wait`` seconds.
2. The response timeout counts from the last character of a request: the session is told when that is expected to
   leave, and again if the system turns out to hold it longer.
3. If the driver of the port reports lost characters, the bytes read with that report are treated as damaged.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError, LinkDown
from ..options.endpoints import Endpoint
from ..options.ports import OpeningParameters, SerialSettings
from ..session.serial_client import SerialClientSession
from ..transport.serial.blocking import BlockingSerialPort
from ..transport.serial.overruns import Overruns
from ..transport.serial.port_claims import PortClaim
from ..transport.serial.reopen import ReopenPolicy
from .channel import Channel, LinkEnd

if TYPE_CHECKING:
    from ..transport.serial.connection import SerialConnection

HOLDS_AT_MOST: Final = 16
"""How often, for one frame, the response timeout is moved because the system still holds characters."""


class SerialConnector:
    """Opens the serial port of a link, and opens it again after it was lost.

    From its creation until `release` no other user in this process can open the port.

    Args:
        endpoint: the endpoint with the name of the port.
        port: baud rate, parity and other settings of the port.
        opening: how long to wait for a missing port, and the pauses between attempts.
        session: the session of the link; it is told when characters leave, and gets damaged bytes.
        user: who holds the port, in words, for the error that a second user in this process gets.

    Raises:
        ConfigError: this process uses the port already, or `serialx` is not installed.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        port: SerialSettings,
        opening: OpeningParameters,
        session: SerialClientSession,
        *,
        user: str,
    ) -> None:
        self._endpoint = endpoint
        self._port = port
        self._opening = opening
        self._session = session
        self._claim = PortClaim(endpoint.path, user)

    async def connect(self, protocol: Callable[[], LinkEnd]) -> Any:
        """Open the port for an asyncio link and return its transport, a `SerialStream`.

        If the port is missing or cannot be opened, it is tried again for up to ``port_wait`` seconds; wrong options of
        the port fail at once. Raises `LinkDown`.

        ``protocol`` is called once, and returns the object that gets received bytes and the loss of the port.
        """
        import asyncio

        from ..transport.serial.connection import SerialConnection

        stream = SerialStream(self._session, protocol())
        waited = _Waited(self._opening)
        while True:
            try:
                connection = await SerialConnection.open(
                    self._endpoint.path, self._port, received=stream.received, lost=stream.lost
                )
                stream.opened(connection)
                return stream
            except (LinkDown, ConfigError) as error:
                pause = waited.pause(self._named(error))
            await asyncio.sleep(pause)

    def dial(self) -> Channel:
        """Open the port for a blocking link and return it as a `SerialChannel`. Raises `LinkDown`.

        If the port is missing or cannot be opened, it is tried again for up to ``port_wait`` seconds; wrong options of
        the port fail at once.
        """
        waited = _Waited(self._opening)
        while True:
            try:
                return SerialChannel(BlockingSerialPort(self._endpoint.path, self._port), self._session)
            except (LinkDown, ConfigError) as error:
                pause = waited.pause(self._named(error))
            time.sleep(pause)

    def release(self) -> None:
        """Allow other users in this process to open the port; called when the link is closed for good."""
        self._claim.release()

    def _named(self, error: LinkDown | ConfigError) -> LinkDown:
        """Return a `LinkDown` that names the endpoint; its cause is ``error``, raised while opening the port."""
        kind = error.kind if isinstance(error, LinkDown) else "other"
        down = LinkDown(error.message, kind=kind, endpoint=self._endpoint.url)
        down.__cause__ = error
        return down


class _Waited:
    """One wait for a missing serial port, which begins with its creation: how long to pause, and when to give up."""

    def __init__(self, opening: OpeningParameters) -> None:
        self._policy = ReopenPolicy.of(opening)
        self._until = time.monotonic() + opening.port_wait
        self._failures = 0

    def pause(self, error: LinkDown) -> float:
        """Return the seconds to wait before the next attempt to open the port; ``error`` is why the last one failed.

        Raises ``error`` itself if the whole wait is over, or if waiting cannot help because the options are wrong.
        """
        self._failures += 1
        left = self._until - time.monotonic()
        if isinstance(error.__cause__, ConfigError) or left <= 0:
            raise error
        return min(self._policy.pause(self._failures) or 0.0, left)


class SerialStream:
    """An open serial port of an asyncio link, with those methods of an asyncio transport that the link uses.

    ``end`` is the protocol of the link; it gets received bytes, and is told if the port is lost.
    """

    def __init__(self, session: SerialClientSession, end: LinkEnd) -> None:
        self._session = session
        self._end = end
        self._connection: SerialConnection | None = None
        self._closing: SerialConnection | None = None
        self._overruns: Overruns | None = None
        self._puts_off = 0

    def opened(self, connection: "SerialConnection") -> None:
        """Use ``connection`` from now on, and tell the session whether characters take time to leave the port.

        They do, except on a pseudo-terminal.
        """
        self._connection = connection
        self._session.characters_take_time = not connection.pseudo_terminal
        self._overruns = Overruns(connection.counters)

    # What the port tells.

    def received(self, data: bytes, errors: int) -> None:
        """Pass received bytes to the link.

        ``errors`` is how many of them the port marked as damaged. If it is not 0, or if the driver of the port reports
        lost characters, all of ``data`` is passed on as damaged.
        """
        overrun = self._overruns is not None and self._overruns.more()
        if errors or overrun:
            self._end.arrived_damaged(data, overrun=overrun)
        else:
            self._end.arrived(data)

    def lost(self, error: LinkDown) -> None:
        """Tell the link that the serial port is lost, for example unplugged; ``error`` says why."""
        self._connection = None
        self._end.connection_lost(error)

    # What a link calls.

    def write(self, data: bytes) -> None:
        """Send a frame, and tell the session when its last character will have left.

        Does nothing after the port was closed or lost. If sending fails, ``connection_lost`` of the link's protocol is
        called in the next turn of the event loop.
        """
        connection = self._connection
        if connection is None:
            return
        self._puts_off = 0
        try:
            self._session.written(connection.write(data))
        except LinkDown as error:
            self.abort()
            import asyncio

            asyncio.get_running_loop().call_soon(self._end.connection_lost, error)

    def still_sending(self) -> None:
        """Tell the session if the system still holds characters of the last frame, so that the timeout starts later."""
        if self._connection is None or self._puts_off >= HOLDS_AT_MOST:
            return
        try:
            until = self._connection.still_sending()
        except LinkDown:
            return  # the port tells it by itself
        if until is not None:
            self._puts_off += 1
            self._session.still_sending(until)

    def close(self) -> None:
        """Close the serial port of the link."""
        connection, self._connection = self._connection, None
        if connection is not None:
            self._closing = connection
            connection.close()

    async def wait_closed(self) -> None:
        """Wait until the descriptor of the port is closed; call it after `close`."""
        if self._closing is not None:
            await self._closing.wait_closed()

    def abort(self) -> None:
        """Close the serial port; the same as `close`."""
        self.close()

    def is_closing(self) -> bool:
        """Whether the serial port was closed or lost."""
        return self._connection is None


class SerialChannel:
    """An open serial port of a blocking link, with the methods of a non-blocking socket."""

    def __init__(self, port: BlockingSerialPort, session: SerialClientSession) -> None:
        self._port = port
        self._session = session
        session.characters_take_time = not port.pseudo_terminal
        self._overruns = Overruns(port.counters)
        self._puts_off = 0

    def fileno(self) -> int:
        """Return the port's file descriptor, to wait until it is ready. Raises `OSError` if the system has none."""
        return self._port.fileno()

    def recv_into(self, buffer: bytearray) -> int:
        """Receive bytes into ``buffer`` and return their number, which is never 0.

        Raises:
            BlockingIOError: no bytes were received, or only damaged ones, which were passed to the session.
            LinkDown: the port is lost.
        """
        data, errors = self._port.read(0)
        overrun = bool(data) and self._overruns.more()
        if errors or overrun:
            self._session.receive_damaged(data, time.monotonic(), overrun=overrun)
            data = b""
        if not data:
            raise BlockingIOError
        buffer[: len(data)] = data
        return len(data)

    def send(self, data: bytes) -> int:
        """Send a whole frame and return its size; tell the session when its last character will have left.

        Raises `LinkDown` if the port is lost; a part of the frame may have gone out.
        """
        self._puts_off = 0
        self._session.written(self._port.write(data))
        return len(data)

    def still_sending(self) -> None:
        """Tell the session if the system still holds characters of the last frame, so that the timeout starts later."""
        if self._puts_off >= HOLDS_AT_MOST:
            return
        try:
            until = self._port.still_sending()
        except LinkDown:
            return  # the next read says so
        if until is not None:
            self._puts_off += 1
            self._session.still_sending(until)

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()
