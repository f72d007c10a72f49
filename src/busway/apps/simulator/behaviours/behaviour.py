"""The interface of behaviours, as the engine of a simulation uses it."""

from typing import Protocol


class Behaviour(Protocol):
    """Interface of a behaviour, which computes the value of a simulated point at each time.

    Times are seconds of the simulation, each a whole multiple of the point's ``every``, and never fall.
    """

    def value(self, time: float) -> float:
        """Return the value of the simulated point at a time; NaN if there is none."""

    def resume(self, time: float, value: float) -> None:
        """Continue from a given value at a time, if the behaviour depends on its last value; else do nothing."""

    def state(self, time: float) -> float | None:
        """Return the value to continue from after a restart; None if the behaviour depends only on time."""


class Observer(Protocol):
    """Interface of a behaviour whose value depends on how other points change over time.

    So points may depend on each other in a circle, as level and inflow of a tank do.
    """

    def observe(self, time: float) -> None:
        """Take over the values of the other points at a time, after all of them have changed."""
