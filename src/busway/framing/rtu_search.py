"""Search for the next frame inside damaged RTU bytes: the only work that grows with the noise on a line.

Knows bytes, running CRC states and length rules; knows no time and no conversation. A position costs one comparison. It
is rejected for good: the next search begins behind it.
"""

from collections.abc import Sequence
from functools import cache
from typing import Final

from ..codes import RTU_ADU_LIMIT
from ..pdu.message import NEED_MORE, UNKNOWN_LENGTH
from .crc import span_check
from .frame_direction import Due
from .lengths import AROUND_PDU, SHORTEST, FrameLengths, shape_of

DEAD: Final = 0
"""Result instead of the position after a frame: no frame begins here."""
WAITS: Final = -1
"""Result instead of the position after a frame: a frame may begin here, but is unfinished."""

_IMPOSSIBLE: Final = RTU_ADU_LIMIT + 1
"""A length that no frame has."""

FoundFrame = tuple[int, int]
"""Result of a search: the position where a frame begins, and the position after its end.

The second number is `WAITS` if a frame may begin there and is unfinished, and `DEAD` if no frame is found; then the
first is the end of the bytes.
"""


def find_reply(
    buffer: bytearray, states: Sequence[int], start: int, lengths: FrameLengths, due: Due | None, *, at_limit: bool
) -> FoundFrame:
    """Find the first position from ``start`` where the expected reply, or its exception reply, begins or can begin.

    Returns the position and the end of the frame there. Instead of the end, it returns `WAITS` if the frame is
    unfinished, and `DEAD` if none is found; then the position is the end of ``buffer``.

    Args:
        buffer: bytes received from the line.
        states: the running CRC (`running_states`) before each byte, and after the last one.
        start: the first position to try; earlier ones were rejected.
        lengths: the length rules.
        due: the expected reply; None if none is expected, and then nothing is found.
        at_limit: whether a position where a frame would be unfinished is rejected too.
    """
    size = len(buffer)
    if due is None:
        return size, DEAD
    unit, checks, shape_of_code = due.unit, _checks(), _shapes_of(due, lengths).get
    answers, asked = lengths.asked_replies.answers, lengths.asked_replies.length
    for at in range(start, size - SHORTEST + 1):
        if buffer[at] != unit:
            continue
        shape = shape_of_code(buffer[at + 1])
        if shape is None:
            continue
        count_at, around = shape
        if count_at:
            end = at + around + buffer[at + count_at] if at + count_at < size else size + 1
        elif around:
            end = at + around
        else:
            length = answers.get(buffer[at + 1] << 16 | buffer[at + 2] << 8 | buffer[at + 3])
            if length is None:
                length = asked(buffer, at + 1, min(size, at + RTU_ADU_LIMIT))
            if length == UNKNOWN_LENGTH:
                continue
            end = size + 1 if length == NEED_MORE else at + min(length, _IMPOSSIBLE)
        if end <= size:
            low, high = checks[end - at]
            state = states[at]
            if low[state & 0xFF] ^ high[state >> 8] == states[end]:
                return at, end
        elif not at_limit and end - at <= RTU_ADU_LIMIT:
            return at, WAITS
    return _to_end(start, size, at_limit=at_limit)


def find_any(
    buffer: bytearray, states: Sequence[int], start: int, lengths: FrameLengths, *, at_limit: bool
) -> FoundFrame:
    """Find the first position from ``start`` where a request or reply of any unit begins or can begin.

    Only functions whose length is fixed or told by a byte count are looked for. Returns the position and the end of the
    frame there. Instead of the end, it returns `WAITS` if the frame is unfinished, and `DEAD` if none is found; then
    the position is the end of ``buffer``.

    Args:
        buffer: bytes received from the line.
        states: the running CRC (`running_states`) before each byte, and after the last one.
        start: the first position to try; earlier ones were rejected.
        lengths: the length rules.
        at_limit: whether a position where a frame would be unfinished is rejected too.
    """
    size = len(buffer)
    shapes, checks = lengths.shapes, _checks()
    for at, code in enumerate(buffer[start + 1 : size - SHORTEST + 2], start):
        for count_at, around in shapes[code]:
            if not count_at:
                end = at + around
            elif at + count_at < size:
                end = at + around + buffer[at + count_at]
            else:
                end = size + 1
            if end <= size:
                low, high = checks[end - at]
                state = states[at]
                if low[state & 0xFF] ^ high[state >> 8] == states[end]:
                    return at, end
            elif not at_limit and end - at <= RTU_ADU_LIMIT:
                return at, WAITS
    return _to_end(start, size, at_limit=at_limit)


def _to_end(start: int, size: int, *, at_limit: bool) -> FoundFrame:
    """Return the result of a search that has found no frame in the bytes from ``start`` to ``size``.

    This is ``size - 3``, or ``start`` if that is later, and `WAITS`, because a frame can still begin in the last three
    bytes. If no bytes are left, or with ``at_limit``, it is ``size`` and `DEAD`.
    """
    place = max(start, size if at_limit else size - SHORTEST + 1)
    return place, DEAD if place == size else WAITS


def _shapes_of(due: Due, lengths: FrameLengths) -> dict[int, tuple[int, int]]:
    """Return, by function byte, the length rules of the expected reply and its exception reply (see `shape_of`)."""
    function, exception = due.function, due.function | 0x80
    shapes = {code: shape_of(lengths.replies[code]) for code in (function, exception)}
    if due.size > 0:
        shapes[function] = 0, due.size + AROUND_PDU
    return {code: shape for code, shape in shapes.items() if shape is not None}


@cache
def _checks() -> list[tuple[list[int], list[int]]]:
    """Return the two tables of `SpanCheck` for each frame length; cached, because a search uses them at every byte.

    Lengths that no frame has get tables that find no CRC right.
    """
    never = [-1] * 256, [0] * 256
    spans = [span_check(length) for length in range(SHORTEST, RTU_ADU_LIMIT + 1)]
    return [never] * SHORTEST + [(span.low, span.high) for span in spans] + [never] * RTU_ADU_LIMIT
