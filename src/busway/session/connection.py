"""The life of a link's connection: what the asyncio and the blocking driver of a client do alike.

Knows a conversation, the states of `reconnect` and what calls are told of them; knows no socket, thread, loop or log.
The driver makes and closes the connection, says what happened to it and when, and acts on what it is told.

1. A connection begins with `dialled` and `connected`, or `failed`; it ends with `lost`, or with `released` where nobody
   needs it. What was in flight on it has then been repeated or has failed (`TcpClientSession.disconnected`).
2. What was to be sent on it is the driver's, which drops it with the connection before it says so.
3. Where attempts fail in a row, calls that wait fail at once, and new ones are refused until the next attempt is due.
4. Calls that have ended are in ``finished`` of the conversation; the driver wakes their callers.
"""

from collections.abc import Callable
from weakref import WeakMethod

from ..errors import LinkDown
from .client import TcpClientSession
from .reconnect import ConnectionEvent, ConnectionState, Reconnect
from .serial_client import SerialClientSession

Moved = Callable[[ConnectionEvent, str, str], None]
"""Called with each event, its reason, and what there is to tell an operator: an empty text where nothing is new."""


class ConnectionLife:
    """The connections of one link, one after the other.

    Args:
        conversation: whose connection it is.
        reconnect: its states and pauses.
        endpoint: URL of the peer, for errors.
        hold: seconds that a connection is kept while nobody uses it; 0 for no longer than it is used.
        moved: method of the link that is called with every event; held weakly, so that a link that is dropped goes at
            once.

    Attributes:
        failure: why no connection could be had; None while one stands, and before the first attempt.
    """

    __slots__ = ("_asked_before", "_conversation", "_endpoint", "_moved", "failure", "hold", "reconnect")

    def __init__(
        self,
        conversation: TcpClientSession | SerialClientSession,
        reconnect: Reconnect,
        *,
        endpoint: str,
        hold: float,
        moved: Moved,
    ) -> None:
        self._conversation = conversation
        self._endpoint = endpoint
        self._moved = WeakMethod(moved)
        self._asked_before = 0  # requests before this connection
        self.reconnect = reconnect
        self.hold = hold
        self.failure: LinkDown | None = None

    # How one begins.

    def may_dial(self, now: float) -> bool:
        """Whether a connection may be made now."""
        return self.reconnect.may_dial(now)

    def dialled(self, now: float) -> None:
        """An attempt to connect has begun, where one may be made."""
        self._move(ConnectionEvent.DIALLED, now)

    def connected(self, now: float) -> None:
        """A connection stands."""
        self.failure = None
        self._asked_before = self._conversation.counters.requests
        self._move(ConnectionEvent.CONNECTED, now)
        self._conversation.connected(now)

    def failed(self, now: float, failure: LinkDown) -> None:
        """The attempt came to nothing, and with it everything that waited for it."""
        self.failure = failure
        self._move(ConnectionEvent.FAILED, now, failure.message)
        self._conversation.unreachable(now, failure)

    def interrupted(self, now: float) -> None:
        """The attempt was interrupted, which says nothing of the peer: what waits goes on waiting."""
        self._move(ConnectionEvent.FAILED, now, "interrupted")

    # What happens to it.

    def replied(self, now: float) -> None:
        """Something was received, and the state is not up or attempts have failed: a valid reply ends all doubts."""
        if self._conversation.valid_reply:
            self._move(ConnectionEvent.VALID_REPLY, now)

    def tick(self, now: float) -> bool:
        """Let time take effect on the conversation; whether a request has run out of time."""
        counters = self._conversation.counters
        timeouts = counters.timeouts
        self._conversation.tick(now)
        if counters.timeouts == timeouts:
            return False
        self._move(ConnectionEvent.TIMEOUT, now)
        return True

    def spent(self, now: float, last_used: float) -> str:
        """Why a connection that nobody uses is to be closed; empty while it is to be kept."""
        if now < last_used + self.hold:
            return ""
        return f"unused for {self.hold:g} s" if self.hold else "nothing more is asked"

    # How it ends.

    def lost(self, now: float, reason: str) -> None:
        """It has ended, or had to. Where that goes on and on, nobody waits but who is about to be repeated."""
        conversation = self._conversation
        if conversation.has_calls or conversation.counters.requests != self._asked_before:
            self._move(ConnectionEvent.LOST, now, reason, had_reply=conversation.valid_reply)
        else:
            self._move(ConnectionEvent.RELEASED, now, reason)
        by_peer = not conversation.recycle
        conversation.disconnected(now, reason)
        if by_peer and self.reconnect.is_flapping:
            self.failure = LinkDown(f"no connection: {reason}, before any reply")
            conversation.unreachable(now, self.failure, keep_repeated=True)

    def released(self, now: float, reason: str) -> None:
        """It was closed because nobody needs it."""
        self._move(ConnectionEvent.RELEASED, now, reason)
        self._conversation.disconnected(now, reason, lost=False)

    def ended(self, now: float) -> None:
        """The link was closed for good: what waits fails."""
        self._conversation.unreachable(now, LinkDown("the link was closed"))

    # What calls are told.

    def refusal(self, now: float, unit: int | None = None) -> LinkDown | None:
        """The error of a call that needs a connection while none may be tried; None where it may wait for one."""
        failure = self.failure
        if failure is None or self.may_dial(now) or self.reconnect.state is not ConnectionState.BACKING_OFF:
            return None
        pause = self.reconnect.not_before - now
        refusal = LinkDown(
            f"{failure.message}; the next attempt is made in {pause:.1f} s at the earliest",
            endpoint=self._endpoint,
            unit=unit,
        )
        refusal.__cause__ = failure
        return refusal

    @property
    def down_because(self) -> str:
        """Why no connection could be had, in words; empty while one stands, and before the first attempt."""
        return "" if self.failure is None else self.failure.message

    def _move(self, event: ConnectionEvent, now: float, reason: str = "", *, had_reply: bool = False) -> None:
        news = self.reconnect.move(event, now, reason=reason, had_reply=had_reply)
        moved = self._moved()
        if moved is not None:
            moved(event, reason, news)
