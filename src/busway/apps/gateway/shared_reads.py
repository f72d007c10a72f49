"""Shared reads: a client that asks for what another client has in flight waits for that read, and gets the same reply.

Knows batches in flight. Whether reads of a unit may be shared at all (no write came between) is decided by
`read_cache`; what happens when the reply comes, or a client goes, by `forwarding`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

from .batch import Batch, ForwardedRequest, ForwardingClient, Waiter
from .read_cache import Key
from .waiter_deadlines import WaiterDeadlines

FOR_EVER: Final = 86_400.0
"""Seconds that a client without a deadline waits for a read that it shares with one that has a deadline."""


def share(
    asker: ForwardingClient,
    tags: Sequence[Any],
    asked: Sequence[ForwardedRequest],
    shared: Mapping[Key, Batch],
    within: float | None,
) -> tuple[Sequence[Any], Sequence[ForwardedRequest], list[tuple[Any, ForwardedRequest]]]:
    """Let the reads of one client wait for equal reads that are in flight for others.

    The reads of a priority host wait only for reads of priority hosts, or for those that were sent upstream already. A
    deadline of a batch that is joined moves so that the batch lasts for its latest client.

    Args:
        asker: the client.
        tags: for each read, the tag that names the read for the client.
        asked: the reads, all to one unit.
        shared: the unit's reads in flight, by key.
        within: seconds until the client must be answered; None for no limit.

    Returns:
        Tags and requests to send; and tag and request of each read that equals one of those to send: pass them to
        `share` again once that one is in flight.
    """
    left: dict[Key, tuple[Any, ForwardedRequest]] = {}
    twice: list[tuple[Any, ForwardedRequest]] = []
    for tag, one in zip(tags, asked, strict=True):
        batch = shared.get(one.key)
        if batch is not None and (not asker.is_priority or batch.is_priority or batch.is_sent(_position(batch, one))):
            _join(batch, (asker, tag, one), within)
        elif one.key in left:
            twice.append((tag, one))
        else:
            left[one.key] = tag, one
    return [tag for tag, _ in left.values()], [one for _, one in left.values()], twice


def _join(batch: Batch, waiter: Waiter, within: float | None) -> None:
    """Let a client wait for an equal read in a batch that is in flight, with a deadline of its own.

    Args:
        batch: the batch with the read.
        waiter: the client and its read.
        within: seconds until the client must be answered; None for no limit.
    """
    asker, _, asked = waiter
    batch.forwarder.upstream.counters.shared += 1
    position = _position(batch, asked)
    batch.joined = {**batch.joined, position: [*batch.joined.get(position, ()), waiter]}
    asker.batches[batch] = None
    now = batch.link.now()
    if batch.deadlines is None:
        give_up = partial(batch.forwarder.give_up_one, batch)
        batch.deadlines = WaiterDeadlines(batch.link.now, batch.link.call_at, give_up)
        if batch.deadline is not None and batch.asker is not None:
            batch.deadlines.add(None, batch.deadline)
    if within is not None:
        batch.deadlines.add(waiter, now + within)
    if batch.deadline is not None:  # the first client may have less time than this one
        batch.deadline = max(batch.deadline, now + (FOR_EVER if within is None else within))


def _position(batch: Batch, asked: ForwardedRequest) -> int:
    """Return the position in a batch of the read that equals this one."""
    return batch.keys.index(asked.key)


__all__ = ["share"]
