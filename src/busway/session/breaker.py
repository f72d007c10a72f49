"""Which units behind a link are asked at all: one circuit breaker per unit.

Knows timeouts, replies and times; knows no bytes. ``jitter`` is handed in, a number 0…1 per call, so a test can fix it.

1. Three timeouts in a row open the breaker of a unit: its requests fail at once and cost the line nothing.
2. When the pause is over, the next real request probes, once and with a short timeout; nothing is sent for its own
   sake. A probe that fails doubles the pause, up to ``longest_pause``; that limit, with the probe's own time, is how
   long a revived unit may wait.
3. A probe waits twice as long as the unit, or else the slowest on the line, usually takes, and ``probe_timeout`` at
   least. With the defaults three dead units cost the others less than a twentieth of the line.
4. Any valid reply of the unit, also a late one, closes it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from ..errors import ConfigError

OPEN_AFTER_BY_FRAMING: Mapping[str, int] = MappingProxyType({"mbap": 0, "rtu": 3, "ascii": 3})
"""The default of ``open_after``, by the framing of an endpoint: a device on TCP disturbs no other. Behind a gateway the
units of a server share its connection, and the default is that of a line."""


@dataclass(frozen=True, slots=True)
class BreakerParameters:
    """When a unit is given up, and when it is tried again.

    Attributes:
        open_after: timeouts in a row that open the breaker; 0 switches it off. Where nothing is said, the framing of
            the endpoint decides; it is 3 behind a gateway.
        first_pause, longest_pause: seconds until the first probe, and between probes at most.
        probe_timeout: seconds that a probe waits for its reply at least, where the request's own timeout is not
            shorter; a unit that never answered and is slower than all others needs a longer one.
    """

    open_after: int = OPEN_AFTER_BY_FRAMING["rtu"]
    first_pause: float = 3.0
    longest_pause: float = 8.5
    probe_timeout: float = 0.1

    def __post_init__(self) -> None:
        for name, low, high in (
            ("open_after", 0, 1000),
            ("first_pause", 0.01, 3600),
            ("longest_pause", 0.01, 3600),
            ("probe_timeout", 0.001, 3600),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"must be {low:g}…{high:g}, not {getattr(self, name):g}", key=name)
        if self.longest_pause < self.first_pause:
            raise ConfigError(f"must be at least first_pause, {self.first_pause:g}", key="longest_pause")


class BreakerState(Enum):
    """Where a unit's breaker stands."""

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
    """The breakers of one link."""

    __slots__ = ("_jitter", "_units", "parameters")

    def __init__(self, parameters: BreakerParameters, jitter: Callable[[], float]) -> None:
        self.parameters = parameters
        self._jitter = jitter
        self._units: dict[int, _UnitBreaker] = {}

    def state(self, unit: int) -> BreakerState:
        """Where the breaker of a unit stands."""
        breaker = self._units.get(unit)
        return BreakerState.CLOSED if breaker is None else breaker.state

    def states(self) -> dict[int, BreakerState]:
        """All units that ever timed out, with their state."""
        return {unit: breaker.state for unit, breaker in self._units.items()}

    @property
    def doubtful(self) -> Mapping[int, object]:
        """The units that timed out and have not answered since. The same one for ever: a look at it costs no call."""
        return self._units

    def suspended_for(self, unit: int, now: float) -> float | None:
        """Seconds until a request may probe the unit; None if it may be asked now."""
        breaker = self._units.get(unit)
        if breaker is None or breaker.state is BreakerState.CLOSED or now >= breaker.probe_at:
            return None
        return breaker.probe_at - now

    def asked(self, unit: int, now: float, timeout: float, usual: float = 0.0) -> float:
        """A request goes to the unit, which usually takes ``usual`` seconds; its timeout, shorter for a probe."""
        breaker = self._units.get(unit)
        if breaker is None or breaker.state is BreakerState.CLOSED:
            return timeout
        breaker.state = BreakerState.PROBING
        probe = min(timeout, max(self.parameters.probe_timeout, 2 * usual))
        breaker.probe_at = now + probe
        return probe

    def is_probing(self, unit: int) -> bool:
        """Whether the request in flight to the unit is a probe: it is not repeated."""
        breaker = self._units.get(unit)
        return breaker is not None and breaker.state is BreakerState.PROBING

    def not_decided(self, unit: int) -> None:
        """The port was lost while the unit was asked: a probe is as if it had not been made."""
        breaker = self._units.get(unit)
        if breaker is not None and breaker.state is BreakerState.PROBING:
            breaker.state = BreakerState.OPEN

    def answered(self, unit: int) -> bool:
        """The unit gave a valid reply; whether that closed its breaker."""
        breaker = self._units.pop(unit, None)
        return breaker is not None and breaker.state is not BreakerState.CLOSED

    def timed_out(self, unit: int, now: float) -> bool:
        """The unit did not answer; whether its breaker is open now."""
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
        # Pauses are cut, never stretched, so that the longest one is a promise.
        breaker.probe_at = now + breaker.pause * (0.9 + 0.1 * self._jitter())
        return True
