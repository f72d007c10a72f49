"""Collects the status of a polled device: whether it answers, how its reads went, and what was learnt about it.

Knows a poller; sends nothing to a device.
"""

from dataclasses import dataclass

from .poller import LinkPoller


@dataclass(frozen=True, slots=True)
class CollectedDeviceStatus:
    """The status of a polled device: whether it answers, how its reads went, and what was learnt about it.

    Attributes:
        name: name of the device.
        link: name of its link.
        state: ``polled``, ``silent``, ``maintenance``, ``not asked yet``, or ``nothing to read`` (no readable point).
        reads: number of reads in polling rounds since the device is polled, failed ones included.
        failures: number of these reads that failed.
        rounds: number of polling rounds completed; a round whose last reads got no answer does not count.
        skipped: number of due times at which no round was made, because the one before still waited.
        worst_wait: the longest time in seconds from the due time of a round to its end, without the time of its own
            reads.
        last_error: the last error of a read, also if the device answers again; empty if there was none.
        learnt: facts learnt about the device, as sentences.
        unread: points that no allowed read can fetch, each with its reason, as sentences.
        silent_since: since when its rounds have stopped, because it is silent or in maintenance, nanoseconds since 1970
            UTC; None while it is polled.
    """

    name: str
    link: str
    state: str
    reads: int
    failures: int
    rounds: int
    skipped: int
    worst_wait: float
    last_error: str
    learnt: tuple[str, ...]
    unread: tuple[str, ...]
    silent_since: int | None = None


def status_of(poller: LinkPoller, name: str) -> CollectedDeviceStatus:
    """Return the status of one device of a link.

    Args:
        poller: the poller of the link.
        name: name of a device of that link.
    """
    device, scheduled = poller.devices[name], poller.schedule.devices.get(name)
    if scheduled is None:
        state = "nothing to read"
    elif scheduled.is_paused:
        state = "maintenance"
    else:
        state = {None: "not asked yet", True: "polled", False: "silent"}[scheduled.lives]
    return CollectedDeviceStatus(
        name,
        poller.name,
        state,
        device.reads,
        device.failures,
        0 if scheduled is None else scheduled.rounds,
        0 if scheduled is None else scheduled.skipped,
        0.0 if scheduled is None else scheduled.worst_wait,
        device.last_error,
        tuple(device.book.knowledge.lines()),
        tuple(f"{point}: {reason}" for point, reason in device.unread.items()),
        None if device.suspended is None else device.suspended.begin,
    )
