"""One open connection of a blocking link: its socket or port, and the frames that are not sent yet.

Knows a channel; knows no session and no thread. It is used under the lock of its link, except for `wait`.

1. Unsent frames are dropped with their connection. A link creates another object for its next connection, so no byte
   can leave on the wrong connection.
2. Frames are sent one by one, in order: a datagram holds one frame, and a half-sent frame is completed first.
"""

import contextlib
import socket
from collections import deque
from collections.abc import Callable

from ..transport.tcp import discard_on_close
from .channel import Channel
from .readiness import PortReadiness, SocketReadiness


class BlockingConnection:
    """An open connection of a blocking link, with its unsent frames.

    Attributes:
        channel: the socket or port.
        unsent: frames that the system has not accepted yet, in order; the first may be the rest of a frame.
        frame_leaves: function that tells the session if the serial port still holds characters of a sent frame; None
            for other connections.
    """

    __slots__ = ("_readiness", "channel", "frame_leaves", "unsent")

    def __init__(self, channel: Channel, readiness: SocketReadiness | PortReadiness) -> None:
        self.channel: Channel = channel
        self.unsent: deque[bytes] = deque()
        self.frame_leaves: Callable[[], None] | None = getattr(channel, "still_sending", None)
        self._readiness = readiness

    def send(self, frame: bytes) -> None:
        """Send a frame; bytes that the system does not accept now are sent later by `flush`.

        If there are unsent frames already, the whole frame waits behind them.

        Raises `OSError` if the connection has ended; a part of the frame may have gone out.
        """
        if not self.unsent:
            try:
                sent = self.channel.send(frame)
            except BlockingIOError:
                sent = 0
            if sent == len(frame):
                return
            frame = frame[sent:]
        self.unsent.append(frame)

    def flush(self) -> None:
        """Send the unsent frames, as far as the system accepts them. Raises `OSError` if the connection has ended."""
        unsent = self.unsent
        while unsent:
            frame = unsent[0]
            try:
                sent = self.channel.send(frame)
            except BlockingIOError:
                return
            if sent < len(frame):
                unsent[0] = frame[sent:]
                return
            unsent.popleft()

    def wait(self, seconds: float) -> bool:
        """Wait until bytes can be received, or unsent frames can be sent; return whether they can.

        Returns False if ``seconds`` were over first, or if another thread closed the connection. Call it without the
        lock of the link. At a serial port it can return False earlier.
        """
        return self._readiness.wait(self.channel, seconds, bool(self.unsent))

    def close(self) -> None:
        """Close the socket or port and drop unsent frames."""
        channel = self.channel
        # A channel that has ended already may say so once more: then it is closed all the same.
        if isinstance(channel, socket.socket):
            if self.unsent:
                discard_on_close(channel)
            with contextlib.suppress(OSError):
                channel.shutdown(socket.SHUT_RDWR)  # closing alone does not wake a thread that waits at the socket
        with contextlib.suppress(OSError):
            channel.close()
        self.unsent.clear()
