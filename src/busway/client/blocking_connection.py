"""One open connection of a blocking link: its socket or port, and the frames that this has not accepted yet.

Knows a channel; knows no session and no thread. The lock of its link guards it, except while a thread waits.

1. Unsent frames are dropped with their connection. A link makes another object for its next connection, so no byte can
   leave on the wrong one.
2. Frames are sent one by one, in order: a datagram holds one, and a frame that was begun is completed first.
"""

import contextlib
import socket
from collections import deque
from collections.abc import Callable

from ..transport.tcp import discard_on_close
from .channel import Channel
from .polling import ExactPoll, Poll


class BlockingConnection:
    """An open connection of a blocking link with its unsent frames, until `close`.

    Attributes:
        channel: the socket or port.
        unsent: frames that the channel has not accepted yet; the first one may be half sent.
        frame_leaves: checks whether the last character has left, and tells the session; None if that is unknown.
    """

    __slots__ = ("_poll", "channel", "frame_leaves", "unsent")

    def __init__(self, channel: Channel, poll: Poll | ExactPoll) -> None:
        self.channel: Channel = channel
        self.unsent: deque[bytes] = deque()
        self.frame_leaves: Callable[[], None] | None = getattr(channel, "still_sending", None)
        self._poll = poll

    def send(self, frame: bytes) -> None:
        """Send a frame; what the socket does not accept waits for `flush`. Raises `OSError` if the connection ended."""
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
        """Send waiting frames as far as the socket accepts them. Raises `OSError` if the connection has ended."""
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
        """Wait, without the link's lock, until bytes can be received or sent; return False after ``seconds``."""
        return self._poll.wait(self.channel, seconds, bool(self.unsent))

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
