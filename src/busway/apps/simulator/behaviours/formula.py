"""Behaviour ``formula``: a value computed from other points and the time."""

from ....points.expression import BoundExpression


class Formula:
    """Behaviour ``formula``: the point's value is computed from other points and the time.

    Args:
        compute: the expression, bound to its points: returns the value at a time, in seconds of the simulation; NaN if
            it has none, as after a division by zero.

    Attributes:
        value: the function ``compute``.
    """

    __slots__ = ("value",)

    def __init__(self, compute: BoundExpression) -> None:
        self.value: BoundExpression = compute

    def resume(self, time: float, value: float) -> None:
        """Do nothing: the value follows from other points and the time, not from an earlier value."""

    def state(self, time: float) -> float | None:
        """Return None, as a formula has no state to keep."""
        return None
