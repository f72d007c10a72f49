"""Circuit breakers, one for each unit of a link: requests to a silent unit fail at once and delay no other unit.

Knows timeouts, replies and times; knows no bytes. ``jitter`` returns a number 0…1; a test can fix it.

1. ``open_after`` timeouts in a row open the breaker of a unit: its requests fail at once and cost the line nothing.
2. After a pause the next request of a caller is the probe: it is sent once, with a short timeout. The breaker sends no
   requests of its own. A failed probe doubles the pause, up to ``longest_pause``; a unit that is back is used again
   after at most that limit plus the probe's own time.
3. A probe waits twice as long as the unit (or, if unknown, the slowest on the line) usually takes, at least
   ``probe_timeout``, and never longer than the timeout of its call. With the defaults three dead units cost the others
   less than a twentieth of the line.
4. Any valid reply of the unit, even a late one, closes its breaker.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from ..options.lines import BreakerParameters


class BreakerState(Enum):
    """States of a unit's circuit breaker.

    CLOSED: requests are sent. OPEN: they fail at once until a pause is over. PROBING: one request was sent to see
    whether the unit answers again.
    """

    CLOSED = "closed"
    OPEN = "open"
    PROBING = "probing"


@dataclass(slots=True)
class _UnitBreaker:
    state: BreakerState = BreakerState.CLOSED
    timeouts: int = 0
    pause: float = 0.0
    probe_at: float = 0.0


class Breakers:
    """The circuit breakers of one link, one for each unit.

    Args:
        parameters: number of timeouts that open a breaker, pauses, and the shortest timeout of a probe.
        jitter: returns a random number 0…1; a pause lasts nine tenths to all of its full length.
    """

    __slots__ = ("_jitter", "_units", "parameters")

    def __init__(self, parameters: BreakerParameters, jitter: Callable[[], float]) -> None:
        self.parameters: BreakerParameters = parameters
        self._jitter = jitter
        self._units: dict[int, _UnitBreaker] = {}

    def state(self, unit: int) -> BreakerState:
        """Return the state of a unit's circuit breaker: closed, open or probing."""
        breaker = self._units.get(unit)
        return BreakerState.CLOSED if breaker is None else breaker.state

    def states(self) -> dict[int, BreakerState]:
        """Return the state of the circuit breaker, by unit, of each unit that timed out and has not answered since."""
        return {unit: breaker.state for unit, breaker in self._units.items()}

    @property
    def doubtful(self) -> Mapping[int, object]:
        """A mapping whose keys are the units that timed out and have not answered since; it stays up to date.

        Do not use its values.
        """
        return self._units

    def suspended_for(self, unit: int, now: float) -> float | None:
        """Return the seconds until a suspended unit may be asked again; None if a request to it may be sent now.

        While a probe is in flight, these are the seconds until the probe times out.
        """
        breaker = self._units.get(unit)
        if breaker is None or breaker.state is BreakerState.CLOSED or now >= breaker.probe_at:
            return None
        return breaker.probe_at - now

    def asked(self, unit: int, now: float, timeout: float, usual: float = 0.0) -> float:
        """Record that a request is sent to a unit, and return the timeout to use, in seconds.

        It is ``timeout`` while the circuit breaker is closed. Otherwise the request is the probe, and the state becomes
        PROBING. The timeout is then twice ``usual``, but at least ``probe_timeout`` of the parameters, and never more
        than ``timeout``. ``usual`` is the seconds that the unit usually takes to answer; 0 if unknown.
        """
        breaker = self._units.get(unit)
        if breaker is None or breaker.state is BreakerState.CLOSED:
            return timeout
        breaker.state = BreakerState.PROBING
        probe = min(timeout, max(self.parameters.probe_timeout, 2 * usual))
        breaker.probe_at = now + probe
        return probe

    def is_probing(self, unit: int) -> bool:
        """Whether the request in flight to this unit is a probe, sent to see whether the unit answers again.

        A probe is not repeated.
        """
        breaker = self._units.get(unit)
        return breaker is not None and breaker.state is BreakerState.PROBING

    def not_decided(self, unit: int) -> None:
        """Record that a probe ended without showing whether the unit answers, such as by a lost connection.

        The circuit breaker is open again, and the next request that may be sent is the probe. Does nothing if no probe
        was in flight.
        """
        breaker = self._units.get(unit)
        if breaker is not None and breaker.state is BreakerState.PROBING:
            breaker.state = BreakerState.OPEN

    def none_decided(self) -> None:
        """Record that all probes ended without showing whether their units answer."""
        for unit in self._units:
            self.not_decided(unit)

    def answered(self, unit: int) -> bool:
        """Record a valid reply of a unit, even a late one. Returns whether the reply closed an open circuit breaker."""
        breaker = self._units.pop(unit, None)
        return breaker is not None and breaker.state is not BreakerState.CLOSED

    def timed_out(self, unit: int, now: float) -> bool:
        """Record that a unit did not answer in time. Returns whether its circuit breaker is open now.

        It opens after ``open_after`` timeouts in a row, and again after a probe without answer. If ``open_after`` is 0,
        breakers are off: nothing is recorded, and the result is False.
        """
        if not self.parameters.open_after:
            return False
        breaker = self._units.setdefault(unit, _UnitBreaker())
        breaker.timeouts += 1
        if breaker.state is BreakerState.PROBING:
            breaker.pause = min(breaker.pause * 2, self.parameters.longest_pause)
        elif breaker.timeouts < self.parameters.open_after:
            return False
        else:
            breaker.pause = self.parameters.first_pause
        breaker.state = BreakerState.OPEN
        # Jitter only shortens pauses, so ``longest_pause`` holds.
        breaker.probe_at = now + breaker.pause * (0.9 + 0.1 * self._jitter())
        return True
