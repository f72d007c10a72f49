"""The connections and lines of a server, as faults see them: bytes that leave at their time, connections that end.

Knows wires, an event loop and a clock; what leaves, and when, is known by `FaultyConversation`.

1. A wire has one timer, for what it has to do next, and none while it has nothing to do.
2. Everything happens in the thread of the server's event loop, whatever thread moves the clock or a switch.
3. Faults that were off when requests came know nothing of them: a connection that stands when the first is switched
   on counts as used at that moment.
"""

import asyncio
from collections.abc import Callable, Iterator

from ..server.wires import Wire
from .clock import Clock, LoopClock, Timer
from .conversation import FaultyConversation
from .fault import Carrier, Contact, Faults

_CONNECTED = frozenset({"tcp", "tls"})


class FaultyTap:
    """All wires of one server, or of several that share their faults; to be given to it as ``wires``.

    Args:
        faults: what goes wrong.
        clock: what delays are measured by; the event loop's by default.
        changed: called when a wire came or has left.

    Attributes:
        accepted: wires so far.
        drained: how often a wire was behind and is no more.
    """

    def __init__(
        self, faults: Faults, clock: Clock | None = None, *, changed: Callable[[], None] = lambda: None
    ) -> None:
        self._faults = faults
        self._clock = clock
        self._changed = changed
        self._ways: dict[tuple[str, str], FaultyWay] = {}
        self._behind: set[FaultyWay] = set()
        self._was_any_on = faults.is_any_on
        self.accepted = self.drained = 0
        faults.watch(self._switched)

    def __len__(self) -> int:
        return len(self._ways)

    def __iter__(self) -> "Iterator[FaultyWay]":
        return iter(list(self._ways.values()))

    def find(self, listener: str, peer: str) -> "FaultyWay | None":
        """The way by which a request came, by the names of its context."""
        return self._ways.get((listener, peer))

    @property
    def is_any_behind(self) -> bool:
        """Whether something waits to leave by one of them."""
        return bool(self._behind)

    # What the server tells.

    def came(self, wire: Wire) -> None:
        """As `busway.server.wires.ConnectionTap.came`."""
        loop = asyncio.get_running_loop()
        clock = LoopClock(loop) if self._clock is None else self._clock
        way = FaultyWay(wire, self._faults, clock, loop, others=len(self._ways), moved=self._moved)
        self._ways[wire.listener, wire.peer] = way
        self.accepted += 1
        way.pump()
        self._changed()

    def left(self, wire: Wire) -> None:
        """As `ConnectionTap.left`. It counts until its socket is closed, which comes after this call."""
        way = self._ways.get((wire.listener, wire.peer))
        if way is not None and way.wire is wire:
            way.end()
            asyncio.get_running_loop().call_soon(self._forget, way)

    def _forget(self, way: "FaultyWay") -> None:
        key = way.wire.listener, way.wire.peer
        if self._ways.get(key) is way:
            del self._ways[key]
        self._changed()

    def _moved(self, way: "FaultyWay") -> None:
        """Something has come to wait at a wire, or waits no more."""
        if way.is_behind:
            self._behind.add(way)
        elif way in self._behind:
            self._behind.discard(way)
            self.drained += 1

    # What the faults tell, in any thread.

    def _switched(self) -> None:
        is_first = self._faults.is_any_on and not self._was_any_on
        self._was_any_on = self._faults.is_any_on
        for way in list(self._ways.values()):
            way.ask_to_pump(is_used_now=is_first)


class FaultyWay:
    """One wire and its conversation.

    Attributes:
        wire, conversation, clock: what it is made of.
    """

    def __init__(
        self,
        wire: Wire,
        faults: Faults,
        clock: Clock,
        loop: asyncio.AbstractEventLoop,
        *,
        others: int,
        moved: Callable[["FaultyWay"], None],
    ) -> None:
        self.wire = wire
        self.clock = clock
        contact = Contact(clock.now(), others, carriers=_carriers(wire))
        self.conversation = FaultyConversation(faults, contact, wire.framing, gap=wire.gap)
        self._loop = loop
        self._timer: Timer | None = None
        self._is_due = False
        self._has_ended = False
        self._sending = 0
        self._moved = moved

    @property
    def is_behind(self) -> bool:
        """Whether something waits to leave, so that nothing may overtake it."""
        return not self._has_ended and (self._sending > 0 or self.conversation.is_behind)

    def pump_soon(self) -> None:
        """Send what is due at the end of this turn of the event loop, behind what others answer in it."""
        self._moved(self)
        if not self._is_due:
            self._is_due = True
            self._loop.call_soon(self.pump)

    def pump(self) -> None:
        """Send what is due, and be back when there is more."""
        self._is_due = False
        if self._has_ended:
            return
        now = self.clock.now()
        for data in self.conversation.tick(now):
            self.wire.send(data)
            self._sending += 1
            self._loop.call_soon(self._sent)  # behind what the wire does with it
        self._moved(self)
        self._stop_timer()
        if self.conversation.closed:
            self.end()
            self._loop.call_soon(self.wire.close)  # behind what was sent just now
            return
        deadline = self.conversation.deadline(now)
        if deadline is not None:
            self._timer = self.clock.call_at(deadline, self.ask_to_pump)

    def ask_to_pump(self, *, is_used_now: bool = False) -> None:
        """The clock or a switch says so, in whatever thread."""

        def pump() -> None:
            contact = self.conversation.contact
            if is_used_now and contact.last_received is None:
                contact.last_received = self.clock.now()
            self.pump()

        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(pump)

    def _sent(self) -> None:
        self._sending -= 1
        self._moved(self)

    def end(self) -> None:
        """Nothing leaves any more."""
        self._has_ended = True
        self._stop_timer()
        self._moved(self)

    def _stop_timer(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()


def _carriers(wire: Wire) -> frozenset[Carrier]:
    found = {Carrier.TCP if wire.framing == "mbap" else Carrier.SERIAL}
    if wire.carrier in _CONNECTED:
        found.add(Carrier.CONNECTION)
    return frozenset(found)
