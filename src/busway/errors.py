"""The errors of this library, all derived from `ModbusError`.

::

    ModbusError
    ├─ InvalidRequest (ValueError)      the caller's mistake; nothing was sent
    ├─ ExceptionReply                   the device refused, or accepted and needs time (05)
    ├─ BadReply                         the peer broke the protocol
    ├─ NoAnswer                         one of those below: the device has not answered
    │  ├─ NoReply (TimeoutError)        no usable reply came in time
    │  │  └─ UnitSuspended              not asked: the circuit breaker of the unit is open
    │  ├─ WriteOutcomeUnknown           a write left this host and no valid answer came
    │  └─ LinkDown (ConnectionError)    the connection could not be opened, or ended
    │     └─ LinkClosed                 the program itself has closed the link
    ├─ Overloaded                       a limit for waiting calls or links is reached; nothing was sent
    └─ ConfigError (ValueError)         a setting, URL or file is invalid
       └─ MissingExtra (ImportError)    a required package is not installed

Rules:

1. Each error holds what is known of its request as fields (endpoint, unit, function …); ``str()`` is one sentence for
   an operator.
2. An error ends one request. What is only counted, while work goes on (such as a damaged frame), is an event.
3. The code that raises an error fills in the fields it knows; the code around it adds the others with `ModbusError.at`.
"""

from typing import Literal, Self, TypeAlias

from .codes import ExceptionCode, exception_meaning, function_name


class ModbusError(Exception):
    """Base of all errors of this library.

    Attributes (each ``None`` where it does not apply or is not known):
        message: what is wrong, in words, without the facts in the other fields; never None.
        endpoint: URL of the device, line or server that was asked.
        unit: unit identifier, 0…255.
        function: function code of the request, 1…127.
        address: address of the first coil or register in the request, 0-based.
        attempt: number of the attempt that ended with this error; the first is 1.
        elapsed: seconds from the application's call to the error.
        raw: bytes that were received and could not be used; never None: ``b""`` if there are none.
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
        """Fill in those fields of this error that are still ``None``, and return this error.

        Fields that have a value keep it.
        """
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
    """Error: the request is invalid, because a quantity, address, value or unit is out of range. Nothing was sent."""


class ExceptionReply(ModbusError):
    """Error: the device answered with an exception code (Application Protocol V1.1b3 §7).

    Code 05 (acknowledge) is no refusal: the device has accepted the request and needs time to execute it.

    Attributes:
        code: the exception code as received, 0…255, also one outside the specification.
        from_gateway: whether the code is 0A or 0B, which a gateway sends when it cannot reach the device.
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
        """Whether the code is 0A or 0B, which only a gateway sends, because it cannot reach the device."""
        return self.code in (
            ExceptionCode.GATEWAY_PATH_UNAVAILABLE,
            ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND,
        )


BadReplyKind: TypeAlias = Literal["stream", "protocol", "unit", "function", "content", "value", "other"]
"""The values of `BadReply.kind`, which say what is wrong with a reply; `BadReply` explains each."""
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
"""The values of `LinkDown.kind`, which say why there is no connection; `LinkDown` explains each."""


class BadReply(ModbusError):
    """Error: a reply breaks the protocol: another function, a wrong length, a wrong echo. ``raw`` holds its bytes.

    Attributes:
        reason: what is wrong with the reply, in words.
        kind: what is wrong with the reply, for a program to compare. ``"stream"``: its length field has a value that no
            message can have, and what follows on the connection cannot be decoded; ``"protocol"``: its protocol
            identifier is not 0; ``"unit"``: another unit answered; ``"function"``: it has the code of another function;
            ``"content"``: its length, echo or a field does not fit the request; ``"value"``: its registers hold no
            value of the type that was asked for; ``"other"``: none of these, such as an answer that is not Modbus.
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

    Only its subclasses are raised; catch this class where the difference between them does not matter. It does not
    include a device that answered with a refusal or broke the protocol (`ExceptionReply`, `BadReply`), nor a request
    that this program refused to send (`InvalidRequest`, `Overloaded`, `ConfigError`).

    Code that catches this error and repeats the call would repeat writes whose outcome is unknown: catch
    `WriteOutcomeUnknown` before it.
    """


class NoReply(NoAnswer, TimeoutError):
    """Error: no usable reply came in time.

    Attributes:
        kind: what was received, for a program to compare. ``"nothing"``: no reply; ``"partial"``: only a part of a
            frame, or a damaged frame; ``"late"``: no reply, but an earlier reply of this unit came after its timeout
            (see ``observed_delay``); ``"early"``: only a frame that began too early to be the reply (on a line: before
            t3.5 had passed since the request); ``"in doubt"``: nothing was sent, because the unit owes earlier replies,
            and one of them could be taken for the reply to this request.
        observed_delay: seconds from request to reply for the last late reply of this unit; None if none was seen.
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
    """Error: the request was not sent, or not repeated, because its unit is silent and its circuit breaker open.

    It opens after several timeouts in a row. For some seconds all requests to the unit then fail in this way; the first
    request after that is sent, to see whether the unit answers, and meanwhile the others still fail. A late reply of
    the unit ends this early. ``attempt`` is None if the request was never sent, else the number of its last attempt.

    Attributes:
        next_probe: seconds, counted from this error, until the next request to the unit may be sent; while one is in
            flight to see whether it answers, until the timeout of that one.
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
    """Error: a limit of this program is reached, such as the number of calls that wait on a link. Nothing was sent."""


class WriteOutcomeUnknown(NoAnswer):
    """Error: a write left this host and no valid answer came, so the device may or may not have executed it.

    The write is not repeated automatically. ``__cause__`` holds what happened instead of an answer (`NoReply`,
    `LinkDown`, `BadReply`, or `ExceptionReply` 0B of a gateway).
    """


class LinkDown(NoAnswer, ConnectionError):
    """Error: the connection could not be opened, or it ended before the reply.

    Attributes:
        sent: whether bytes of the request may have left this host.
        kind: the cause, for a program to compare. ``"unresolved"``: the host name has no address; ``"refused"``:
            nothing listens at the address; ``"unreachable"``: there is no network path to the host; ``"timeout"``: no
            connection in time, or the port accepts no bytes; ``"tls"``: the handshake or a certificate failed;
            ``"missing"``: there is no such serial port or file; ``"taken"``: another program holds the serial port;
            ``"lost"``: an open connection or serial port ended; ``"closed"``: this program closed the link;
            ``"local"``: this host does not allow the connection (rights, limits, a local address or interface);
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
    """Error: this program closed the link before the call. Nothing was sent; the link cannot be used again.

    Open another link instead of repeating the call. ``kind`` is always ``"closed"``.
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
    """Error: a setting, URL or file is invalid, or a file that a setting names cannot be used.

    Attributes:
        file: path of the invalid file; None if the error is in no file.
        line: number of the invalid line in ``file``, 1-based; None if not known.
        key: the invalid key or option, dotted: ``server.port``; None if not known.
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
    """Error: an optional package is needed and not installed; the message ends with the command that installs it.

    Attributes:
        package: import name of the missing package.
        extra: the extra of busway that installs the package: ``serial``, ``cli``, ``files`` …
    """

    def __init__(self, package: str, extra: str, *, purpose: str, key: str | None = None) -> None:
        super().__init__(f"{purpose} needs the package {package}: pip install 'busway[{extra}]'", key=key)
        self.package = package
        self.extra = extra
