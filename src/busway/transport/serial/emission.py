"""Computes when the last character written to a serial port has left it.

Knows character times and what the system still holds; knows no clock: ``now`` is handed in.

1. Arithmetic comes first: characters leave one after the other, none before it was written.
2. What the system says can only make it later. A driver that says nothing (a pseudo-terminal) leaves the arithmetic.
"""

from .ioctl import Ioctl, asked_integer, system_ioctl

TIOCOUTQ = 0x5411
TIOCSERGETLSR = 0x5459
TRANSMITTER_EMPTY = 0x01


class CharacterClock:
    """Computes when written characters leave one serial port.

    Attributes:
        until: when the last one has left, in the clock of ``now``.
    """

    __slots__ = ("_character_time", "until")

    def __init__(self, character_time: float) -> None:
        self._character_time = character_time
        self.until: float = 0.0

    def written(self, count: int, now: float) -> float:
        """Count ``count`` written characters. Returns when the last of them will have left the port."""
        self.until = max(self.until, now) + count * self._character_time
        return self.until

    def still_held(self, count: int, now: float) -> float:
        """Correct the time by ``count`` characters still in the port. Returns when the last can have left."""
        if count:
            self.until = max(self.until, now + count * self._character_time)
        return self.until


def characters_held(descriptor: int, ioctl: Ioctl = system_ioctl) -> int:
    """Return how many written characters are still in the port, as far as the driver tells.

    The buffer's count leaves out the character that is being sent; where the driver tells whether its transmitter is
    empty, that one counts too.
    """
    waiting = asked_integer(ioctl, descriptor, TIOCOUTQ) or 0
    if waiting:
        return waiting
    state = asked_integer(ioctl, descriptor, TIOCSERGETLSR)
    return 0 if state is None or state & TRANSMITTER_EMPTY else 1
