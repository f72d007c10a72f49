"""The errors of this library, all derived from `ModbusError`.

::

    ModbusError
    ├─ InvalidRequest (ValueError)      the caller's mistake; nothing was sent
    ├─ ExceptionReply                   the device refused, or took it for later (05)
    ├─ BadReply                         the peer broke the protocol
    ├─ NoAnswer                         one of those below: the device has not answered
    │  ├─ NoReply (TimeoutError)        nothing | partial | late
    │  │  └─ UnitSuspended              not asked: the unit's breaker is open
    │  ├─ WriteOutcomeUnknown           a write left this host and no answer came
    │  └─ LinkDown (ConnectionError)    the connection could not be opened, or ended
    │     └─ LinkClosed                 the program itself has closed the link
    ├─ Overloaded                       the queue was full; nothing was sent
    └─ ConfigError (ValueError)         a setting, URL or file is invalid
       └─ MissingExtra (ImportError)    a required package is not installed

Rules:

1. Each error carries where and what as fields (`Where`); ``str()`` is one sentence for an operator.
2. An error ends one request. What must be counted and survived is an event, not an error.
3. The code that raises fills in the fields it knows; the drivers complete the rest with `ModbusError.at`.
"""

from typing import Literal, Self, TypeAlias

from .codes import ExceptionCode, exception_meaning, function_name


