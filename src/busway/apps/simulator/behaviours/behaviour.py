"""What the engine asks of a behaviour."""

from typing import Protocol


class Behaviour(Protocol):
    """A value as a function of time and of a state of its own.

    Times are seconds of the simulation, each a whole multiple of the point's ``every``, and never fall.
    """

    def value(self, time: float) -> float:
        """The value at a time; NaN where there is none."""

    def resume(self, time: float, value: float) -> None:
        """Go on from a value at a time, where the behaviour goes on from values at all."""

    def state(self, time: float) -> float | None:
        """What it goes on from at a time, to be kept over a restart; None for what depends on time alone."""


class Observer(Protocol):
    """A behaviour that depends on other points over time: it sees them after each moment, and uses that at the next.

    So points may depend on each other in a circle, as level and inflow of a tank do.
    """

    def observe(self, time: float) -> None:
        """See the other points as they are at a time, after all of them have changed."""
