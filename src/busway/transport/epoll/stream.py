"""The transport of a stream socket in an `EpollSet`; it behaves as the transports of asyncio do.

Knows sockets and `asyncio.BufferedProtocol`; knows no Modbus.

1. The rules of asyncio's transports hold here: `connection_lost` is called once, after everything else and never from
   within another call of the protocol. If a protocol raises, the error is reported to the loop's exception handler, and
   only that connection is closed.
2. While no bytes wait to be sent, a write is one system call. Bytes that the system does not accept are kept, and the
   socket is watched for `WRITABLE` until they are sent.
3. A descriptor without wanted events is not watched at all: the system would report the end of its peer again and
   again.
4. The end of the peer's stream is reported once, even if reading is paused and resumed after it.
"""

import asyncio
import contextlib
import socket
import warnings
from asyncio.trsock import TransportSocket
from typing import Any, Final

from .watcher import READABLE, WRITABLE, EpollSet

_USUAL_HIGH: Final = 64 * 1024
"""Default number of bytes that may wait to be sent until the protocol is paused, as in asyncio."""


class EpollStream(asyncio.Transport):
    """The asyncio transport of one stream socket in an epoll set; `begin` starts it.

    Args:
        epoll_set: watches the socket.
        connection: connected, non-blocking socket; the transport closes it.
        protocol: gets the events; an `asyncio.BufferedProtocol` if it receives.
        peer: the address of the peer, as ``getpeername`` returns it.
    """

    __slots__ = (
        "_closing",
        "_descriptor",
        "_ended",
        "_epoll_set",
        "_events",
        "_finished",
        "_high",
        "_is_full",
        "_is_plain",
        "_lost",
        "_low",
        "_paused",
        "_peer",
        "_protocol",
        "_socket",
        "_unsent",
    )

    def __init__(
        self, epoll_set: EpollSet, connection: socket.socket, protocol: asyncio.BaseProtocol, peer: object
    ) -> None:
        # Without the dictionary that the base class would make: `get_extra_info` asks the socket.
        self._epoll_set = epoll_set
        # A socket, and None behind the end. To say so would cost an assertion at every receive and every write.
        self._socket: Any = connection
        self._descriptor = connection.fileno()
        self._protocol: Any = protocol  # of either kind, and buffered where it receives
        self._peer = peer
        self._events = 0  # what is watched for; 0: not watched
        self._unsent: bytearray | None = None  # made when it is needed: most connections never need it
        self._high = _USUAL_HIGH
        self._low: int | None = None  # a quarter of it; a number would be an object of each connection
        self._is_plain = True  # a write can go straight to the socket
        self._is_full = False  # the protocol was asked to pause writing
        self._paused = False
        self._ended = False  # the peer sends no more
        self._finished = False  # we send no more
        self._closing = False
        self._lost = False  # `connection_lost` was called, or is about to be

    def begin(self) -> None:
        """Call the protocol's `connection_made`, and start reading the socket.

        If `connection_made` raises, the connection is closed and the error reported to the event loop.

        Raises:
            OSError: the system cannot watch another descriptor; then `connection_lost` is called too.
        """
        try:
            self._protocol.connection_made(self)
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            self._fail(error, "protocol.connection_made() call failed")
            return
        try:
            self._watch()
        except OSError as error:
            self._force_close(error)
            raise

    # What the epoll set calls.

    def ready(self, events: int) -> None:
        """Read, write, or end the connection, because epoll reported ``events`` of the socket."""
        if events != READABLE and self._events & WRITABLE:
            self._send_rest()
        if not self._events & READABLE or events == WRITABLE:
            return
        protocol = self._protocol
        try:
            buffer = protocol.get_buffer(-1)
            size = self._socket.recv_into(buffer)
        except (BlockingIOError, InterruptedError):
            return
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            self._fail(error, "nothing could be received into protocol.get_buffer()")
            return
        if size:
            try:
                protocol.buffer_updated(size)
            except (SystemExit, KeyboardInterrupt):
                raise
            except BaseException as error:
                self._fail(error, "protocol.buffer_updated() call failed")
        elif len(buffer):
            self._end()
        else:
            self._fail(RuntimeError("get_buffer() returned an empty buffer"), "nowhere to receive into")

    def _end(self) -> None:
        """Handle the end of the peer's stream: close the connection, unless ``eof_received`` returns True."""
        self._ended = True
        try:
            stays = self._protocol.eof_received()
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            self._fail(error, "protocol.eof_received() call failed")
            return
        if stays:
            self._watch()
        else:
            self.close()

    # Sending.

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send bytes, after those that already wait to be sent; drop them if the connection has ended.

        What the system does not accept at once is kept and sent later.

        Raises:
            TypeError: ``data`` is not bytes-like.
            RuntimeError: `write_eof` was called before.
        """
        if not self._is_plain:
            self._write_behind(data)
            return
        try:
            sent = self._socket.send(data)
        except (BlockingIOError, InterruptedError):
            sent = 0
        except OSError as error:
            self._force_close(error)
            return
        if sent != len(data):
            self._keep(memoryview(data).cast("B")[sent:])

    def _write_behind(self, data: bytes | bytearray | memoryview) -> None:
        """Queue bytes after those that wait to be sent; drop them once the connection has ended.

        Bytes written after `close` are still queued as long as others wait to be sent.
        """
        if not isinstance(data, bytes | bytearray | memoryview):
            raise TypeError(f"data argument must be a bytes-like object, not {type(data).__name__!r}")
        if self._finished:
            raise RuntimeError("Cannot call write() after write_eof()")
        if not self._lost:
            self._keep(memoryview(data).cast("B"))

    def _keep(self, data: memoryview) -> None:
        if not data:
            return
        if self._unsent is None:
            self._unsent = bytearray()
        self._unsent += data
        self._is_plain = False
        if not self._events & WRITABLE:
            try:
                self._watch()
            except OSError as error:  # it was paused, and the system cannot watch another one
                self._force_close(error)
                return
        self._ask_to_pause()

    def _send_rest(self) -> None:
        assert self._unsent is not None  # since it is watched for
        try:
            sent = self._socket.send(self._unsent)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._force_close(error)
            return
        del self._unsent[:sent]
        if self._is_full and len(self._unsent) <= self._low_limit():
            self._is_full = False
            self._call("resume_writing")  # which may write
        if self._unsent or self._lost:
            return
        self._unsent = None
        if self._closing:
            self._lose_soon(None)
            return
        if self._finished:
            self._shut_down_sending()
        else:
            self._is_plain = True
        self._watch()

    def write_eof(self) -> None:
        """Close the sending direction after the waiting bytes are sent; receiving goes on."""
        if self._closing or self._finished:
            return
        self._finished = True
        self._is_plain = False
        if not self._unsent:
            self._shut_down_sending()

    def can_write_eof(self) -> bool:
        """Return True: the sending direction of a socket can be closed alone."""
        return True

    def _shut_down_sending(self) -> None:
        with contextlib.suppress(OSError):  # it has ended, which will be heard of otherwise
            self._socket.shutdown(socket.SHUT_WR)

    def get_write_buffer_size(self) -> int:
        """Number of bytes that wait to be sent."""
        return len(self._unsent) if self._unsent else 0

    def get_write_buffer_limits(self) -> tuple[int, int]:
        """The limits of the write buffer in bytes, as (low, high)."""
        return self._low_limit(), self._high

    def _low_limit(self) -> int:
        return self._high // 4 if self._low is None else self._low

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Set the limits of the write buffer in bytes: above ``high`` the protocol is paused, at ``low`` resumed.

        If only one is given, ``high`` is four times ``low``; if neither is, they are 64 and 16 KiB.

        Raises:
            ValueError: ``high`` is below ``low``, or ``low`` below 0.
        """
        if high is None:
            high = _USUAL_HIGH if low is None else 4 * low
        lower = high // 4 if low is None else low
        if not high >= lower >= 0:
            raise ValueError(f"high ({high!r}) must be >= low ({lower!r}) must be >= 0")
        self._high, self._low = high, low
        self._ask_to_pause()

    def _ask_to_pause(self) -> None:
        if not self._is_full and self.get_write_buffer_size() > self._high:
            self._is_full = True
            self._call("pause_writing")

    def _call(self, name: str) -> None:
        """Call a method of the protocol, if it has it; an exception is reported and does not end the connection."""
        try:
            getattr(self._protocol, name)()
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            self._report(error, f"protocol.{name}() failed")

    # Reading and the protocol.

    def is_reading(self) -> bool:
        """Whether the transport is reading, neither paused nor closing."""
        return not (self._paused or self._closing)

    def pause_reading(self) -> None:
        """Stop reading from the socket until `resume_reading`."""
        if not (self._closing or self._paused):
            self._paused = True
            self._watch()

    def resume_reading(self) -> None:
        """Read from the socket again after `pause_reading`."""
        if not self._closing and self._paused:
            self._paused = False
            try:
                self._watch()
            except OSError as error:  # the system cannot watch another one
                self._force_close(error)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Replace the asyncio protocol that gets the events of this transport."""
        self._protocol = protocol

    def get_protocol(self) -> asyncio.BaseProtocol:
        """Return the asyncio protocol that gets the events of this transport."""
        protocol: asyncio.BaseProtocol = self._protocol
        return protocol

    def get_extra_info(self, name: str, default: Any = None) -> Any:  # as `asyncio.BaseTransport` says it
        """Return a detail of the connection: ``peername``, ``sockname`` or ``socket``.

        ``default`` for other names, and after the end of the connection for all but ``peername``.
        """
        if name == "peername":
            return self._peer
        if self._socket is not None:
            if name == "socket":
                return TransportSocket(self._socket)
            if name == "sockname":
                with contextlib.suppress(OSError):
                    return self._socket.getsockname()
        return default

    def _watch(self) -> None:
        """Watch the socket: for reading unless paused or ending, for writing while bytes are unsent.

        Raises:
            OSError: the socket was not watched before, and the system cannot watch another descriptor.
        """
        wanted = 0
        if not (self._lost or self._closing or self._paused or self._ended):
            wanted = READABLE
        if self._unsent and not self._lost:
            wanted |= WRITABLE
        watched = self._events
        if wanted == watched:
            return
        if not wanted:
            self._events = 0
            self._epoll_set.forget(self._descriptor)
        elif watched:
            self._events = wanted
            self._epoll_set.watch_for(self._descriptor, wanted)
        else:
            self._epoll_set.watch(self._descriptor, wanted, self)
            self._events = wanted

    # The end.

    def is_closing(self) -> bool:
        """Whether the connection is closed, or about to be."""
        return self._closing

    def close(self) -> None:
        """Stop reading, and close the connection after the waiting bytes are sent.

        The protocol's `connection_lost` is called in a later turn of the event loop.
        """
        if not self._closing:
            self._closing = True
            if self._unsent:
                self._watch()
            else:
                self._lose_soon(None)

    def abort(self) -> None:
        """Close the connection at once; bytes that wait to be sent are dropped."""
        self._force_close(None)

    def _fail(self, error: BaseException, what: str) -> None:
        """Close the connection because of an error, which the protocol gets in ``connection_lost``.

        An error other than `OSError` is reported to the event loop's exception handler too.
        """
        if not isinstance(error, OSError):
            self._report(error, f"Fatal error: {what}")
        self._force_close(error)

    def _report(self, error: BaseException, message: str) -> None:
        context = {"message": message, "exception": error, "transport": self, "protocol": self._protocol}
        self._epoll_set.loop.call_exception_handler(context)

    def _force_close(self, error: BaseException | None) -> None:
        if not self._lost:
            self._unsent = None
            self._closing = True
            self._lose_soon(error)

    def _lose_soon(self, error: BaseException | None) -> None:
        self._lost = True
        self._is_plain = False
        self._watch()
        self._epoll_set.loop.call_soon(self._lose, error)

    def _lose(self, error: BaseException | None) -> None:
        """Call the protocol's `connection_lost` and close the socket.

        Called in a later turn of the event loop than the end of the connection: until then the system cannot give the
        descriptor's number to a new socket.
        """
        connection, protocol = self._socket, self._protocol
        assert connection is not None  # once
        try:
            protocol.connection_lost(error)
        finally:
            with contextlib.suppress(OSError):  # the system says once more that it has ended; it is closed all the same
                connection.close()
            self._socket = None
            self._protocol = None

    def __repr__(self) -> str:
        state = "closed" if self._socket is None else "closing" if self._closing else "open"
        return f"<{type(self).__name__} {state} fd={self._descriptor} peer={self._peer!r}>"

    def __del__(self) -> None:
        if self._socket is not None:
            warnings.warn(f"unclosed transport {self!r}", ResourceWarning, stacklevel=2, source=self)
            self._socket.close()
