"""The observer of a server's requests that counts them, with their durations, for the metrics.

Knows outcomes; knows nothing of the content of requests, nor of how counts are shown.

1. Every request that the pipeline answers is counted once, when the answer is there: on the fast path, on the generic
   path, or later. What a session answers by itself (06 while all slots are taken, function 0) is counted by the server.
2. Requests that one call has answered on the fast path share the time of that call evenly.
"""

from collections.abc import Callable, Sequence
from typing import Final

from ...pdu.exception_response import ExceptionResponse
from ...pdu.functions import AnyRequest
from ...pdu.message import Message
from ...session.responder import ClientIdentity, Deferral, RequestContext
from .request_tally import Durations, PeerClass, RequestTally, Series, Unanswered

Classify = Callable[[ClientIdentity], PeerClass]
"""Function that returns the class in which the metrics count a client."""

_MEMO_LIMIT: Final = 512
_LINES: Final = ("rtu://", "ascii://")


class ClassifyByPriority:
    """Function that classifies clients for the metrics: `PeerClass.PRIORITY` for priority hosts, else by listener.

    Args:
        is_priority: returns whether a host has priority, from the listener's URL and the host; its answers are cached.
    """

    def __init__(self, is_priority: Callable[[str, str], bool]) -> None:
        self._is_priority = is_priority
        self._memo: dict[tuple[str, str], PeerClass] = {}

    def __call__(self, client: ClientIdentity) -> PeerClass:
        """Return the class in which the metrics count a client."""
        key = client.listener, client.peer.rpartition(":")[0].strip("[]")
        found = self._memo.get(key)
        if found is None:
            if len(self._memo) >= _MEMO_LIMIT:
                self._memo.clear()
            found = PeerClass.PRIORITY if self._is_priority(*key) else classify_by_listener(client)
            self._memo[key] = found
        return found


def classify_by_listener(client: ClientIdentity) -> PeerClass:
    """Return the class of a client for the metrics: `PeerClass.LINE` on serial lines, else `PeerClass.OTHER`."""
    return PeerClass.LINE if client.listener.startswith(_LINES) else PeerClass.OTHER


class MetricsObserver:
    """Counts the requests of a server, or of all listeners of a gateway, for the metrics.

    Args:
        tally: where they are counted; None for a new one.
        classify: returns the class of a client.

    Attributes:
        tally: the counts of requests.
    """

    def __init__(self, tally: RequestTally | None = None, *, classify: Classify = classify_by_listener) -> None:
        self.tally: RequestTally = tally or RequestTally()
        self._classify = classify
        self._counted: dict[tuple[PeerClass, bytes], tuple[Series, Durations]] = {}  # by unit and function

    def answered(self, client: ClientIdentity, replies: Sequence[bytes], seconds: float) -> None:
        """Count requests of one client that the fast path (from bytes to bytes) has answered.

        Args:
            client: the client.
            replies: the ADU of each reply, with MBAP header.
            seconds: duration of all of them together; each request gets an equal share.
        """
        if not replies:
            return
        peer_class = self._classify(client)
        count = len(replies)
        each = seconds / count
        first = replies[0]
        # Mostly they have the same unit and function.
        if count == 1 or (first[7] < 0x80 and len({reply[6:8] for reply in replies}) == 1):
            self._count(peer_class, first, count, each)
        else:
            for reply in replies:
                self._count(peer_class, reply, 1, each)

    def _count(self, peer_class: PeerClass, reply: bytes, count: int, each: float) -> None:
        """Count ``count`` requests of ``each`` seconds whose replies have unit, function and exception of ``reply``."""
        key = peer_class, reply[6:8]
        known = self._counted.get(key)
        if known is None:
            known = self._series(peer_class, reply)
            if reply[7] < 0x80:
                self._counted[key] = known
        series, durations = known
        series.count += count
        durations.add(each, count)

    def _series(self, peer_class: PeerClass, reply: bytes) -> tuple[Series, Durations]:
        if len(self._counted) >= _MEMO_LIMIT:
            self._counted.clear()
        function = reply[7] & 0x7F
        exception = reply[8] if reply[7] & 0x80 else None
        return self.tally.series(peer_class, reply[6], function, exception), self.tally.durations(function)

    def unanswered(self, client: ClientIdentity, requests: int) -> None:
        """Count requests whose client disconnected before they were answered; ``requests`` is their number."""
        for _ in range(requests):
            self.tally.unanswered(Unanswered.GONE)

    def ended(
        self, context: RequestContext, request: AnyRequest, outcome: Message | Deferral | None, seconds: float
    ) -> None:
        """Count a request that the fast path (from bytes to bytes) did not answer.

        Args:
            context: unit, function and client of the request.
            request: the request.
            outcome: the reply; a `Deferral` such as `SILENCE` if none is sent; None if the client disconnected. A
                reply to a broadcast, or of a unit in listen-only mode, is not sent and counts as no reply.
            seconds: from the request to its outcome; counted only for replies.
        """
        if context.executed is not None:  # a broadcast: each unit executes it, and none answers
            self.tally.unanswered(Unanswered.BROADCAST)
        elif outcome is None:
            self.tally.unanswered(Unanswered.GONE)
        elif not isinstance(outcome, Message) or context.diagnostics.listen_only:
            self.tally.unanswered(Unanswered.SILENT)
        else:
            exception = outcome.exception if isinstance(outcome, ExceptionResponse) else None
            self.tally.series(self._classify(context.client), context.unit, context.function, exception).count += 1
            self.tally.durations(context.function).add(seconds)
