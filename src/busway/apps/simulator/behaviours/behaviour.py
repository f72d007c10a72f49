"""The interface of behaviours, as the engine of a simulation uses it."""

from typing import Protocol


class Behaviour(Protocol):
    """Interface of a behaviour, which computes the value of a simulated point at each time.

    Times are seconds of the simulation and never fall; those of `value` are whole multiples of the point's ``every``.
    """

    def value(self, time: float) -> float:
        """Return the value of the simulated point at a time, in its unit of measure; NaN if there is none."""

    def resume(self, time: float, value: float) -> None:
        """Continue from a given value at a time, if the behaviour depends on its last value; else do nothing."""

    def state(self, time: float) -> float | None:
        """Return the value from which `resume` continues after a restart; None if the behaviour keeps no state."""


class Observer(Protocol):
    """Interface of a behaviour that reads other points after each moment, and uses these values at the next moment.

    Points with such behaviours may depend on each other in a circle, as level and inflow of a tank do.
    """

    def observe(self, time: float) -> None:
        """Read and remember the values of the other points, once all of them have their values of this time."""
