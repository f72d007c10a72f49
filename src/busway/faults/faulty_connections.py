"""Carries out faults on a server's connections: sends delayed and changed replies, and closes connections.

Knows tapped connections, an event loop and a clock; which bytes are sent, and when, is decided by `FaultyConversation`.

1. A connection has one timer, for its next action, and none while it has nothing to do.
2. All actions run in the thread of the server's event loop, also if another thread moves the clock or switches a fault.
3. While all faults are off, requests are not recorded. When the first fault is switched on, each open connection counts
   as used at that moment.
"""

import asyncio
from collections.abc import Callable, Iterator

from ..server.connection_tap import TappedConnection
from .applied_faults import Faults
from .clock import Clock, LoopClock, Timer
from .fault import Carrier, Contact
from .faulty_conversation import FaultyConversation

_CONNECTED = frozenset({"tcp", "tls"})


class FaultyTap:
    """Observer of a server's connections that carries out faults on them; to be given to the server as ``tap``.

    Its length is the number of open connections; iterating yields each as a `FaultyConnection`.

    Args:
        faults: the faults to apply.
        clock: clock that times delays; None for the clock of the event loop.
        changed: called without arguments after a connection was opened, and in the turn after one was closed.

    Attributes:
        accepted: number of connections opened so far, those included that a fault refused.
        drained: how often a connection has sent, or dropped when it was closed, the last of its delayed replies.
    """

    def __init__(
        self, faults: Faults, clock: Clock | None = None, *, changed: Callable[[], None] = lambda: None
    ) -> None:
        self._faults = faults
        self._clock = clock
        self._changed = changed
        self._faulty: dict[tuple[str, str], FaultyConnection] = {}
        self._with_unsent: set[FaultyConnection] = set()
        self._was_any_on = faults.is_any_on
        self.accepted: int = 0
        self.drained: int = 0
        faults.watch(self._switched)

    def __len__(self) -> int:
        return len(self._faulty)

    def __iter__(self) -> "Iterator[FaultyConnection]":
        return iter(list(self._faulty.values()))

    def find(self, listener: str, peer: str) -> "FaultyConnection | None":
        """Return the open connection of a client at a listener; None if there is none.

        Args:
            listener: URL of the listener as it is bound, as `RequestContext.listener` has it.
            peer: address of the client, ``host:port`` or the name of a serial line, as `RequestContext.peer` has it.
        """
        return self._faulty.get((listener, peer))

    @property
    def has_any_unsent(self) -> bool:
        """Whether any open connection has delayed replies that are not sent yet."""
        return bool(self._with_unsent)

    # What the server tells.

    def connection_opened(self, connection: TappedConnection) -> None:
        """Record a newly opened connection, and close it at once if a fault refuses it; called by the server."""
        loop = asyncio.get_running_loop()
        clock = LoopClock(loop) if self._clock is None else self._clock
        faulty = FaultyConnection(connection, self._faults, clock, loop, others=len(self._faulty), moved=self._moved)
        self._faulty[connection.listener, connection.peer] = faulty
        self.accepted += 1
        faulty.pump()
        self._changed()

    def connection_closed(self, connection: TappedConnection) -> None:
        """Drop the delayed replies of a closed connection, and forget it in the next turn; called by the server."""
        faulty = self._faulty.get((connection.listener, connection.peer))
        if faulty is not None and faulty.connection is connection:
            faulty.end()
            asyncio.get_running_loop().call_soon(self._forget, faulty)

    def _forget(self, faulty: "FaultyConnection") -> None:
        key = faulty.connection.listener, faulty.connection.peer
        if self._faulty.get(key) is faulty:
            del self._faulty[key]
        self._changed()

    def _moved(self, faulty: "FaultyConnection") -> None:
        """Note whether ``faulty`` has delayed replies now; called whenever replies were planned, sent or dropped."""
        if faulty.has_unsent:
            self._with_unsent.add(faulty)
        elif faulty in self._with_unsent:
            self._with_unsent.discard(faulty)
            self.drained += 1

    # What the faults tell, in any thread.

    def _switched(self) -> None:
        is_first = self._faults.is_any_on and not self._was_any_on
        self._was_any_on = self._faults.is_any_on
        for faulty in list(self._faulty.values()):
            faulty.ask_to_pump(is_used_now=is_first)


