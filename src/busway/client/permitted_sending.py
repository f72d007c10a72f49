"""Connections that send only while a function permits it, for links that other programs may take over.

Knows transports by their methods. A link holds requests back: for a pause, for a late reply, for a marker. So
permission is asked for when bytes leave, and not when a request is made.
"""

import asyncio
from collections.abc import Callable
from typing import Any, Final

from ..errors import LinkDown
from .channel import Channel
from .connector import Connector

NOT_PERMITTED: Final = "sending is not permitted now; this request was not sent"


class PermittedConnector:
    """Opens the connections of an asyncio link that may send only while a function returns True.

    Args:
        connector: opens the connections.
        may_send: returns whether bytes may leave now; called before each connection and each write of frames.
    """

    def __init__(self, connector: Connector, may_send: Callable[[], bool]) -> None:
        self._connector, self._may_send = connector, may_send

    async def connect(self, protocol: Callable[[], Any]) -> Any:  # Any: of whatever transport
        """Open a connection and return its transport, a `PermittedTransport`.

        ``protocol`` returns the object that gets the events of the transport.

        Raises:
            LinkDown: sending is not permitted now, and nothing was opened; or the connection cannot be opened.
        """
        if not self._may_send():
            raise LinkDown(NOT_PERMITTED, kind="other")
        made: list[Any] = []

        def noted() -> Any:
            made.append(protocol())
            return made[-1]

        transport = await self._connector.connect(noted)
        return PermittedTransport(transport, made[-1], self._may_send)

    def dial(self) -> Channel:
        """Open a connection of a blocking link; ``may_send`` is not asked for it. Raises `LinkDown`."""
        return self._connector.dial()

    def release(self) -> None:
        """Free what the connector holds, such as a serial port; called when the link is closed for good."""
        self._connector.release()


class PermittedTransport:
    """The transport of an open connection; resets the connection instead of sending while sending is not permitted.

    All attributes except `write` are those of the transport that sends.

    Args:
        transport: the transport that sends.
        protocol: gets the events of the transport.
        may_send: returns whether bytes may leave now.
    """

    __slots__ = ("_may_send", "_protocol", "_transport")

    def __init__(self, transport: Any, protocol: Any, may_send: Callable[[], bool]) -> None:
        self._transport, self._protocol, self._may_send = transport, protocol, may_send

    def __getattr__(self, name: str) -> Any:  # Any: what transports have differs
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send bytes if that is permitted now; otherwise drop them and reset the connection.

        After a reset, ``connection_lost`` of the protocol is called in the event loop's next turn.
        """
        if self._may_send():
            self._transport.write(data)
            return
        error = LinkDown(NOT_PERMITTED, kind="other")
        asyncio.get_running_loop().call_soon(self._protocol.connection_lost, error)
        self._transport.abort()
