"""The exchanges between each client and unit of a capture: counts, items, times, and what was wrong.

Knows exchanges; prints nothing. The memory depends on the number of conversations, not on the number of packets.

1. A conversation is all exchanges of a client address, a server and a unit, over all their connections.
2. Bytes whose unit is unknown belong to a conversation of their own, without a unit.
3. There are at most `MOST_CONVERSATIONS`; exchanges of others are counted in `CapturedConversations.left_out`.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from ...codes import TABLE_SIZE, Table
from ...observe.pairing import ResponseTimes
from ...pdu.message import Request
from .exchanges import CapturedExchange, Trouble, TroubleKind
from .item_ranges import ItemRanges

MOST_CONVERSATIONS: Final = 10_000


@dataclass(slots=True)
class Troubles:
    """All troubles of one kind in a conversation, such as its late replies.

    Attributes:
        count: how many there were.
        first: the first one.
        worst: for late and slow replies, the one with the longest response time; None for other kinds.
        seconds: response time of ``worst``, in seconds; 0.0 for other kinds.
    """

    count: int
    first: Trouble
    worst: Trouble | None = None
    seconds: float = 0.0


@dataclass(slots=True)
class CapturedConversation:
    """Summary of all exchanges between one client and one unit of one server in a capture.

    Attributes:
        client: address of the client; empty for a serial line.
        server: address and port of the server; name of the line for a serial line.
        unit: unit identifier; None for bytes whose unit is unknown.
        first: time of the first frame, seconds since 1970.
        last: time of the last frame, seconds since 1970.
        requests: number of requests by function code, broadcasts included.
        replies: number of replies to requests, exceptions included.
        exceptions: number of exceptions by function code and exception code.
        items: ranges of registers and bits that well-formed requests named, by function code and table.
        waiting: number of requests that still waited for a reply when the capture ended.
        broadcasts: number of broadcasts, which no unit answers.
        times: statistics of the response times, in seconds.
        slowest_packet: number of the packet with the slowest reply; 0 without replies.
        troubles: what was wrong, by kind.
    """

    client: str
    server: str
    unit: int | None
    first: float
    last: float
    requests: Counter[int] = field(default_factory=Counter)
    replies: int = 0
    exceptions: Counter[tuple[int, int]] = field(default_factory=Counter)
    items: dict[int, dict[Table, ItemRanges]] = field(default_factory=dict)
    waiting: int = 0
    broadcasts: int = 0
    times: ResponseTimes = field(default_factory=ResponseTimes)
    slowest_packet: int = 0
    troubles: dict[TroubleKind, Troubles] = field(default_factory=dict)

    def add(self, exchange: CapturedExchange) -> None:
        """Add an exchange of this client and unit to the counts, times, items and troubles."""
        self.first, self.last = min(self.first, exchange.time), max(self.last, exchange.time)
        for trouble in exchange.troubles:
            self._trouble(trouble, exchange.seconds or 0.0)
        if exchange.asked is None:
            return
        code = exchange.asked.pdu[0]
        self.requests[code] += 1
        self.waiting += exchange.is_open
        self.broadcasts += exchange.is_broadcast
        if isinstance(exchange.request, Request):
            tables = self.items.setdefault(code, {})
            for span in exchange.request.spans():
                inside = min(span.count, TABLE_SIZE - span.address)
                tables.setdefault(span.table, ItemRanges()).add(span.address, inside)
        if exchange.answered is None:
            return
        self.last = max(self.last, exchange.answered.time)
        self.replies += 1
        if exchange.exception is not None:
            self.exceptions[code, exchange.exception] += 1
        if exchange.seconds is not None:
            if not self.times.count or exchange.seconds > self.times.slowest:
                self.slowest_packet = exchange.answered.packet
            self.times.add(exchange.seconds)

    def _trouble(self, trouble: Trouble, seconds: float) -> None:
        found = self.troubles.get(trouble.kind)
        if found is None:
            found = self.troubles[trouble.kind] = Troubles(0, trouble)
        found.count += 1
        if trouble.kind in (TroubleKind.LATE_REPLY, TroubleKind.SLOW_REPLY) and seconds > found.seconds:
            found.worst, found.seconds = trouble, seconds


class CapturedConversations:
    """All conversations of a capture, in the order of their first exchange; `add` collects them exchange by exchange.

    Attributes:
        left_out: number of exchanges of conversations beyond the limit `MOST_CONVERSATIONS`; they are counted here
            only.
    """

    def __init__(self) -> None:
        self.left_out: int = 0
        self._found: dict[tuple[str, str, int | None], CapturedConversation] = {}

    def add(self, exchange: CapturedExchange) -> None:
        """Add an exchange to its conversation, which is created if it is new.

        If there are `MOST_CONVERSATIONS` already, an exchange of a new conversation is only counted in ``left_out``.
        """
        channel = exchange.channel
        key = channel.client_text, channel.server_text, exchange.unit
        conversation = self._found.get(key)
        if conversation is None:
            if len(self._found) == MOST_CONVERSATIONS:
                self.left_out += 1
                return
            conversation = self._found[key] = CapturedConversation(*key, exchange.time, exchange.time)
        conversation.add(exchange)

    def __iter__(self) -> Iterator[CapturedConversation]:
        """Return an iterator over the conversations, in the order of their first exchange in the capture."""
        return iter(self._found.values())

    def __len__(self) -> int:
        return len(self._found)
