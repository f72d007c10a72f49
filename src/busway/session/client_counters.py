"""The counters of a link: requests, replies, timeouts, retries, late replies, connections.

Knows what each counter means; the client sessions and the call tracker count.
"""

from dataclasses import dataclass


@dataclass(slots=True)
class ClientCounters:
    """Counters of a link since its creation.

    Attributes:
        requests: requests sent, with every repetition, and on a serial line every marker request.
        replies: valid replies in time that are no exception replies.
        exceptions: exception replies in time.
        timeouts: requests that got no reply in time; cancelled ones count only on a serial line.
        retries: requests queued to be sent again.
        bad_replies: replies to a request that break the protocol or do not fit the request.
        late_replies: replies that came after the timeout of their request.
        foreign_replies: frames that answer no request of this link.
        tolerated_replies: replies accepted although their transaction identifier was wrong (option
            ``transaction_policy``).
        foreign_protocol: TCP frames with a protocol identifier other than 0.
        damaged_frames: frames on a serial line that were damaged.
        overruns: damaged frames with a character overrun.
        markers: marker requests sent (`busway.session.serial_late_replies`).
        suspended: calls and queued requests that failed because the circuit breaker of their unit was open.
        cancelled: calls that were cancelled before they had all outcomes.
        overloaded: calls that were refused because the queue was full.
        connections: connections, or openings of the serial port, that succeeded.
        lost_connections: those that ended other than by being closed as unused.
        recycled: connections that the link itself gave up, to open another.
    """

    requests: int = 0
    replies: int = 0
    exceptions: int = 0
    timeouts: int = 0
    retries: int = 0
    bad_replies: int = 0
    late_replies: int = 0
    foreign_replies: int = 0
    tolerated_replies: int = 0
    foreign_protocol: int = 0
    damaged_frames: int = 0
    overruns: int = 0
    markers: int = 0
    suspended: int = 0
    cancelled: int = 0
    overloaded: int = 0
    connections: int = 0
    lost_connections: int = 0
    recycled: int = 0
