"""Waits until file descriptors are ready, as exactly as the system can.

Knows the two calls that wait and their limits: ``select`` waits for microseconds but takes only low descriptors,
``poll`` takes all and waits for milliseconds, rounded up. Gaps between frames are 1.75 ms and less, so the first is
preferred; a program with a thousand connections gets the second.
"""

import select
from collections.abc import Sequence

SELECT_LIMIT = 1024
"""Descriptors that ``select`` takes are below this."""


def wait_ready(reading: Sequence[int], writing: Sequence[int], timeout: float | None) -> list[int]:
    """Wait for file descriptors; returns those ready, none after ``timeout`` seconds. None waits for ever."""
    if max((*reading, *writing)) < SELECT_LIMIT:
        readable, writable, _ = select.select(reading, writing, [], timeout)
        return readable + writable
    poll = select.poll()
    for descriptor in reading:
        poll.register(descriptor, select.POLLIN)
    for descriptor in writing:
        poll.register(descriptor, select.POLLOUT)
    return [descriptor for descriptor, _ in poll.poll(None if timeout is None else timeout * 1000)]
