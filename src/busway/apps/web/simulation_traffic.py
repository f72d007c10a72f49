"""Keeps the latest Modbus frames of a simulation for its page; frames are explained only when they are shown.

Knows frames and times; knows no page. `Traffic` registers with `busway.observe.trace` in place of a capture file, and
passes everything on to the capture file if there is one.

1. To keep a frame costs 8 µs and the memory for its bytes. To explain it costs ten times as much, so that is done once,
   and only for frames that are shown.
2. Frames are numbered. A client asks for the frames after a number, and learns how many of them are kept no longer.
3. Frames of the client connections and client links of this program are left out.
4. Lines record in threads of their own too (`busway.observe.line_trace`): a lock is held while a frame gets its number.
"""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING, Any, Final

from ...errors import ConfigError
from ...framing.mbap import FrameKind, MbapReceiver
from ...framing.received import Damaged, Direction, FrameOrDamage
from ...observe.socket_addresses import SocketAddresses
from ...observe.trace import TRACE
from ...observe.wording import described, in_words
from ...options.networks import peer_name
from ...pdu.functions import STANDARD, FunctionTable
from ...pdu.message import Message
from .simulation_messages import FieldAnswer, FrameAnswer

if TYPE_CHECKING:
    from ...observe.trace import ConnectionRecorder, LineRecorder, Recorder

KEPT: Final = 2000
"""Number of the latest frames that are kept, by default."""
_ASKED: Final = 16
"""Most unanswered requests that are remembered for a connection; a server accepts no more anyway."""


class Passed:
    """One recorded Modbus frame, or recorded damaged bytes.

    Attributes:
        number: number of the frame, counted from 1.
        at: when the frame was recorded, seconds since 1970 UTC.
        peer: the other end of the connection, or the name of the line.
        is_reply: True for a reply, or for damaged bytes that this program sent; False for a request, or for damaged
            bytes that it received.
        pdu: the PDU, or the damaged bytes.
        unit: unit number; None for damaged bytes.
        transaction: transaction identifier; None for damaged bytes and on lines.
        asked: for a reply, the PDU of its request; empty if the request is not known.
        seconds: for a reply, seconds since its request; None if the request is not known.
        reason: why the bytes are damaged; empty for a frame.
        shown: the frame explained for the page; None until it is shown for the first time.
    """

    __slots__ = (
        "asked",
        "at",
        "is_reply",
        "number",
        "pdu",
        "peer",
        "reason",
        "seconds",
        "shown",
        "transaction",
        "unit",
    )

    def __init__(
        self,
        number: int,
        at: float,
        peer: str,
        pdu: bytes,
        *,
        is_reply: bool,
        unit: int | None = None,
        transaction: int | None = None,
        reason: str = "",
    ) -> None:
        self.number: int = number
        self.at: float = at
        self.peer: str = peer
        self.pdu: bytes = pdu
        self.is_reply: bool = is_reply
        self.unit: int | None = unit
        self.transaction: int | None = transaction
        self.reason: str = reason
        self.asked: bytes = b""
        self.seconds: float | None = None
        self.shown: FrameAnswer | None = None


