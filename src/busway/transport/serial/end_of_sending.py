"""Computes when the last character written to a serial port has left it.

Knows character times and how many characters the system still holds; knows no clock: ``now`` is an argument.

1. The time is computed first: characters leave one after the other, none before it was written.
2. What the driver reports can only make it later. If it reports nothing (a pseudo-terminal), the computed time holds.
"""

from .ioctl import Ioctl, asked_integer, system_ioctl

TIOCOUTQ = 0x5411
TIOCSERGETLSR = 0x5459
TRANSMITTER_EMPTY = 0x01


class EndOfSending:
    """Computes when written characters leave one serial port.

    Attributes:
        until: when the last written character will have left, in the clock of ``now``.
    """

    __slots__ = ("_character_time", "until")

    def __init__(self, character_time: float) -> None:
        self._character_time = character_time
        self.until: float = 0.0

    def written(self, count: int, now: float) -> float:
        """Record that ``count`` characters were written at ``now``. Returns when the last of them will have left."""
        self.until = max(self.until, now) + count * self._character_time
        return self.until

    def still_held(self, count: int, now: float) -> float:
        """Make ``until`` later if ``count`` characters, still in the port at ``now``, need that. Returns ``until``."""
        if count:
            self.until = max(self.until, now + count * self._character_time)
        return self.until


def characters_held(descriptor: int, ioctl: Ioctl = system_ioctl) -> int:
    """Return how many written characters are still in the port, as far as the driver tells.

    The system's count leaves out the character that is being sent. So if the count is 0, and the driver tells that its
    transmitter is not empty, the result is 1. If the driver tells nothing, it is 0.
    """
    waiting = asked_integer(ioctl, descriptor, TIOCOUTQ) or 0
    if waiting:
        return waiting
    state = asked_integer(ioctl, descriptor, TIOCSERGETLSR)
    return 0 if state is None or state & TRANSMITTER_EMPTY else 1
