"""A serial line for tests that are not about gaps within frames."""

from typing import Any

from busway.testing.line import PacedLine

LONGEST_FRAME = 0.5
"""Seconds; 256 characters take less from 9600 baud on."""


def line_of_whole_frames(ports: int = 2, baud: int = 19_200, **options: Any) -> PacedLine:
    """A `PacedLine` that hands over each frame in one piece, when its last character has passed.

    A pause of the machine falls between frames then. Within one it would look like silence, and the frame is lost, as
    on a real line.
    """
    return PacedLine(ports, baud, granularity=LONGEST_FRAME, **options)
