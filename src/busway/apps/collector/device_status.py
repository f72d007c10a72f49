"""The status of a polled device: whether it answers, and what its reads have brought.

Knows a poller; asks nothing of a device.
"""

from dataclasses import dataclass

from .poller import LinkPoller


@dataclass(frozen=True, slots=True)
class CollectedDeviceStatus:
    """The status of a polled device: whether it answers, and what its reads have brought.

    Attributes:
        name, link: its name and that of its link.
        state: ``polled``, ``silent``, ``maintenance`` or ``not asked yet``.
        reads, failures, rounds, skipped: how many there were since the start.
        worst_wait: the longest time in seconds that a round waited for others.
        last_error: the last error; empty if there was none.
        learnt: facts learnt about it, as sentences.
        silent_since: since when its rounds have stopped, nanoseconds since 1970 UTC; None while it is polled.
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
    silent_since: int | None = None


def status_of(poller: LinkPoller, name: str) -> CollectedDeviceStatus:
    """Return the status of a polled device, put together from its poller and its schedule."""
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
        None if device.suspended is None else device.suspended.begin,
    )
