"""The bounded queue of one link's calls, and the order in which their requests are sent.

Knows callers, units and the order among them; knows no clock and no bytes.

1. Round robin over callers, one request each. A new caller is served before the one that was served last, so a flood
   of one caller delays the others by the request in flight and no more.
2. Of one caller, writes go before reads to other units, but never past its own earlier requests to the same unit.
3. A unit that must not be asked now (``eligible`` returns False) delays its own requests only.
4. The queue is bounded; a call that does not fit is refused before anything was sent.
5. For a caller that acts for many (a client of a gateway), the units it asks can be served in turn (``units_in_turn``),
   as long as none of its waiting calls is a write.
6. Where several requests may be sent at once, a caller may send up to ``burst`` of them in its turn, because requests
   that leave together are answered together. It does not wait until so many can be sent: if only one can, it is one.
7. The priority hosts of a gateway go first (`Call.is_priority`). When each waiting priority host has had a turn, one
   other caller has a turn, so none waits for ever. A flood of other callers delays a priority host by the requests in
   flight and one turn. If they have filled the queue, it still accepts `RESERVED_PLACES` requests of priority hosts.
"""

from collections import deque
from collections.abc import Callable, Iterator

from ..errors import Overloaded
from .call import Call

BURST = 8
"""Most requests that a gateway's client may send in its turn while others wait. Requests that leave together are
answered together, in one segment for the server and one for the client: 8 at once take 10 µs each, 4 take 15, single
ones 45.
It is half of the requests that may be in flight, so that two clients have their turns at once.
"""

RESERVED_PLACES = 64
"""Number of requests of priority hosts that a queue accepts beyond its limit: enough for four connections.
"""

Eligible = Callable[[Call], bool]
"""Function that tells whether the unit of a call may be asked now."""


class _Caller:
    """The queued calls of one caller, such as a client of a gateway, in order of arrival."""

    __slots__ = ("calls", "key", "round", "served", "units", "writes")

    def __init__(self, key: object, round_: "_Round") -> None:
        self.key = key
        self.round = round_  # where it is served
        self.calls: deque[Call] = deque()
        self.writes = 0
        self.units: dict[int, int] = {}  # calls by unit, where units are served in turn
        self.served: dict[int, None] | None = None  # units in the order in which they were served, if that matters

    def pick(self, eligible: Eligible | None) -> Call | None:
        first = self.calls[0]
        if len(self.units) > 1 and self.served is not None and not self.writes:
            return self._unit_in_turn(self.served, eligible)
        if (not self.writes or first.is_write) and (eligible is None or eligible(first)):
            return first
        chosen: Call | None = None
        passed: set[int] = set()
        for call in self.calls:
            if call.unit in passed:
                continue
            passed.add(call.unit)
            if eligible is not None and not eligible(call):
                continue
            if call.is_write:
                return call
            if chosen is None:
                chosen = call
        return chosen

    def has_served(self, unit: int) -> None:
        """Record that a request to this unit is sent: if units are served in turn, the unit goes to their end.

        Otherwise, and if the caller asks only one unit, do nothing.
        """
        served = self.served
        if served is not None and len(self.units) > 1:
            served.pop(unit, None)
            served[unit] = None

    def _unit_in_turn(self, served: dict[int, None], eligible: Eligible | None) -> Call | None:
        """Return the caller's oldest call to that unit whose last request was sent longest ago.

        Calls for which ``eligible`` returns False are left out; None if no call is left.
        """
        oldest: dict[int, Call] = {}
        for call in self.calls:
            oldest.setdefault(call.unit, call)
        order = [unit for unit in oldest if unit not in served] + [unit for unit in served if unit in oldest]
        return next((oldest[unit] for unit in order if eligible is None or eligible(oldest[unit])), None)


