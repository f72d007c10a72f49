"""Shared reads: a read that equals one in flight for another client is not sent, but gets the reply to that one.

Knows batches in flight. Whether reads of a unit may be shared at all (no write came between) is decided by
`read_cache`; what happens when the reply comes, or a client goes, by `forwarding`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

from .batch import Batch, ForwardedRequest, ForwardingClient, WaitingClient
from .read_cache import Key
from .shared_read_deadlines import SharedReadDeadlines

FOR_EVER: Final = 86_400.0
"""Deadline of a shared read, in seconds, if a client without a deadline joins a read of a client that has one."""


def share(
    asker: ForwardingClient,
    tags: Sequence[Any],
    asked: Sequence[ForwardedRequest],
    shared: Mapping[Key, Batch],
    within: float | None,
) -> tuple[Sequence[Any], Sequence[ForwardedRequest], list[tuple[Any, ForwardedRequest]]]:
    """Let those reads of one client that equal a read in flight wait for its reply, and return the others.

    The reads of a priority host wait only for reads of priority hosts, or for those that were sent upstream already.
    If a client joins a read of a batch that has a deadline, the batch goes on until the later of that deadline and the
    client's, or for a day if the client has none (`FOR_EVER`).

    Args:
        asker: the client.
        tags: for each read, the tag that identifies it for the client.
        asked: the reads, all to one unit.
        shared: the unit's reads in flight: for each key, the batch that has the read.
        within: seconds from now until the client must be answered; None for no limit.

    Returns:
        Three lists: the tags of the reads to send; these reads; and tag and read of each further read that equals one
        of those to send. Pass the latter to `share` again once the reads to send are in flight.
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


def _join(batch: Batch, waiter: WaitingClient, within: float | None) -> None:
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
        batch.deadlines = SharedReadDeadlines(batch.link.now, batch.link.call_at, give_up)
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
