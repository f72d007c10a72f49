"""The life of a client's connection: when to connect, what to report, what happens to waiting calls.

For both kinds of client session, TCP and serial. Knows a session, the states of `reconnect` and the errors that calls
get; knows no socket, thread, loop or log. The driver opens and closes the connection, reports its events with their
time, and acts on the results.

1. A connection begins with `dialled` and `connected`, or `failed`; it ends with `lost`, or with `released` if it is no
   longer needed. Requests in flight have then been repeated or have failed (`TcpClientSession.disconnected`).
2. The driver owns the bytes that are not sent yet; it drops them with the connection before it reports the end.
3. After a failed attempt, or several connections in a row without a valid reply, waiting calls fail at once, and new
   ones are refused until the next attempt is due.
4. Ended calls are in ``finished`` of the session; the driver wakes their callers.
"""

from collections.abc import Callable
from weakref import WeakMethod

from ..errors import LinkClosed, LinkDown
from .reconnect import ConnectionEvent, ConnectionState, Reconnect
from .serial_client import SerialClientSession
from .tcp_client import TcpClientSession

Moved = Callable[[ConnectionEvent, str, str], None]
"""Called as ``moved(event, reason, news)`` with each event, its reason in words, and a message for the operator. The
message is empty if there is nothing to report.
"""


