"""TLS for blocking clients: a connection with the methods of a non-blocking socket.

Knows a socket and a `TlsStream`; knows no Modbus.

1. All bytes that one call receives are decrypted and returned together: none stay inside, where ``poll`` on the socket
   would not report them.
2. Bytes cannot be encrypted twice. If the socket accepts only a part of them, the next `send` sends the rest first, and
   only then reports the plain bytes as sent.
"""

import contextlib
import socket
import ssl
import time
from typing import Final

from ..receive_buffer import RECEIVE_SIZE
from ..tcp import discard_on_close
from .failures import FailureKind, TlsFailure
from .stream import TlsStream

_RECORDS_SIZE: Final = 32_768
"""Most encrypted bytes that one call receives. Decrypted, together with the rest of a record before them (16 KiB), they
fit into `RECEIVE_SIZE`.
"""
assert _RECORDS_SIZE + 2 * 16_384 <= RECEIVE_SIZE


class TlsSocket:
    """A TLS connection of a blocking client, used like a non-blocking socket.

    Args:
        connection: connected, blocking socket; this object closes it.
        context: of `client_context`.
        server_name: the name that the server's certificate must have.
        timeout: seconds for the handshake.

    Raises:
        TlsFailure, OSError: the handshake failed; the connection is closed.
    """

    def __init__(
        self, connection: socket.socket, context: ssl.SSLContext, *, server_name: str | None, timeout: float
    ) -> None:
        self._socket = connection
        self._records = bytearray(_RECORDS_SIZE)
        self._unsent = b""
        self._encrypted = 0  # plain bytes that stand in ``_unsent``
        try:
            self._stream = TlsStream(context, server_side=False, server_name=server_name)
            self._shake_hands(time.monotonic() + timeout, timeout)
            connection.setblocking(False)
        except BaseException:
            connection.close()
            raise

    def _shake_hands(self, until: float, timeout: float) -> None:
        while True:
            try:
                done = self._stream.handshake()
            finally:
                records = self._stream.outgoing()  # or the alert that says why not
                if records:
                    self._socket.settimeout(max(until - time.monotonic(), 0.001))
                    with contextlib.suppress(ConnectionError):  # what the server said before it went tells more
                        self._socket.sendall(records)
            if done:
                return
            self._socket.settimeout(max(until - time.monotonic(), 0.001))
            try:
                size = self._socket.recv_into(self._records)
            except TimeoutError:
                raise TlsFailure(FailureKind.TOO_SLOW, f"TLS was not agreed on within {timeout:g} s") from None
            if not size:
                raise TlsFailure(FailureKind.GONE, "the server closed the connection before both sides had agreed")
            self._stream.feed(memoryview(self._records)[:size])

    @property
    def ssl_object(self) -> ssl.SSLObject:
        """The ``ssl`` object of the TLS connection, with version, suite and certificate."""
        return self._stream.ssl_object

    def fileno(self) -> int:
        """Return the file descriptor of the socket, for waiting until it is ready."""
        return self._socket.fileno()

    def get_extra_info(self, name: str) -> object:
        """Return a detail of the connection, ``socket`` or ``ssl_object``; None for any other name."""
        return {"socket": self._socket, "ssl_object": self._stream.ssl_object}.get(name)

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive decrypted bytes into ``buffer``, which must have at least `RECEIVE_SIZE` bytes; return their number.

        0 means that the server has ended the stream.

        Raises:
            BlockingIOError: no bytes have been received.
            TlsFailure, OSError: the connection has ended.
        """
        plain = 0
        while not plain:  # what has come may be of TLS alone: tickets of a session
            try:
                size = self._socket.recv_into(self._records)
            except ConnectionError as error:
                reason = self._stream.end_reason(error)
                if reason is None or reason is error:
                    raise
                raise reason from error
            if size:
                self._stream.feed(memoryview(self._records)[:size])
                plain = self._stream.read_into(memoryview(buffer))
            if not size or (self._stream.ended and not plain):
                reason = self._stream.end_reason(None)
                if reason is not None:
                    raise reason
                return 0
        return plain

    def send(self, data: bytes, /) -> int:
        """Encrypt bytes and send them. Returns how many bytes of ``data`` were sent.

        After a `BlockingIOError` the next call must begin with the same bytes: it sends the rest of these alone, and
        returns their number.

        Raises:
            BlockingIOError: the socket accepts no more bytes now.
            TlsFailure, OSError: the connection has ended.
        """
        if not self._unsent:
            self._stream.write(data)
            self._encrypted = len(data)
            self._unsent = self._stream.outgoing()
        while self._unsent:
            self._unsent = self._unsent[self._socket.send(self._unsent) :]
        return self._encrypted

    def close(self) -> None:
        """Announce the end of the TLS stream (close_notify) if that is possible without waiting, and close the socket.

        A thread that waits for the socket wakes up.
        """
        with contextlib.suppress(OSError):
            if self._unsent:
                discard_on_close(self._socket)
            else:
                self._stream.finish()
                self._socket.send(self._stream.outgoing())
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
