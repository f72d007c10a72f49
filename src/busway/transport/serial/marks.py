"""Removes the marks that the system puts before characters that arrived damaged (``PARMRK``).

Knows the marks of termios: ``FF 00 x`` is a character x with a parity or framing error, ``FF 00 00`` also a break,
``FF FF`` one good FF. Knows no port, except to switch the marks on.

1. A damaged character stays in the data as it was received, so that a frame keeps its length. The framing decides what
   to do with it (Serial Line V1.02 §2.5.1: the frame is discarded).
2. A mark may be split between two reads, after any of its bytes.
"""

from dataclasses import dataclass
from enum import Enum

MARK = 0xFF


class _Within(Enum):
    DATA = 0
    MARK = 1
    """after FF"""
    DAMAGED = 2
    """after FF 00"""


@dataclass(frozen=True, slots=True)
class UnmarkedBytes:
    """Received bytes without the system's damage marks (``data``), and how many of them are damaged (``errors``)."""

    data: bytes
    errors: int


class MarkDecoder:
    """Removes the system's damage marks from received bytes and counts them, also across reads."""

    __slots__ = ("_within",)

    def __init__(self) -> None:
        self._within = _Within.DATA

    def feed(self, stream: bytes) -> UnmarkedBytes:
        """Return the received bytes ``stream`` without damage marks, and how many of them are damaged.

        The beginning of a mark at the end of ``stream`` is kept for the next call, so the result can be empty.
        """
        if self._within is _Within.DATA and MARK not in stream:
            return UnmarkedBytes(stream, 0)
        data = bytearray()
        errors = 0
        within = self._within
        for byte in stream:
            if within is _Within.DATA:
                if byte == MARK:
                    within = _Within.MARK
                else:
                    data.append(byte)
            elif within is _Within.MARK:
                if byte == 0:
                    within = _Within.DAMAGED
                    continue
                if byte != MARK:
                    # No system sends this; both bytes are kept rather than guessed about.
                    data.append(MARK)
                data.append(byte)
                within = _Within.DATA
            else:
                data.append(byte)
                errors += 1
                within = _Within.DATA
        self._within = within
        return UnmarkedBytes(bytes(data), errors)


def switch_marks_on(descriptor: int) -> None:
    """Ask the system to check received characters and mark damaged ones. Raises `OSError` if it refuses."""
    import termios  # where ports have no descriptors there is no such module, and this is not reached

    try:
        attributes = termios.tcgetattr(descriptor)
        attributes[0] |= termios.INPCK | termios.PARMRK
        attributes[0] &= ~(termios.IGNPAR | termios.IGNBRK | termios.BRKINT | termios.ISTRIP)
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
    except termios.error as error:
        raise OSError(*error.args) from error