class _Round:
    """The callers of a queue in the order in which they have their next turns (round robin)."""

    __slots__ = ("callers", "last")

    def __init__(self) -> None:
        self.callers: deque[_Caller] = deque()
        self.last: _Caller | None = None  # who was served last

    def add(self, caller: _Caller) -> None:
        callers = self.callers
        if callers and callers[-1] is self.last:
            callers.insert(-1, caller)
        else:
            callers.append(caller)

    def remove(self, caller: _Caller) -> None:
        if self.callers[-1] is caller:  # who was just served
            self.callers.pop()
        else:
            self.callers.remove(caller)


class RequestQueue:
    """The bounded queue of the calls of a link that have requests left to send.

    Attributes:
        limit: how much the queue holds, in `Call.places`; `RESERVED_PLACES` more for priority hosts.
        size: number of queued calls.
        waiting: the sum of `Call.places` of the queued calls, to which ``limit`` applies.
        burst: requests of one caller that may be sent before the next caller's turn, if that many may be sent at once.
        begun: calls with both sent and waiting requests; kept only if ``burst`` is above 1.
        units_in_turn: whether the units of a caller are served in turn, instead of its requests in their order. Holds
            for callers that have no call in the queue yet when it is set.
    """

    __slots__ = (
        "_allowed",
        "_callers",
        "_last",
        "_others",
        "_passed",
        "_priority",
        "begun",
        "burst",
        "limit",
        "size",
        "units_in_turn",
        "waiting",
    )

    def __init__(self, limit: int) -> None:
        self.limit: int = limit
        self.size: int = 0
        self.waiting: int = 0
        self.burst: int = 1
        self.begun: dict[Call, None] = {}
        self.units_in_turn: bool = False
        self._callers: dict[object, _Caller] = {}
        self._priority = _Round()
        self._others = _Round()
        self._passed = 0  # turns of priority hosts since one of the others that wait was served
        self._allowed = 0  # how many there may be: the priority hosts that have waited since
        self._last: _Caller | None = None  # the caller served last

    def add(self, call: Call) -> None:
        """Queue a call after the others of its caller.

        Raises:
            Overloaded: the queue is full; nothing was sent.
        """
        limit = self.limit + RESERVED_PLACES if call.is_priority else self.limit
        if self.waiting + call.places > limit:
            raise Overloaded(f"{limit} calls wait on this link already; nothing was sent")
        caller = self._callers.get(call.caller) or self._new_caller(call)
        caller.calls.append(call)
        self._count(caller, call)

    def clear(self) -> None:
        """Forget all calls and the order of callers.

        Safe even if an exception has interrupted another method half-way.
        """
        self.size = self.waiting = self._passed = self._allowed = 0
        self.begun.clear()
        self._callers.clear()
        self._priority = _Round()
        self._others = _Round()
        self._last = None

    def add_again(self, call: Call) -> None:
        """Queue a call with a request to repeat: before its caller's other calls, and even if the queue is full.

        A call that is still queued keeps its position.
        """
        caller = self._callers.get(call.caller) or self._new_caller(call)
        if call not in caller.calls:  # else its other requests still wait
            call.places = 1  # its other requests gave up their places when they were sent
            caller.calls.appendleft(call)
            self._count(caller, call)
        elif self.burst > 1:
            call.places += 1
            self.waiting += 1
        if self.burst > 1:
            self.begun[call] = None

    def _new_caller(self, call: Call) -> _Caller:
        round_ = self._priority if call.is_priority else self._others
        caller = self._callers[call.caller] = _Caller(call.caller, round_)
        if self.units_in_turn:
            caller.served = {}
        round_.add(caller)
        if call.is_priority:
            self._allowed = max(self._allowed, len(self._priority.callers))
        return caller

    def _count(self, caller: _Caller, call: Call) -> None:
        if call.is_write:
            caller.writes += 1
        if caller.served is not None:
            caller.units[call.unit] = caller.units.get(call.unit, 0) + 1
        self.size += 1
        self.waiting += call.places

    def share(self, room: int) -> int:
        """Return how many requests a queued caller may send in its turn, if ``room`` more requests may be in flight.

        A sole caller may send ``room``. With several callers it is 1; if ``burst`` is above 1, it is ``burst`` or an
        equal part of ``room``, whichever is more. So the result can be above ``room``, which the sender must respect.
        At least one call must be queued.
        """
        callers = len(self._callers)
        if callers == 1:
            return room
        return 1 if self.burst == 1 else max(self.burst, room // callers)

    def sent(self, call: Call, count: int) -> None:
        """Record that ``count`` requests of a call returned by `pick` were sent.

        The call leaves the queue if it has none left to send.
        """
        if not call.has_more:
            self.remove(call)
            return
        if self.burst > 1:
            self.begun[call] = None
            freed = min(count, call.places)
            call.places -= freed
            self.waiting -= freed

    def pick_same(self, eligible: Eligible | None = None) -> Call | None:
        """Return the next call of the caller that `pick` chose last, which may send more requests in its turn.

        It can be the call that `pick` returned. None if that caller has no call left for which ``eligible`` returns
        True. If units are served in turn, the unit of the call goes to the end of their order.
        """
        caller = self._last
        if caller is None or not caller.calls:
            return None
        call = caller.pick(eligible)
        if call is not None:
            caller.has_served(call.unit)
        return call

    def pick(self, eligible: Eligible | None = None) -> Call | None:
        """Return the call whose request is sent next, and put its caller at the end of the round robin.

        The call stays in the queue. None if there is no call for which ``eligible`` returns True; without ``eligible``
        every call may be picked.
        """
        others = self._others
        if len(self._callers) == 1 and others.callers:  # the usual case
            caller = others.callers[0]
            call = caller.pick(eligible)
            if call is not None and caller.served is None:
                self._last = others.last = caller
                self._passed = self._allowed = 0
                return call
        else:
            call = self.peek(eligible)
        if call is not None:
            self.take_turn(call)
        return call

    def peek(self, eligible: Eligible | None = None) -> Call | None:
        """Return the call that `pick` would return now; the order of callers stays unchanged.

        None if no call may be sent.
        """
        for round_ in self._rounds() if self._priority.callers else (self._others,):
            for caller in round_.callers:
                call = caller.pick(eligible)
                if call is not None:
                    return call
        return None

    def take_turn(self, call: Call) -> None:
        """Put the caller of this call, and the callers skipped before it, at the end of the round robin.

        `pick_same` then chooses among the calls of this caller. If units are served in turn, the unit of the call goes
        to the end of their order.
        """
        caller = self._last = self._callers[call.caller]
        round_ = caller.round
        round_.last = caller
        if len(self._callers) > 1:
            round_.callers.rotate(-1 - round_.callers.index(caller))
        if round_ is self._priority and self._others.callers:
            self._passed += 1
        else:
            self._passed, self._allowed = 0, len(self._priority.callers)
        if caller.served is not None:
            caller.has_served(call.unit)

    def _rounds(self) -> tuple[_Round, ...]:
        """Return the callers of priority hosts and the other callers, in the order in which they are served now."""
        if self._passed >= self._allowed:
            return self._others, self._priority
        return self._priority, self._others

    def remove(self, call: Call) -> bool:
        """Remove a call that was cancelled or has nothing more to send. Returns whether it was queued."""
        caller = self._callers.get(call.caller)
        if caller is None:
            return False
        calls = caller.calls
        if calls[0] is call:  # as a rule
            calls.popleft()
        elif call in calls:
            calls.remove(call)
        else:
            return False
        if call.is_write:
            caller.writes -= 1
        if caller.served is not None:
            left = caller.units.pop(call.unit) - 1
            if left:
                caller.units[call.unit] = left
        self.size -= 1
        self.waiting -= call.places
        if self.begun:
            self.begun.pop(call, None)
        if not calls:
            del self._callers[call.caller]
            caller.round.remove(caller)
        return True

    def __iter__(self) -> Iterator[Call]:
        for caller in (*self._priority.callers, *self._others.callers):
            yield from list(caller.calls)
