"""Waits until file descriptors are ready, as exactly as the system can.

Knows the two calls that wait and their limits: ``select`` waits for microseconds but accepts only low descriptors,
``poll`` accepts all and waits for milliseconds, rounded up. Gaps between frames are 1.75 ms and less, so ``select`` is
preferred; a program with a thousand connections gets ``poll``.
"""

import select
from collections.abc import Sequence

SELECT_LIMIT = 1024
"""``select`` accepts only descriptors below this."""


def wait_ready(reading: Sequence[int], writing: Sequence[int], timeout: float | None) -> list[int]:
    """Wait until a descriptor in ``reading`` can be read, or one in ``writing`` written; return those that are ready.

    At least one descriptor must be given. One that has ended is ready too. The list is empty if ``timeout`` seconds
    have passed; None waits for ever.
    """
    if max((*reading, *writing)) < SELECT_LIMIT:
        readable, writable, _ = select.select(reading, writing, [], timeout)
        return readable + writable
    poll = select.poll()
    for descriptor in reading:
        poll.register(descriptor, select.POLLIN)
    for descriptor in writing:
        poll.register(descriptor, select.POLLOUT)
    return [descriptor for descriptor, _ in poll.poll(None if timeout is None else timeout * 1000)]