class FaultyConnection:
    """A connection on which faults are carried out: sends the bytes that its `FaultyConversation` plans, when due.

    Args:
        connection: the connection of the server.
        faults: the faults to apply.
        clock: clock of delays.
        loop: the event loop of the connection.
        others: number of connections that were open when this one was opened.
        moved: called with this object when replies may have been planned, sent or dropped.

    Attributes:
        connection: the connection of the server.
        clock: clock that times delays.
        conversation: plans which bytes are sent, and when.
    """

    def __init__(
        self,
        connection: TappedConnection,
        faults: Faults,
        clock: Clock,
        loop: asyncio.AbstractEventLoop,
        *,
        others: int,
        moved: Callable[["FaultyConnection"], None],
    ) -> None:
        self.connection = connection
        self.clock = clock
        contact = Contact(clock.now(), others, carriers=_carriers(connection))
        self.conversation: FaultyConversation = FaultyConversation(
            faults, contact, connection.framing, gap=connection.gap
        )
        self._loop = loop
        self._timer: Timer | None = None
        self._is_due = False
        self._has_ended = False
        self._sending = 0
        self._moved = moved

    @property
    def has_unsent(self) -> bool:
        """True if planned replies are not sent yet, so that a later reply must wait for them; False after `end`."""
        return not self._has_ended and (self._sending > 0 or self.conversation.has_unsent)

    def pump_soon(self) -> None:
        """Arrange that due replies are sent in the next turn of the event loop; call it in the loop's thread."""
        self._moved(self)
        if not self._is_due:
            self._is_due = True
            self._loop.call_soon(self.pump)

    def pump(self) -> None:
        """Send the replies that are due, close the connection if a fault says so, and set the timer for what is next.

        Next is another reply, or closing the connection. Does nothing after `end`.
        """
        self._is_due = False
        if self._has_ended:
            return
        now = self.clock.now()
        for data in self.conversation.tick(now):
            self.connection.send(data)
            self._sending += 1
            self._loop.call_soon(self._sent)  # after the connection has sent it
        self._moved(self)
        self._stop_timer()
        if self.conversation.closed:
            self.end()
            self._loop.call_soon(self.connection.close)  # after what was sent just now
            return
        deadline = self.conversation.deadline(now)
        if deadline is not None:
            self._timer = self.clock.call_at(deadline, self.ask_to_pump)

    def ask_to_pump(self, *, is_used_now: bool = False) -> None:
        """Make the event loop call `pump` soon; can be called from any thread, and does nothing if the loop is closed.

        With ``is_used_now``, the connection counts as used at this moment: its requests were not recorded.
        """

        def pump() -> None:
            if is_used_now:
                self.conversation.contact.last_received = self.clock.now()
            self.pump()

        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(pump)

    def _sent(self) -> None:
        self._sending -= 1
        self._moved(self)

    def end(self) -> None:
        """Stop sending on this connection for good; its delayed replies are dropped. The socket is not closed."""
        self._has_ended = True
        self._stop_timer()
        self._moved(self)

    def _stop_timer(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()


def _carriers(connection: TappedConnection) -> frozenset[Carrier]:
    return carriers_of(connection.framing, connection.carrier)


def carriers_of(framing: str, carrier: str) -> frozenset[Carrier]:
    """Return the kinds of transport on which faults of a connection can occur, one or two of `Carrier`.

    Args:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        carrier: ``tcp``, ``tls``, ``udp`` or ``serial``.
    """
    found = {Carrier.TCP if framing == "mbap" else Carrier.SERIAL}
    if carrier in _CONNECTED:
        found.add(Carrier.CONNECTION)
    return frozenset(found)
