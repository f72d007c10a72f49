"""Limiter for repeated log messages: the first is logged at once, then one a minute with the number left out.

Pure: knows names and the times that it is given; logs nothing itself.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

PAUSE: Final = 60.0
"""Seconds between two logged messages about the same name."""
_NAMES: Final = 1024
"""Most names that are remembered; beyond that, the name logged longest ago is forgotten, so that memory stays
bounded.
"""


@dataclass(slots=True)
class _Said:
    when: float
    since: int = 0


class LogLimiter:
    """Decides whether a repeated log message is written now, and counts those that are not.

    ``pause``: least seconds between two messages about the same name.
    """

    def __init__(self, pause: float = PAUSE) -> None:
        self._pause = pause
        self._said: OrderedDict[str, _Said] = OrderedDict()

    def admit(self, name: str, now: float) -> int | None:
        """Decide about one more message: None means that the caller must not log it now, a number that it must.

        The number says how many messages about ``name`` were suppressed since the last one that was logged, 0 or more.

        Args:
            name: what the message is about, such as a host; messages about one name repeat each other.
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


def suppressed_note(repeated: int) -> str:
    """Return a suffix for a log line that says how many equal messages were suppressed; empty if none were."""
    return f" ({repeated} more since the last line)" if repeated else ""