class ModbusError(Exception):
    """Base of all errors of this library.

    Attributes (each ``None`` where it does not apply or is not known):
        endpoint: URL of the peer.
        unit: unit identifier, 0…255.
        function: function code of the request, 1…127.
        address: first item that the request names, 0-based.
        attempt: number of the attempt that ended with this error, from 1.
        elapsed: seconds from the call to the error.
        raw: bytes that were received and could not be used; empty if none.
    """

    def __init__(
        self,
        message: str,
        *,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(message)
        self.message = message
        self.endpoint = endpoint
        self.unit = unit
        self.function = function
        self.address = address
        self.attempt = attempt
        self.elapsed = elapsed
        self.raw = raw

    def at(
        self,
        *,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
    ) -> Self:
        """Fill in those fields of the error (endpoint, unit, …) that are still unknown, and return it."""
        self.endpoint = endpoint if self.endpoint is None else self.endpoint
        self.unit = unit if self.unit is None else self.unit
        self.function = function if self.function is None else self.function
        self.address = address if self.address is None else self.address
        self.attempt = attempt if self.attempt is None else self.attempt
        self.elapsed = elapsed if self.elapsed is None else self.elapsed
        return self

    def __str__(self) -> str:
        where = []
        if self.endpoint is not None:
            where.append(self.endpoint)
        if self.unit is not None:
            where.append(f"unit {self.unit}")
        if self.function is not None:
            where.append(f"function {function_name(self.function)}")
        if self.address is not None:
            where.append(f"address {self.address}")
        tail = []
        if self.attempt is not None and self.attempt > 1:
            tail.append(f"attempt {self.attempt}")
        if self.elapsed is not None:
            tail.append(f"after {self.elapsed:.3f} s")
        if self.raw:
            shown = self.raw[:64].hex(" ")
            tail.append(f"received {shown}{' …' if len(self.raw) > 64 else ''}")
        sentence = self.message
        if where:
            sentence = f"{', '.join(where)}: {sentence}"
        if tail:
            sentence = f"{sentence} ({', '.join(tail)})"
        return sentence


class InvalidRequest(ModbusError, ValueError):
    """The request is invalid: a quantity, address, value or unit is out of range. Nothing was sent."""


class ExceptionReply(ModbusError):
    """The device answered with an exception code (Application Protocol V1.1b3 §7).

    Code 05 (acknowledge) is an acceptance: the device took the request and needs time.

    Attributes:
        code: the exception code, 0…255; codes outside the specification are reported as they came.
        from_gateway: whether a gateway answered (0A, 0B) and not the device.
    """

    def __init__(
        self,
        code: int,
        *,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(
            f"the device answered with exception {code:02X}, {exception_meaning(code)}",
            endpoint=endpoint,
            unit=unit,
            function=function,
            address=address,
            attempt=attempt,
            elapsed=elapsed,
            raw=raw,
        )
        self.code = code

    @property
    def from_gateway(self) -> bool:
        """Whether the code is one that only gateways send (0A, 0B)."""
        return self.code in (
            ExceptionCode.GATEWAY_PATH_UNAVAILABLE,
            ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND,
        )


BadReplyKind: TypeAlias = Literal["stream", "protocol", "unit", "function", "content", "value", "other"]
"""What is wrong with a reply: the values of `BadReply.kind`."""
LinkDownKind: TypeAlias = Literal[
    "unresolved",
    "refused",
    "unreachable",
    "timeout",
    "tls",
    "missing",
    "taken",
    "lost",
    "closed",
    "local",
    "other",
]
"""Why there is no connection: the values of `LinkDown.kind`."""


class BadReply(ModbusError):
    """The peer broke the protocol: another function, a wrong length, a wrong echo. ``raw`` holds the bytes.

    Attributes:
        reason: what is wrong with them, in words.
        kind: the same for a program. ``"stream"``: a length field that no message can have, after which nothing can be
            decoded; ``"protocol"``: the protocol identifier is not 0; ``"unit"``: another unit answered;
            ``"function"``: it answers another function; ``"content"``: its length, echo or a field does not fit the
            request; ``"value"``: its registers hold no value of the type that was asked for; ``"other"``: a reply that
            is not Modbus.
    """

    def __init__(
        self,
        reason: str,
        *,
        kind: BadReplyKind = "other",
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(
            f"the reply is broken: {reason}",
            endpoint=endpoint,
            unit=unit,
            function=function,
            address=address,
            attempt=attempt,
            elapsed=elapsed,
            raw=raw,
        )
        self.reason = reason
        self.kind: BadReplyKind = kind


class NoAnswer(ModbusError):
    """Base of the errors for a device that has not answered: silence, no connection, or an unknown write outcome.

    Catch it where the difference does not matter; it is never raised itself. It does not cover a device that refused or
    broke the protocol, which is an answer (`ExceptionReply`, `BadReply`), nor requests that were never sent for a
    reason in this program (`InvalidRequest`, `Overloaded`, `ConfigError`).

    Code that repeats a call on this error repeats writes too: catch `WriteOutcomeUnknown` first.
    """


class NoReply(NoAnswer, TimeoutError):
    """Error: no usable reply came in time.

    Attributes:
        kind: ``"nothing"`` came, ``"partial"`` (some bytes, no whole frame), ``"late"`` (a unit known to answer after
            the timeout; ``observed_delay`` says how late its last reply was), ``"early"`` (a frame that began before
            the request had left is no reply to it), or ``"in doubt"`` (nothing was sent, because the unit owes replies
            that could be taken for the one to this request).
        observed_delay: seconds from request to reply that this unit needed lately, if it was seen.
    """

    def __init__(
        self,
        message: str,
        *,
        kind: str = "nothing",
        observed_delay: float | None = None,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(
            message,
            endpoint=endpoint,
            unit=unit,
            function=function,
            address=address,
            attempt=attempt,
            elapsed=elapsed,
            raw=raw,
        )
        self.kind = kind
        self.observed_delay = observed_delay


class UnitSuspended(NoReply):
    """The unit did not answer several times in a row and is not asked now. Nothing was sent.

    Attributes:
        next_probe: seconds until a request may probe it again.
    """

    def __init__(
        self,
        message: str,
        *,
        next_probe: float,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
    ) -> None:
        super().__init__(message, endpoint=endpoint, unit=unit, function=function, address=address)
        self.next_probe = next_probe


class Overloaded(ModbusError):
    """Error: a bounded queue was full. Nothing was sent."""


class WriteOutcomeUnknown(NoAnswer):
    """A write left this host and no valid answer came: it may have been executed or not. Not repeated automatically.

    ``__cause__`` holds what happened (`NoReply`, `LinkDown`, `BadReply`, or `ExceptionReply` 0B of a gateway).
    """


class LinkDown(NoAnswer, ConnectionError):
    """Error: the connection could not be opened, or it ended before the reply.

    Attributes:
        sent: whether bytes of the request may have left this host.
        kind: why, for a program. ``"unresolved"``: the host name has no address; ``"refused"``: nothing listens there;
            ``"unreachable"``: no way to the host; ``"timeout"``: no connection in time, or a port takes no bytes;
            ``"tls"``: the handshake or a certificate failed; ``"missing"``: there is no such port or file;
            ``"taken"``: another program holds the port; ``"lost"``: the connection or port ended; ``"closed"``: this
            program closed the link; ``"local"``: this host does not allow it (rights, limits, a local address);
            ``"other"``: none of these.
    """

    def __init__(
        self,
        message: str,
        *,
        kind: LinkDownKind = "other",
        sent: bool = False,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
        attempt: int | None = None,
        elapsed: float | None = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(
            message,
            endpoint=endpoint,
            unit=unit,
            function=function,
            address=address,
            attempt=attempt,
            elapsed=elapsed,
            raw=raw,
        )
        self.sent = sent
        self.kind: LinkDownKind = kind


class LinkClosed(LinkDown):
    """The program closed this link before the call. Nothing was sent; retrying does not help: open another link.

    Its ``kind`` is always ``"closed"``.
    """

    def __init__(
        self,
        message: str,
        *,
        endpoint: str | None = None,
        unit: int | None = None,
        function: int | None = None,
        address: int | None = None,
    ) -> None:
        super().__init__(message, kind="closed", endpoint=endpoint, unit=unit, function=function, address=address)


class ConfigError(ModbusError, ValueError):
    """A setting, URL or configuration file is invalid.

    Attributes:
        file: path of the file, if one is at fault.
        line: 1-based line in it, if known.
        key: the key or option at fault, dotted.
    """

    def __init__(
        self, message: str, *, file: str | None = None, line: int | None = None, key: str | None = None
    ) -> None:
        super().__init__(message)
        self.file = file
        self.line = line
        self.key = key

    def __str__(self) -> str:
        place = self.file or ""
        if self.line is not None:
            place = f"{place}:{self.line}" if place else f"line {self.line}"
        parts = [part for part in (place, self.key) if part]
        return f"{': '.join(parts)}: {self.message}" if parts else self.message


class MissingExtra(ConfigError, ImportError):
    """A required package is not installed; the message ends with the command that installs it.

    Attributes:
        package: the package that is missing.
        extra: the extra of busway that brings it: ``serial``, ``cli``, ``files`` …
    """

    def __init__(self, package: str, extra: str, *, purpose: str, key: str | None = None) -> None:
        super().__init__(f"{purpose} needs the package {package}: pip install 'busway[{extra}]'", key=key)
        self.package = package
        self.extra = extra
