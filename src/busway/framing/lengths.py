"""Lengths of RTU frames by function code, prepared so that one look-up gives the length of a frame.

Knows the table of functions; knows no stream. Each function declares how long its messages are (`busway.pdu`). This
file turns the declarations into one number per function code, because a receiver needs it at every byte of a noisy
line.

1. All lengths here are of whole frames: unit, PDU, CRC.
2. A rule is one number. Above 0 it is the length. Below 0 its negative is the offset of the byte count, counted from
   the unit; the byte count counts the bytes after it. 0: the function is unknown. `ASK`: the length has to be computed
   by the table of functions (sub-functions, counts of two bytes).
"""

from collections.abc import Callable
from functools import cache
from typing import Final

from ..codes import RTU_ADU_LIMIT
from ..pdu.functions import FunctionTable
from ..pdu.message import NEED_MORE, UNKNOWN_LENGTH
from .received import Direction

ASK: Final = -1000
"""Rule of a function code whose lengths have to be computed from each message by the table of functions."""
AROUND_PDU: Final = 3
"""Bytes of a frame around its PDU: one of unit before it, two of CRC after it."""
SHORTEST: Final = 4
"""Fewest bytes of a frame: unit, function code, CRC."""

_SAMPLES: Final = range(0, 256, 5)
"""Byte counts with which `_counted` tests a rule, 0 and 255 among them."""

_DECIDING: Final = 3
"""Number of bytes of a PDU that nearly every length depends on: function code, and a sub-function or byte count."""
_ANSWERS_KEPT: Final = 4096
"""Most lengths and rules that are cached for each direction: noise must not fill the memory."""

LengthRule = Callable[[bytes, int, int], int]
"""Function that takes bytes with the start and end of a PDU in them, and returns the length of the whole PDU in bytes.

It returns `NEED_MORE` or `UNKNOWN_LENGTH` if the bytes do not tell it.
"""


@cache
def lengths_of(functions: FunctionTable) -> "FrameLengths":
    """Return the frame lengths of a table of functions; computed at the first call for a table, then cached."""
    return FrameLengths(functions)


class FrameLengths:
    """Lengths of all RTU frames of a table of functions; `length` returns that of one frame.

    Attributes:
        requests, replies: lists of the length rules; the index is the function byte 0…255. A rule above 0 is the length
            of the frame; below 0, its negative is the offset of the byte count in the frame; 0: the function is
            unknown; `ASK`: see ``asked_requests``.
        shapes: for each function byte 0…255, the rules of its reply and of its request in the form of `shape_of`;
            equal ones once, and rules of unknown functions and `ASK` are left out.
        asked_requests, asked_replies: objects that compute the length of a frame whose function byte has the rule
            `ASK`.
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
        """Return the length in bytes of the frame that starts at ``at``, from the bytes ``data[at:end]`` received.

        The result can be more bytes than were received, and above 256 if the byte count is impossible. `NEED_MORE` if
        too few bytes are there to tell; `UNKNOWN_LENGTH` if the bytes of such a frame never tell it.
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

    def may_be_request(self, frame: bytearray) -> bool:
        """Return whether the bytes of a whole frame with a right CRC can be a request.

        True for unknown functions, and for bytes that are too few for a frame.
        """
        size = len(frame)
        if size < SHORTEST:
            return True
        return frame[1] < 0x80 and self.length(Direction.REQUEST, frame, 0, size) in (UNKNOWN_LENGTH, size)


class AskedLengths:
    """Lengths of the frames of one direction whose function code has the rule `ASK`: each is computed from its content.

    Attributes:
        answers: cached lengths of whole frames, by the first three bytes of the PDU as a number of 24 bits.
    """

    __slots__ = ("_ask", "_find", "_is_reply", "_rules", "answers")

    def __init__(self, functions: FunctionTable, direction: Direction) -> None:
        self._is_reply = direction is Direction.REPLY
        self._ask: LengthRule = functions.reply_length if self._is_reply else functions.request_length
        self._find = functions.find
        self.answers: dict[int, int] = {}
        self._rules: dict[int, LengthRule] = {}

    def length(self, data: bytearray, at: int, end: int) -> int:
        """Return the length in bytes of the whole frame whose PDU, not whose unit, starts at ``at``.

        Only ``data[at:end]`` is looked at. `NEED_MORE` if these bytes are too few to tell; `UNKNOWN_LENGTH` if the
        bytes of such a frame never tell it. The length follows from the first three bytes of the PDU and is cached
        under them. Only for identification objects (function 43) more bytes are needed. For these the length rule is
        cached instead, so that noise which looks like such a reply costs little.
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
    """Return a length rule as two numbers: offset of the byte count, and the number of bytes that it does not count.

    The rule of replies of function 03 gives (2, 5): the byte count is at offset 2 of the frame, whose length is that
    count plus 5. Without a byte count the numbers are 0 and the fixed length: the rule of requests of function 03 gives
    (0, 8). The result is (0, 0) for `ASK`, and None for the rule 0 of an unknown function.
    """
    if rule == 0:
        return None
    if rule == ASK:
        return 0, 0
    return (0, rule) if rule > 0 else (-rule, 3 - rule)


def _flatten(functions: FunctionTable, code: int, length: LengthRule) -> int:
    """Return the length rule of a function code as one number, found by calling ``length`` for sample messages.

    Above 0 it is the length of the whole frame; below 0, its negative is the offset of the byte count in the frame; 0:
    the function is unknown, or its messages never tell their length; `ASK`: the length depends on more bytes.

    Args:
        functions: the table of functions.
        code: function byte, 0…255; exception replies have 0x80 added.
        length: the method of ``functions`` that gives the length of a request or of a reply.
    """
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
    """Return the rule "byte count at offset ``shown``" if a frame's length follows from that byte; else `ASK`.

    The byte must count all the bytes after it.
    """
    for count in _SAMPLES:
        for filler in (0x00, 0x5A, 0xFF):
            message = bytes((code,)) + bytes((filler,)) * (shown - 2) + bytes((count,))
            if length(message, 0, shown) != shown + count:
                return ASK
    return -shown
