"""The interface of behaviours, as the engine of a simulation uses it."""

from typing import Protocol


class Behaviour(Protocol):
    """Interface of a behaviour, which computes the value of a simulated point at each time.

    Times are seconds of the simulation since its beginning, and never fall. `value` is called with whole multiples of
    the ``every`` of the point, the seconds between two of its values.
    """

    def value(self, time: float) -> float:
        """Return the value of the simulated point at a time, in its unit of measure; NaN if it has no value then."""

    def resume(self, time: float, value: float) -> None:
        """Continue from a value that the point has at a time; do nothing if the behaviour needs no earlier value."""

    def state(self, time: float) -> float | None:
        """Return the value at a time, to be given to `resume` after a restart; None if the behaviour keeps no state."""


class Observer(Protocol):
    """Interface of a behaviour that reads other points after each moment, and uses these values at the next moment.

    Points with such behaviours may depend on each other in a circle, as level and inflow of a tank do.
    """

    def observe(self, time: float) -> None:
        """Read and remember the values of the other points. Called once all points have their values of this time."""