class ConnectionLife:
    """State of a link's successive connections, from the first attempt to the end of the link.

    Args:
        conversation: the client session that uses the connection.
        reconnect: states of the connection, and the pauses between attempts.
        endpoint: URL of the peer, for errors.
        hold: seconds that an unused connection is kept; 0 closes it as soon as it is unused.
        moved: method of the link that is called with every event; held weakly, so that a dropped link is freed at
            once.

    Attributes:
        endpoint, reconnect, hold: as given.
        failure: the error of the last attempt, if it failed, or of the last connection, if several in a row ended
            without a valid reply; None otherwise.
        closed: whether the link was closed for good; the driver sets it.
    """

    __slots__ = (
        "_asked_before",
        "_conversation",
        "_had_reply",
        "_moved",
        "closed",
        "endpoint",
        "failure",
        "hold",
        "reconnect",
    )

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
        self.endpoint: str = endpoint
        self._moved = WeakMethod(moved)
        self._asked_before = 0  # requests before this connection
        self._had_reply = False  # whether this connection brought a valid reply before its last timeout
        self.reconnect: Reconnect = reconnect
        self.hold: float = hold
        self.failure: LinkDown | None = None
        self.closed: bool = False

    # How a connection begins.

    def may_dial(self, now: float) -> bool:
        """Whether an attempt to connect may be made now: no connection, no attempt in progress, no pause.

        If a pause is over at ``now``, this call changes the state from "backing off" to "down".
        """
        return self.reconnect.may_dial(now)

    def dialled(self, now: float) -> None:
        """Record that an attempt to connect has begun; call it only if `may_dial` is true."""
        self._move(ConnectionEvent.DIALLED, now)

    def connected(self, now: float) -> None:
        """Record that the connection is open; from now on the session gives the driver requests to send."""
        self.failure = None
        self._asked_before = self._conversation.counters.requests
        self._had_reply = False
        self._move(ConnectionEvent.CONNECTED, now)
        self._conversation.connected(now)

    def failed(self, now: float, failure: LinkDown) -> None:
        """Record that an attempt to connect failed.

        Every call that waits in the queue ends with a copy of ``failure`` as its error; a write that was sent before
        ends as `WriteOutcomeUnknown`.
        """
        self.failure = failure
        self._move(ConnectionEvent.FAILED, now, failure.message)
        self._conversation.unreachable(now, failure)

    def interrupted(self, now: float) -> None:
        """Record that an attempt to connect was cancelled; the pause before the next attempt is as after a failed one.

        Unlike after `failed`, waiting calls keep waiting, and no new ones are refused because of it.
        """
        self._move(ConnectionEvent.FAILED, now, "interrupted")

    # While it is open.

    def replied(self, now: float) -> None:
        """Record that the session has processed received bytes.

        If this connection has brought a valid reply since its last timeout, if any, the state becomes "up".
        """
        if self._conversation.valid_reply:
            self._move(ConnectionEvent.VALID_REPLY, now)

    def tick(self, now: float) -> bool:
        """Let the session handle silences, timeouts and deadlines that are over. Returns whether a request timed out.

        If one did, the state becomes "suspect". A call that ended by its deadline in the queue is no such timeout. If
        a silence completed a valid reply, "suspect" becomes "up" again.
        """
        conversation = self._conversation
        counters = conversation.counters
        timeouts = counters.timeouts
        conversation.tick(now)
        if counters.timeouts == timeouts:
            if self.reconnect.state is ConnectionState.SUSPECT:
                self.replied(now)
            return False
        if conversation.valid_reply:
            self._had_reply, conversation.valid_reply = True, False
        self._move(ConnectionEvent.TIMEOUT, now)
        return True

    def spent(self, now: float, last_used: float) -> str:
        """Return why an unused connection is to be closed now, such as ``unused for 60 s``; empty if it is to be kept.

        ``last_used`` is when the connection was last used, in the clock of ``now``.
        """
        if now < last_used + self.hold:
            return ""
        return f"unused for {self.hold:g} s" if self.hold else "nothing more is asked"

    # How it ends.

    def lost(self, now: float, reason: str) -> None:
        """Record that an open connection ended unexpectedly; its requests in flight are repeated or fail.

        Waiting calls stay in the queue. They fail only if several connections in a row brought no valid reply, and the
        session had not itself asked for a new connection (``recycle``). Even then a call of which a request is about to
        be repeated stays. If nothing was asked on this connection and no call waits, state and pause change as after
        `released`.
        """
        conversation = self._conversation
        if conversation.queue.size or conversation.counters.requests != self._asked_before:
            had_reply = self._had_reply or conversation.valid_reply
            self._move(ConnectionEvent.LOST, now, reason, had_reply=had_reply)
        else:
            self._move(ConnectionEvent.RELEASED, now, reason)
        by_peer = not conversation.recycle
        conversation.disconnected(now, reason)
        if by_peer and self.reconnect.is_flapping:
            self.failure = LinkDown(f"no connection: {reason}, before any reply", kind="lost")
            conversation.unreachable(now, self.failure, keep_repeated=True)

    def released(self, now: float, reason: str) -> None:
        """Record that the connection was closed because no call needed it."""
        self._move(ConnectionEvent.RELEASED, now, reason)
        self._conversation.disconnected(now, reason, lost=False)

    def begin_again(self) -> None:
        """Forget connection and calls: an exception such as KeyboardInterrupt may have left them inconsistent.

        The driver then passes its calls to the session's ``resume``.
        """
        self._conversation.begin_again()
        self.reconnect.begin_again()

    def ended(self, now: float) -> None:
        """Fail all waiting calls with `LinkDown` of the kind ``closed``, because the link was closed for good."""
        self._conversation.unreachable(now, LinkDown("the link was closed", kind="closed"))

    # What calls are told.

    def refusal(self, now: float, unit: int | None = None) -> LinkDown | None:
        """Return the error for a new call if the link is closed, or pauses because of ``failure``; None otherwise.

        ``unit`` is the unit that the call asks, for the error. A pause that is over ends here, as in `may_dial`.
        """
        if self.closed:
            return LinkClosed("the link is closed", endpoint=self.endpoint, unit=unit)
        failure = self.failure
        if failure is None or self.may_dial(now) or self.reconnect.state is not ConnectionState.BACKING_OFF:
            return None
        pause = self.reconnect.not_before - now
        refusal = LinkDown(
            f"{failure.message}; the next attempt is made in {pause:.1f} s at the earliest",
            kind=failure.kind,
            endpoint=self.endpoint,
            unit=unit,
        )
        refusal.__cause__ = failure
        return refusal

    @property
    def down_because(self) -> str:
        """The text of ``failure``, such as why the last attempt to connect failed; empty if that is None."""
        return "" if self.failure is None else self.failure.message

    def _move(self, event: ConnectionEvent, now: float, reason: str = "", *, had_reply: bool = False) -> None:
        news = self.reconnect.move(event, now, reason=reason, had_reply=had_reply)
        moved = self._moved()
        if moved is not None:
            moved(event, reason, news)