class Traffic:
    """Records the latest Modbus frames on connections and lines that are opened between `start` and `stop`.

    Args:
        ports: called for each new connection with Modbus TCP framing; returns the ports that the server listens on.
            Such connections with another local port are not recorded.
        kept: number of the latest frames that are kept.
        functions: the table of functions with which PDUs are explained.
        clock: returns seconds since 1970 UTC.

    Attributes:
        last: number of the latest frame; 0 before the first.
    """

    def __init__(
        self,
        ports: Callable[[], Collection[int]] = tuple,
        *,
        kept: int = KEPT,
        functions: FunctionTable = STANDARD,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.last: int = 0
        self._ports = ports
        self._functions = functions
        self._clock = clock
        self._tail: deque[Passed] = deque(maxlen=kept)
        self._lock = threading.Lock()
        self._watchers: tuple[Callable[[], None], ...] = ()
        self._before: Recorder | None = None
        self._is_on = False

    def start(self) -> None:
        """Record the frames of connections opened from now on, and pass them on to the capture file if there is one.

        Raises:
            ConfigError: this object is recording already.
        """
        if self._is_on:
            raise ConfigError("the traffic is recorded already", key="traffic")
        self._is_on = True
        self._before = TRACE.capture
        TRACE.capture_into(self)

    def stop(self) -> None:
        """Record no connection that is opened from now on; open ones are recorded until they end.

        The frames recorded so far stay available.
        """
        self._is_on = False
        if TRACE.capture is self:
            below = self._before
            while isinstance(below, Traffic) and not below._is_on:  # it was stopped while this one stood on it
                below = below._before
            TRACE.capture_into(below)

    def watch(self, passed: Callable[[], None]) -> Callable[[], None]:
        """Register a function that is called after each recorded frame. Returns a function that unregisters it.

        The function is called without arguments, in the thread that recorded the frame.
        """
        self._watchers = (*self._watchers, passed)

        def unwatch() -> None:
            self._watchers = tuple(one for one in self._watchers if one is not passed)

        return unwatch

    # What was seen.

    def after(self, number: int, limit: int) -> list[Passed]:
        """Return the latest ``limit`` kept frames whose number is greater than ``number``, the oldest first."""
        found: list[Passed] = []
        with self._lock:
            tail = tuple(self._tail)
        for one in reversed(tail):
            if one.number <= number or len(found) == limit:
                break
            found.append(one)
        return found[::-1]

    @property
    def first(self) -> int:
        """Number of the oldest frame that is kept; ``last`` + 1 if none is kept."""
        return self._tail[0].number if self._tail else self.last + 1

    def shown(self, passed: Passed) -> FrameAnswer:
        """Return a recorded frame as the page shows it, explained field by field; the same object at each call."""
        if passed.shown is None:
            passed.shown = self._described(passed)
        return passed.shown

    # The interface of a recorder of the trace.

    def connection(self, addresses: SocketAddresses) -> "ConnectionRecorder":
        """Return the recorder for the bytes of a new Modbus connection. Called by `busway.observe.trace`.

        The bytes of a connection whose local port is none of the server's, or that is opened after `stop`, go to the
        capture file alone, or nowhere if there is none.
        """
        onward = None if self._before is None else self._before.connection(addresses)
        local = addresses.local
        port = local[1] if isinstance(local, tuple) and len(local) > 1 else None
        if not self._is_on or port not in self._ports():
            return onward if onward is not None else _NOTHING
        return _Connection(self, peer_name(addresses.peer), onward)

    def line(self, name: str, *, is_server: bool = True) -> "LineRecorder":
        """Return the recorder for the frames of a serial line, or of a connection with serial framing.

        Called by `busway.observe.trace` for each such line or connection of this program. Frames of one of a client
        link, or of one that is opened after `stop`, are passed to the capture file alone.

        Args:
            name: name of the line, shown as the peer of its frames.
            is_server: whether requests are received here, and replies sent.
        """
        onward = None if self._before is None else self._before.line(name, is_server=is_server)
        if not self._is_on or not is_server:
            return onward if onward is not None else _NOTHING
        return _Line(self, name, onward)

    def add(
        self,
        peer: str,
        pdu: bytes,
        *,
        is_reply: bool,
        unit: int | None = None,
        transaction: int | None = None,
        reason: str = "",
        at: float | None = None,
    ) -> Passed:
        """Record one Modbus frame, or damaged bytes, and tell the watchers.

        Args:
            peer: the other end of the connection, or the name of the line.
            pdu: the PDU, or the damaged bytes.
            is_reply: whether it is a reply; for damaged bytes, whether this program sent them.
            unit: unit number; None for damaged bytes.
            transaction: transaction identifier; None for damaged bytes and on lines.
            reason: why the bytes are damaged; empty for a frame.
            at: seconds since 1970 UTC; None for now.
        """
        at = self._clock() if at is None else at
        with self._lock:
            self.last += 1
            passed = Passed(
                self.last, at, peer, pdu, is_reply=is_reply, unit=unit, transaction=transaction, reason=reason
            )
            self._tail.append(passed)
        for told in self._watchers:
            told()
        return passed

    # Inside.

    def _described(self, passed: Passed) -> FrameAnswer:
        shown: dict[str, Any] = {  # Any: keys of several types
            "number": passed.number,
            "at": passed.at,
            "peer": passed.peer,
            "unit": passed.unit,
            "transaction": passed.transaction,
            "raw": passed.pdu.hex(" ").upper(),
            "seconds": passed.seconds,
        }
        if passed.reason:
            title = f"{len(passed.pdu)} damaged bytes, {'sent' if passed.is_reply else 'received'}"
            return FrameAnswer(
                direction="damaged", title=title, text=f"{title}: {passed.reason}", problems=[passed.reason], **shown
            )
        direction = Direction.REPLY if passed.is_reply else Direction.REQUEST
        found = described(passed.pdu, direction, request=self._request(passed), functions=self._functions)
        return FrameAnswer(
            direction=direction.value,
            function=passed.pdu[0] & 0x7F if passed.pdu else None,
            title=found.title,
            text=in_words(found),
            fields=[
                FieldAnswer(name=part.name, data=part.data.hex(" ").upper(), text=part.text, problem=part.problem)
                for part in found.parts
            ],
            problems=list(found.problems),
            exception=bool(passed.is_reply and passed.pdu and passed.pdu[0] & 0x80),
            **shown,
        )

    def _request(self, passed: Passed) -> Message | None:
        if not passed.asked:
            return None
        request = self._functions.decode_request(passed.asked)
        return request if isinstance(request, Message) else None


class _Requests:
    """The unanswered requests of one connection or line, which are needed to explain replies and to time them."""

    __slots__ = ("_asked",)

    def __init__(self) -> None:
        self._asked: OrderedDict[object, Passed] = OrderedDict()

    def asked(self, key: object, request: Passed) -> None:
        self._asked[key] = request
        if len(self._asked) > _ASKED:
            self._asked.popitem(last=False)

    def answered(self, key: object, reply: Passed) -> None:
        request = self._asked.pop(key, None)
        if request is not None and reply.pdu and request.pdu[:1] == bytes([reply.pdu[0] & 0x7F]):
            reply.asked = request.pdu
            reply.seconds = max(reply.at - request.at, 0.0)


class _Connection:
    """Records the frames of one Modbus connection over TCP, TLS or UDP, for `Traffic` and the capture file."""

    __slots__ = ("_incoming", "_onward", "_outgoing", "_peer", "_requests", "_traffic")

    def __init__(self, traffic: Traffic, peer: str, onward: "ConnectionRecorder | None") -> None:
        self._traffic = traffic
        self._peer = peer
        self._onward = onward
        self._incoming = MbapReceiver()
        self._outgoing = MbapReceiver()
        self._requests = _Requests()

    def received(self, data: bytes) -> None:
        """Record the frames in bytes that a Modbus connection received: requests of the client."""
        if self._onward is not None:
            self._onward.received(data)
        for passed in self._frames(self._incoming, data, is_reply=False):
            self._requests.asked(passed.transaction, passed)

    def sent(self, data: bytes) -> None:
        """Record the frames in bytes that a Modbus connection sent: replies to the client."""
        if self._onward is not None:
            self._onward.sent(data)
        for passed in self._frames(self._outgoing, data, is_reply=True):
            self._requests.answered(passed.transaction, passed)

    def _frames(self, receiver: MbapReceiver, data: bytes, *, is_reply: bool) -> Iterator[Passed]:
        if receiver.broken:  # a device that misbehaves goes on after what no client can follow
            self._traffic.add(self._peer, data, is_reply=is_reply, reason="nothing can be found in it any more")
            return
        for frame in receiver.receive(data):
            if frame.kind is FrameKind.FRAME:
                yield self._traffic.add(
                    self._peer, frame.pdu, is_reply=is_reply, unit=frame.unit, transaction=frame.transaction
                )
            else:
                reason = frame.reason or f"protocol {frame.protocol}, where only 0 is Modbus"
                self._traffic.add(self._peer, frame.pdu, is_reply=is_reply, reason=reason)


class _Line:
    """Records the frames of a line, or of a connection with serial framing, for `Traffic` and the capture file."""

    __slots__ = ("_onward", "_peer", "_requests", "_traffic")

    def __init__(self, traffic: Traffic, peer: str, onward: "LineRecorder | None") -> None:
        self._traffic = traffic
        self._peer = peer
        self._onward = onward
        self._requests = _Requests()

    def heard(self, found: FrameOrDamage, *, at: float | None = None, is_outgoing: bool = False) -> None:
        """Record a frame or damaged bytes of the line.

        Args:
            found: the frame or the damaged bytes.
            at: seconds since 1970 UTC; None for now.
            is_outgoing: whether this program sent them; a frame then counts as a reply.
        """
        if self._onward is not None:
            self._onward.heard(found, at=at, is_outgoing=is_outgoing)
        if isinstance(found, Damaged):
            self._traffic.add(self._peer, found.raw, is_reply=is_outgoing, reason=found.reason.value, at=at)
            return
        # Direction decides: requests and replies of 05 and 06 look alike.
        is_reply = is_outgoing or found.direction is Direction.REPLY
        passed = self._traffic.add(self._peer, found.pdu, is_reply=is_reply, unit=found.unit, at=at)
        if is_reply:
            self._requests.answered(found.unit, passed)
        else:
            self._requests.asked(found.unit, passed)


class _Nothing:
    """Recorder that ignores everything, for connections that are recorded neither for the page nor in a file."""

    __slots__ = ()

    def received(self, data: bytes) -> None:
        """Ignore received bytes, because nothing is recorded."""

    def sent(self, data: bytes) -> None:
        """Ignore sent bytes, because nothing is recorded."""

    def heard(self, found: FrameOrDamage, *, at: float | None = None, is_outgoing: bool = False) -> None:
        """Ignore a frame or damaged bytes, because nothing is recorded."""


_NOTHING: Final = _Nothing()
