"""What is said again and again: a line at first, and then how often, once in a while.

Pure: knows names and times handed in; logs nothing itself. Whoever knocks a thousand times a second is counted a
thousand times, and written down once.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

PAUSE: Final = 60.0
"""Seconds between two lines about the same name."""
_NAMES: Final = 1024
"""Names that are remembered; whoever has many addresses makes us forget, not grow."""


@dataclass(slots=True)
class _Said:
    when: float
    since: int = 0


class Repeats:
    """Tells whether something is to be said now."""

    def __init__(self, pause: float = PAUSE) -> None:
        self._pause = pause
        self._said: OrderedDict[str, _Said] = OrderedDict()

    def again(self, name: str, now: float) -> int | None:
        """How often it happened since it was said last, if it is to be said now; None if not.

        Args:
            name: whom or what it is about.
            now: seconds, monotonic.
        """
        said = self._said.get(name)
        if said is not None and now < said.when + self._pause:
            said.since += 1
            return None
        self._said[name] = _Said(now)
        self._said.move_to_end(name)
        if len(self._said) > _NAMES:
            self._said.popitem(last=False)
        return 0 if said is None else said.since


def so_often(repeated: int) -> str:
    """What a line ends with."""
    return f" ({repeated} more since the last line)" if repeated else ""
