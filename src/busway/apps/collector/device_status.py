"""The status of a polled device: whether it answers, and what its reads have brought.

Knows a poller; asks nothing of a device.
"""

from dataclasses import dataclass

from .poller import LinkPoller


@dataclass(frozen=True, slots=True)
class CollectedDeviceStatus:
    """The status of a polled device: whether it answers, and what its reads have brought.

    Attributes:
        name: name of the device.
        link: name of its link.
        state: ``polled``, ``silent``, ``maintenance``, ``not asked yet``, or ``nothing to read`` (no readable point).
        reads: reads of points since the start, failed ones included.
        failures: reads of points that failed since the start.
        rounds: polling rounds completed since the start.
        skipped: due times at which no round was made since the start, because the one before still waited.
        worst_wait: the longest delay of a round by requests other than its own, in seconds.
        last_error: the last error of a read; empty if there was none.
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
