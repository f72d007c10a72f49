"""A value that is an expression over other points and the time."""

from ....points.expression import Bound


class Formula:
    """The value of an expression.

    Args:
        compute: the expression, bound to its points.
    """

    __slots__ = ("value",)

    def __init__(self, compute: Bound) -> None:
        self.value: Bound = compute

    def resume(self, time: float, value: float) -> None:
        """Nothing: the value follows from other points."""

    def state(self, time: float) -> float | None:
        """None."""
        return None
