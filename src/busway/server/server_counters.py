"""The counters of a server since its start: connections, requests, refusals and bytes."""

from dataclasses import dataclass, field, fields, replace
from typing import Self


@dataclass(slots=True)
class HostClassCounters:
    """Counters of the connections of priority hosts, or of all other hosts.

    Attributes:
        accepted, closed: connections, and peers over UDP, that got a slot, and that have ended.
        requests: requests of ended connections; in a status also those of open ones.
        received, sent: bytes of ended connections; in a status also those of open ones.
    """

    accepted: int = 0
    closed: int = 0
    requests: int = 0
    received: int = 0
    sent: int = 0


@dataclass(slots=True)
class ServerCounters:
    """Counters of a server since it was created or reset.

    Requests and bytes of a connection are added when it ends, those of a serial port when the server stops; a status
    adds what open ones have counted so far.

    Attributes:
        accepted, closed: connections, and peers over UDP, that got a slot, and that have ended.
        unauthorized: new connections that were refused by the address of their host.
        no_longer_authorized: connections, TLS handshakes, and peers over UDP that were ended because address lists have
            changed.
        refused_full: new connections that got no slot: no other connection could be closed for them, or their client
            had closed them already.
        evicted: connections that were closed because a new connection got their slot.
        broken_streams: connections that were closed because their bytes were no valid sequence of frames.
        header_timeouts, frame_timeouts: connections closed because the header of a request, or the rest of it, did not
            end in time.
        write_timeouts: connections closed because the client did not read its replies in time.
        idle_timeouts: connections closed because they were unused for too long.
        reading_paused: times that reading from a client was paused because it did not read its replies; over UDP, times
            that the system's send buffer was full, so that replies were lost.
        rate_limited: times that a host was above its rate: its connection was paused, or over UDP its datagram dropped.
        responder_failures: requests whose responder raised an exception other than a refusal.
        requests: requests on all listeners.
        discarded_frames: frames that got no answer, and datagrams that were no valid frame.
        refused_busy: requests answered 06 because all transaction slots were taken.
        priority, other: some of these counters, for priority hosts and for all other hosts.
    """

    accepted: int = 0
    unauthorized: int = 0
    no_longer_authorized: int = 0
    refused_full: int = 0
    closed: int = 0
    evicted: int = 0
    broken_streams: int = 0
    header_timeouts: int = 0
    frame_timeouts: int = 0
    write_timeouts: int = 0
    idle_timeouts: int = 0
    reading_paused: int = 0
    rate_limited: int = 0
    responder_failures: int = 0
    requests: int = 0
    discarded_frames: int = 0
    refused_busy: int = 0
    priority: HostClassCounters = field(default_factory=HostClassCounters)
    other: HostClassCounters = field(default_factory=HostClassCounters)

    def of_class(self, *, is_priority: bool) -> HostClassCounters:
        """Return the counters of priority hosts' connections, or those of all other hosts' connections."""
        return self.priority if is_priority else self.other

    def take_off(self, counted: "ServerCounters") -> None:
        """Subtract earlier counts from these counters, in place, so that only later events remain."""
        for mine, theirs in ((self, counted), (self.priority, counted.priority), (self.other, counted.other)):
            for one in fields(mine):
                value = getattr(mine, one.name)
                if isinstance(value, int):
                    setattr(mine, one.name, value - getattr(theirs, one.name))

    def copy(self) -> Self:
        """Return a copy of the server's counters; later events do not change it."""
        return replace(self, priority=replace(self.priority), other=replace(self.other))
