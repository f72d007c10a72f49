"""Lengths of RTU frames by function code, prepared so that one look-up gives the length of a frame.

Knows the table; knows no stream. The functions say themselves how long their messages are (`busway.pdu`); what they
say is turned here into one number per function code, because a receiver asks for every byte of a noisy line.

1. All lengths here are of whole frames: unit, PDU, CRC.
2. A number above 0 is the length; below 0, the byte count is that many bytes behind the unit and counts what
   follows it; 0, the function is unknown; `ASK`, only the table itself can tell (sub-functions, counts of two bytes).
"""

from collections.abc import Callable
from functools import cache
from typing import Final

from ..codes import RTU_ADU_LIMIT
from ..pdu.functions import FunctionTable
from ..pdu.message import NEED_MORE, UNKNOWN_LENGTH
from .received import Direction

ASK: Final = -1000
AROUND_PDU: Final = 3
"""One byte of unit before the PDU, two of CRC behind it."""
SHORTEST: Final = 4
"""Unit, function code, CRC."""

_SAMPLES: Final = range(0, 256, 5)
"""Byte counts that a rule is tried with, 0 and 255 among them."""

_DECIDING: Final = 3
"""Function code and two bytes: a sub-function, or a byte count of two bytes."""
_ANSWERS_KEPT: Final = 4096
"""Answers and rules of the table that are kept for each direction: noise must not fill the memory."""

LengthRule = Callable[[bytes, int, int], int]


@cache
def lengths_of(functions: FunctionTable) -> "FrameLengths":
    """Return the frame lengths of a table of functions, computed once for all receivers that use it."""
    return FrameLengths(functions)


class FrameLengths:
    """Lengths of all frames of a table of functions, by direction and function code.

    Attributes:
        requests, replies: the flattened rule of each byte 0…255 in the place of the function code.
        shapes: both rules of each byte that one look can apply, as (place of the byte count or 0, bytes besides what
            it counts); the reply first.
        answers: what the table said lately where it had to be asked, by direction and the first three bytes of the PDU.
    """

    __slots__ = ("asked_replies", "asked_requests", "replies", "requests", "shapes")

    def __init__(self, functions: FunctionTable) -> None:
        self.requests: list[int] = [_flatten(functions, code, functions.request_length) for code in range(256)]
        self.replies: list[int] = [_flatten(functions, code, functions.reply_length) for code in range(256)]
        self.shapes: list[tuple[tuple[int, int], ...]] = [
            tuple(dict.fromkeys(shape for shape in map(shape_of, rules) if shape is not None and shape[1]))
            for rules in zip(self.replies, self.requests, strict=True)
        ]
        self.asked_requests: AskedLengths = AskedLengths(functions, Direction.REQUEST)
        self.asked_replies: AskedLengths = AskedLengths(functions, Direction.REPLY)

    def length(self, direction: Direction, data: bytearray, at: int, end: int) -> int:
        """Return the length of the frame that starts at ``at``, from the bytes ``data[at:end]`` received so far.

        `NEED_MORE` while it cannot be told, `UNKNOWN_LENGTH` where the content never tells it, and a number above
        256 where the byte count cannot be.
        """
        if end - at < 2:
            return NEED_MORE
        rule = (self.requests if direction is Direction.REQUEST else self.replies)[data[at + 1]]
        if rule > 0:
            return rule
        if rule == 0:
            return UNKNOWN_LENGTH
        if rule != ASK:
            return data[at - rule] + 1 - rule + 2 if at - rule < end else NEED_MORE
        asked = self.asked_requests if direction is Direction.REQUEST else self.asked_replies
        return asked.length(data, at + 1, min(end, at + RTU_ADU_LIMIT))


class AskedLengths:
    """Lengths of frames that depend on more than one byte; computed for each frame from its beginning.

    Attributes:
        answers: recently computed lengths, by the first three bytes of the PDU.
    """

    __slots__ = ("_ask", "_find", "_is_reply", "_rules", "answers")

    def __init__(self, functions: FunctionTable, direction: Direction) -> None:
        self._is_reply = direction is Direction.REPLY
        self._ask: LengthRule = functions.reply_length if self._is_reply else functions.request_length
        self._find = functions.find
        self.answers: dict[int, int] = {}
        self._rules: dict[int, LengthRule] = {}

    def length(self, data: bytearray, at: int, end: int) -> int:
        """Return the length of the frame whose PDU starts at ``at``, as `FrameLengths.length` does.

        Three bytes decide for all but the objects of function 43. There the rule is kept instead of the answer: a line
        full of what looks like such replies is asked at every one of them.
        """
        shown = bytes(data[at:end])
        if len(shown) < _DECIDING:
            return _around(self._ask(shown, 0, len(shown)))
        beginning = shown[0] << 16 | shown[1] << 8 | shown[2]
        rule = self._rules.get(beginning)
        if rule is not None:
            return _around(rule(shown, 0, len(shown)))
        answer = self.answers.get(beginning)
        if answer is None:
            answer = _around(self._ask(shown[:_DECIDING], 0, _DECIDING))
            if answer == NEED_MORE:
                self._keep_rule(beginning, shown)
                answer = _around(self._ask(shown, 0, len(shown)))
            elif len(self.answers) < _ANSWERS_KEPT:
                self.answers[beginning] = answer
        return answer

    def _keep_rule(self, beginning: int, shown: bytes) -> None:
        function = self._find(shown, 0, _DECIDING)
        if function is not None and not shown[0] & 0x80 and len(self._rules) < _ANSWERS_KEPT:
            self._rules[beginning] = function.Reply.wire_length if self._is_reply else function.wire_length


def _around(length: int) -> int:
    return length if length in (NEED_MORE, UNKNOWN_LENGTH) else length + AROUND_PDU


def shape_of(rule: int) -> tuple[int, int] | None:
    """Return a length rule as (offset of the byte count or 0, bytes that it does not count); None if impossible.

    (0, 0) where the table has to be asked; None where the function is unknown.
    """
    if rule == 0:
        return None
    if rule == ASK:
        return 0, 0
    return (0, rule) if rule > 0 else (-rule, 3 - rule)


def _flatten(functions: FunctionTable, code: int, length: LengthRule) -> int:
    """Find the length rule of a function code by giving its message class longer and longer beginnings."""
    if code & 0x7F == 0:
        return 0
    known = code in functions
    if code & 0x80 and length == functions.reply_length:
        known = True
    if not known:
        return 0
    shown = 1
    while length(bytes((code,)) + bytes(shown - 1), 0, shown) == NEED_MORE:
        shown += 1
        if shown > RTU_ADU_LIMIT:
            return ASK
    if shown == 1:
        alone = length(bytes((code,)), 0, 1)
        return 0 if alone == UNKNOWN_LENGTH else alone + AROUND_PDU
    return _counted(code, shown, length)


def _counted(code: int, shown: int, length: LengthRule) -> int:
    """Return the offset of the byte count if that byte counts exactly the bytes after it; else `ASK`."""
    for count in _SAMPLES:
        for filler in (0x00, 0x5A, 0xFF):
            message = bytes((code,)) + bytes((filler,)) * (shown - 2) + bytes((count,))
            if length(message, 0, shown) != shown + count:
                return ASK
    return -shown
