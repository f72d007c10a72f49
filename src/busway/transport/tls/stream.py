"""TLS of one connection without IO: encrypted bytes in and out; used by the asyncio and the blocking driver.

Knows ``ssl``; knows no socket, no event loop and no Modbus.

1. Modbus frames and TLS records are independent: a frame may be split over records, and a record may hold several.
2. The bytes of `outgoing` have to be sent after every call, also after a failure: then they are the fatal alert. The
   TLS of asyncio is not used, because it drops the alert and keeps a quarter of a megabyte for each connection.
"""

import ssl
from typing import Any

from .failures import FailureKind, TlsFailure, failure_of


class TlsStream:
    """One side of a TLS connection, without IO: the driver passes received bytes in and sends what comes out.

    Attributes:
        ended: whether the peer has announced the end of its stream.
        heard: whether any decrypted bytes were received.
        may_hold_more: whether to call `read_into` again: some bytes did not fit into its buffer or were never read, or
            there is a failure to raise.
    """

    __slots__ = ("_failure", "_incoming", "_outgoing", "_server_side", "_ssl", "ended", "heard", "may_hold_more")

    def __init__(self, context: ssl.SSLContext, *, server_side: bool, server_name: str | None = None) -> None:
        self._incoming = ssl.MemoryBIO()
        self._outgoing = ssl.MemoryBIO()
        self._server_side = server_side
        self._ssl = context.wrap_bio(
            self._incoming, self._outgoing, server_side=server_side, server_hostname=server_name
        )
        self._failure: TlsFailure | None = None  # found behind bytes that were good
        self.ended: bool = False
        self.heard: bool = False
        self.may_hold_more: bool = False

    @property
    def ssl_object(self) -> ssl.SSLObject:
        """The ``ssl`` object of the TLS connection: version, suite, certificate."""
        return self._ssl

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Store encrypted bytes received from the peer, for `handshake` or `read_into`."""
        self._incoming.write(data)
        self.may_hold_more = True

    def handshake(self) -> bool:
        """Continue the TLS handshake with the bytes received so far. Returns whether it is complete.

        Raises `TlsFailure` if it failed; `outgoing` then returns the alert.
        """
        try:
            self._ssl.do_handshake()
        except ssl.SSLWantReadError:
            return False
        except ssl.SSLError as error:
            raise failure_of(error, server_side=self._server_side) from error
        except ValueError as error:  # OpenSSL would not even begin, with a name that is none
            raise TlsFailure(FailureKind.OTHER, f"TLS failed: {error}") from error
        return True

    def read_into(self, room: memoryview) -> int:
        """Decrypt received bytes into the buffer ``room``. Returns the number of decrypted bytes.

        0 if no record is complete, or if the peer has ended its stream (``ended``). Raises `TlsFailure` for a record
        that is broken, once the bytes before it were returned.
        """
        if self._failure is not None:
            raise self._failure
        most = len(room)
        size: int = 0
        while size < most:
            try:
                got: Any = self._ssl.read(most - size, room[size:] if size else room)
            except ssl.SSLWantReadError:
                break
            except ssl.SSLZeroReturnError:
                got = 0
            except ssl.SSLError as error:
                self._failure = failure_of(error, server_side=self._server_side)
                if size:
                    break
                raise self._failure from error
            if not got:
                self.ended = True
                break
            size += got
            self.heard = True
            if not self._incoming.pending and not self._ssl.pending():
                self.may_hold_more = False
                return size  # without asking, which costs an exception
        self.may_hold_more = bool(self._ssl.pending() or self._incoming.pending or self._failure)
        return size

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Encrypt bytes for the peer; `outgoing` returns the result. Raises `TlsFailure` if TLS cannot send more."""
        written, size = 0, len(data)
        try:
            while written < size:  # once, unless it is more than a record can hold
                written += self._ssl.write(memoryview(data)[written:] if written else data)
        except ssl.SSLError as error:
            raise failure_of(error, server_side=self._server_side) from error

    def end_reason(self, error: Exception | None) -> Exception | None:
        """Return the reason for the end of a connection that had no TLS failure.

        It is ``error``, the error of the network (None without one). But if a client never received a decrypted byte,
        and ``error`` is None or a `ConnectionError`, it is a `TlsFailure`: many TLS 1.3 servers refuse a certificate by
        closing without an alert, when the client's handshake is already complete.
        """
        if self._server_side or self.heard or not (error is None or isinstance(error, ConnectionError)):
            return error
        sentence = "the server closed the connection without a word: it may not accept our certificate, or its role"
        failure = TlsFailure(FailureKind.GONE, sentence)
        failure.__cause__ = error
        return failure

    def outgoing(self) -> bytes:
        """Return the encrypted bytes to send to the peer now; may be empty."""
        return self._outgoing.read() if self._outgoing.pending else b""

    def finish(self) -> None:
        """Announce to the peer that nothing more is sent (close_notify); `outgoing` returns the bytes of that.

        Without it the TLS session could not be resumed. Does nothing if the handshake is not complete.
        """
        try:
            self._ssl.unwrap()
        except (ssl.SSLError, ValueError):
            return  # the peer's own end is not waited for; or there was no agreement to end
