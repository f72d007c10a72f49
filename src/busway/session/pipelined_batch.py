"""Pipelined batches: consecutive requests of one call that are sent together over TCP, with their expected replies.

Knows the layout of consecutive ADUs; knows no connection and no queue. Requests that are sent singly are in `call`.

1. What does not depend on transaction identifiers is computed once and kept with the first request of a batch.
2. If a reply differs from the expected one in its first nine bytes, the session splits the batch
   (`PipelinedBatch.apart`) and matches each request by itself.
3. As long as a batch is not split, no request that was sent after it has an outcome. At most 16 requests are in flight,
   so the 65 536 identifiers cannot come round to one of the batch, and new identifiers are not compared with those of
   the batch.
"""

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

from ..pdu.message import Message, Request
from .call import Call, EncodedRequest, FreeSlots, RequestInFlight, encoded_request

HEAD_SIZE = 9
"""Number of bytes at the beginning of a reply that identify it: transaction identifier and the seven bytes after it."""


class PackedBatch:
    """The bytes of several requests to one unit, and of their expected replies, without transaction identifiers.

    Attributes:
        following: the requests after the first. The first is left out, because it holds the packed batch: referring
            to it would be a reference cycle.
        fits: whether all replies can be recognised by their first bytes; otherwise the requests cannot be batched.
        heads: the seven bytes after the transaction identifier of each reply.
        reply_sizes, reply_size: bytes of the ADU of each reply, and of all replies together.
        takers: for each reply a function that builds it from its data.
    """

    __slots__ = (
        "_fields",
        "_pack",
        "_take_all",
        "_unpack_from",
        "fits",
        "following",
        "heads",
        "reply_size",
        "reply_sizes",
        "takers",
    )

    def __init__(self, first: EncodedRequest, following: tuple[Request, ...]) -> None:
        every = [first, *[encoded_request(request, first.unit) for request in following]]
        self.following: tuple[Request, ...] = following
        self.fits: bool = all(each.head for each in every)
        self.heads: tuple[bytes, ...] = tuple(each.head for each in every)
        self.reply_sizes: tuple[int, ...] = tuple(each.reply_size for each in every)
        self.reply_size: int = sum(self.reply_sizes)
        self.takers: tuple[Any, ...] = tuple(each.take for each in every)
        self._take_all: Any = first.take_all if len(set(self.takers)) == 1 else None
        self._fields: list[Any] = [part for each in every for part in (0, each.tail)]  # Any: numbers and bytes
        if self.fits:
            out, back = _shapes(tuple(len(each.tail) for each in every), self.reply_sizes)
            self._pack, self._unpack_from = out.pack, back.unpack_from

    def encode(self, transactions: Sequence[int]) -> bytes:
        """Return the joined frames of all requests; ``transactions`` has an identifier for each. Requires ``fits``."""
        fields = self._fields.copy()  # another thread may use the same object
        fields[0::2] = transactions
        return self._pack(*fields)

    def replies(self, transactions: tuple[int, ...], buffer: bytes | bytearray, at: int) -> list[Message] | None:
        """Return the replies to all requests, if the expected ones stand in ``buffer`` from offset ``at`` on, in order.

        None if one is missing or differs in its first nine bytes. ``buffer`` must have at least ``reply_size`` bytes
        after ``at``; more may follow. A reply is a message; for requests that a gateway forwards it is only the data
        bytes.
        """
        fields = self._unpack_from(buffer, at)
        if fields[0::3] != transactions or fields[1::3] != self.heads:
            return None
        if self._take_all is None:
            return [take(data) for take, data in zip(self.takers, fields[2::3], strict=True)]
        replies: list[Message] = self._take_all(fields[2::3])
        return replies


@lru_cache(maxsize=256)
def _shapes(tails: tuple[int, ...], replies: tuple[int, ...]) -> tuple[struct.Struct, struct.Struct]:
    """Return the `struct` layouts of a batch's requests and of its replies.

    ``tails`` and ``replies`` are sizes in bytes.
    """
    out = "".join(f"H{size}s" for size in tails)
    back = "".join(f"H7s{size - HEAD_SIZE}s" for size in replies)
    return struct.Struct(">" + out), struct.Struct(">" + back)


def packed_batch(requests: Sequence[Request], first: int, count: int, unit: int) -> PackedBatch:
    """Return ``count`` consecutive requests to one unit, packed to be sent together.

    ``first`` is the position of the first of these requests in ``requests``. The result is kept with that request
    object: the next call with it and equal following requests returns the same. The caller must check its ``fits``.
    """
    encoded = encoded_request(requests[first], unit)
    following = tuple(requests[first + 1 : first + count])
    packed: PackedBatch | None = encoded.packed
    if packed is None or packed.following != following:  # as a rule the very same objects, so this is no work
        packed = encoded.packed = PackedBatch(encoded, following)
    return packed


class PipelinedBatch:
    """Consecutive requests of one call that were sent together, and whose replies are expected in order.

    Attributes:
        call: the call of the requests.
        first: position of the first request in the call.
        packed: the bytes of the requests without transaction identifiers.
        transactions: the transaction identifiers of the requests, in order.
        slots: the objects for requests in flight that the batch occupies: one for each request without reply.
        answered: how many requests, counted from the first, have their reply.
        sent, expires: when the batch was sent and when it times out, in the clock of ``now``.
    """

    __slots__ = ("answered", "call", "expires", "first", "packed", "sent", "slots", "transactions")

    def __init__(
        self,
        call: Call,
        first: int,
        packed: PackedBatch,
        transactions: tuple[int, ...],
        slots: FreeSlots,
        sent: float,
    ) -> None:
        self.call: Call = call
        self.first: int = first
        self.packed: PackedBatch = packed
        self.transactions: tuple[int, ...] = transactions
        self.slots: FreeSlots = slots
        self.answered: int = 0
        self.sent: float = sent
        self.expires: float = sent + call.timeout

    def expects(self, buffer: bytes | bytearray, at: int) -> bool:
        """Whether the frame in ``buffer`` at ``at`` is the next expected reply, judged by its first nine bytes."""
        following = self.answered
        return (
            buffer[at + 2 : at + HEAD_SIZE] == self.packed.heads[following]
            and buffer[at] << 8 | buffer[at + 1] == self.transactions[following]
        )

    def apart(self) -> Iterator[tuple[int, RequestInFlight]]:
        """Yield each unanswered request as a pair: its transaction identifier, and a request in flight of its own.

        Empties ``slots``; the batch must not be used afterwards.
        """
        call = self.call
        for index in range(self.answered, len(self.transactions)):
            awaited = self.slots.pop()
            awaited.call = call
            awaited.position = self.first + index
            awaited.encoded = encoded_request(call.requests[awaited.position], call.unit)
            awaited.sent = self.sent
            awaited.expires = self.expires
            yield self.transactions[index], awaited
