"""The interface of behaviours, as the engine of a simulation uses it."""

from typing import Protocol


class Behaviour(Protocol):
    """Interface of a behaviour, which gives a point its value at each time.

    Times are seconds of the simulation, each a whole multiple of the point's ``every``, and never fall.
    """

    def value(self, time: float) -> float:
        """Return the value of the point at a time; NaN if there is none."""

    def resume(self, time: float, value: float) -> None:
        """Continue from a value at a time, if the behaviour depends on its last value; otherwise do nothing."""

    def state(self, time: float) -> float | None:
        """Return the value to continue from after a restart; None if the behaviour depends on time alone."""


class Observer(Protocol):
    """Interface of a behaviour that follows other points: it sees their values and uses them at the next moment.

    So points may depend on each other in a circle, as level and inflow of a tank do.
    """

    def observe(self, time: float) -> None:
        """Note the values of the other points at a time, after all of them have changed."""
