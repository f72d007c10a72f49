"""The counters of a server: connections, requests, refusals and bytes."""

from dataclasses import dataclass, field, fields, replace
from typing import Self


@dataclass(slots=True)
class ClassCounters:
    """Counters of the connections of priority hosts, or of all other hosts; sizes are bytes."""

    accepted: int = 0
    closed: int = 0
    requests: int = 0
    received: int = 0
    sent: int = 0


@dataclass(slots=True)
class ServerCounters:
    """Counters of a server since its creation; requests of a connection are added when it ends.

    Attributes:
        accepted, closed: connections, and peers over UDP.
        unauthorized: new connections that were refused by their address.
        no_longer_authorized: connections, and peers over UDP, that were ended because address lists have changed.
        refused_full: new connections without a free slot: none could be closed for them, or they had closed already.
        evicted: connections that made room.
        broken_streams: connections that could not be followed any more.
        header_timeouts, frame_timeouts: requests that did not end in time, in their header or after it.
        write_timeouts: clients that did not take their replies.
        idle_timeouts: connections that were not used.
        reading_paused: times that nothing more was read from a client that did not take its replies; over UDP, times
            that the system took none, and they were lost.
        rate_limited: times that a host was over its rate: held back, or over UDP its datagram dropped.
        responder_failures: responders that raised.
        requests: requests, by all ways.
        discarded_frames: frames that got no answer, datagrams that were none.
        refused_busy: requests answered 06 because all slots were taken.
        priority, other: the same by class of device.
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
    priority: ClassCounters = field(default_factory=ClassCounters)
    other: ClassCounters = field(default_factory=ClassCounters)

    def of_class(self, *, is_priority: bool) -> ClassCounters:
        """Return the counters of priority hosts' connections, or those of all other hosts' connections."""
        return self.priority if is_priority else self.other

    def take_off(self, counted: "ServerCounters") -> None:
        """Subtract the counts of an earlier moment, so that only later events remain."""
        for mine, theirs in ((self, counted), (self.priority, counted.priority), (self.other, counted.other)):
            for one in fields(mine):
                value = getattr(mine, one.name)
                if isinstance(value, int):
                    setattr(mine, one.name, value - getattr(theirs, one.name))

    def copy(self) -> Self:
        """Return a copy of the server's counters that does not change any more."""
        return replace(self, priority=replace(self.priority), other=replace(self.other))
