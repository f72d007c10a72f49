"""Explains a frame from an unknown source: framing, direction and every field, also of broken frames.

Knows the framings and the description of PDUs; knows no connection. No function raises an error, whatever the bytes.

1. Framing: a frame that proves its framing is taken first (MBAP by protocol and length, RTU by CRC, ASCII by colon),
   then a PDU that is valid by itself, then the likeliest broken frame.
2. Direction: a frame is a reply if it answers the request before it; else its length and limits decide. Some
   requests and replies are alike (05, 06, 08, 22); the dissection says so.
3. The parts of a dissection hold all bytes, in their order.
4. The time is linear in the bytes: a stream of MBAP frames is cut by its headers, each frame looked at once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from ..codes import ASCII_ADU_LIMIT, PDU_LIMIT, RTU_ADU_LIMIT
from ..framing.crc import crc16, crc_bytes
from ..framing.lrc import lrc
from ..framing.mbap import HEADER_SIZE, MAX_LENGTH, MIN_LENGTH, impossible_length
from ..pdu.describe import Description, Part, describe_reply, describe_request
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed_pdu import MalformedPdu
from ..pdu.message import Request
from ..values.counts import counted


class Framing(Enum):
    """The framing of a dissected frame: MBAP, RTU, ASCII, or none around a PDU."""

    MBAP = "mbap"
    RTU = "rtu"
    ASCII = "ascii"
    PDU = "pdu"


class MessageDirection(Enum):
    """What a dissected message is: a request, a reply, or bytes that can be either."""

    REQUEST = "request"
    REPLY = "reply"
    EITHER = "request or reply"


@dataclass(frozen=True, slots=True)
class Dissection:
    """An explained frame: its framing, direction and fields, and what is wrong with it.

    Attributes:
        framing: framing around the PDU.
        direction: request or reply; ``EITHER`` if the bytes are valid as a request and as a reply.
        title: framing, addressing, function and direction in words.
        parts: all fields; offsets count from the first byte of the frame, in ASCII from its first character.
        problems: what is wrong, one sentence each; empty for a valid frame.
        answers: whether the frame is a valid reply to the last request that the `Dissector` has explained.
    """

    framing: Framing
    direction: MessageDirection
    title: str
    parts: tuple[Part, ...]
    problems: tuple[str, ...]
    answers: bool = False


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame split into its framing (addresses, checksum) and its PDU.

    Attributes:
        framing: the framing; `Framing.PDU` for none.
        pdu: function code and data; empty if the frame is too short to have them.
        head, tail: the fields before and after the PDU.
        unit, transaction: the identifiers as numbers; None where the framing has none, or the frame is too short.
        pdu_at: offset of the PDU in the frame, in bytes, in ASCII in characters.
    """

    framing: Framing
    pdu: bytes
    head: tuple[Part, ...] = ()
    tail: tuple[Part, ...] = ()
    unit: int | None = None
    transaction: int | None = None
    pdu_at: int = 0
    characters: int = 1
    """Characters that one byte takes in the frame: 2 in ASCII, else 1."""

    @property
    def title(self) -> str:
        """Framing and addresses of the frame as text, for a heading."""
        words = {Framing.MBAP: "MBAP", Framing.RTU: "RTU", Framing.ASCII: "ASCII", Framing.PDU: "PDU"}[self.framing]
        if self.transaction is not None:
            words += f", transaction {self.transaction}"
        return words if self.unit is None else f"{words}, unit {self.unit}"


@dataclass(frozen=True, slots=True)
class _Asked:
    """The last request that was explained and has no reply yet; a reply is recognised by comparison with it."""

    request: Request
    code: int
    """First byte of the request's PDU, its function code."""
    unit: int | None
    transaction: int | None


_HEX: Final = frozenset(b"0123456789ABCDEFabcdef")


class Dissector:
    """Explains frames one after the other, and remembers the last request to recognise its reply.

    Args:
        functions: the table of functions.
        framing: the framing of all frames; None to detect it for each frame.
        direction: the direction of all frames; None to detect it for each frame.

    Attributes:
        direction: the direction of the frames that follow; None to detect it. May be set at any time.
    """

    def __init__(
        self,
        functions: FunctionTable = STANDARD,
        *,
        framing: Framing | None = None,
        direction: MessageDirection | None = None,
    ) -> None:
        self._functions = functions
        self._framing = framing
        self.direction: MessageDirection | None = direction
        self._asked: _Asked | None = None

    def dissect(self, data: bytes) -> list[Dissection]:
        """Return the explained frames in ``data``: several if it consists of MBAP frames in a row, else exactly one.

        The list is never empty: bytes that are no valid frame are one `Dissection` with ``problems``.
        """
        return list(self.dissections(data))

    def dissections(self, data: bytes) -> Iterator[Dissection]:
        """Yield what `dissect` returns, one by one, so that only one explained frame of a long stream is in memory."""
        at, is_stream = 0, self._is_stream(data)
        while True:
            end = _end_of_mbap(data, at) if is_stream else len(data)
            yield self._dissected(self._frame(data[at:end]))
            if end == len(data):
                return
            at = end

    # Framing.

    def _is_stream(self, data: bytes) -> bool:
        """Whether the bytes are to be cut into MBAP frames.

        If the framing is given, True for MBAP and False for others. Else True if the bytes begin with a whole MBAP
        frame of a known function, another MBAP header follows it, and the bytes are no RTU frame with a valid CRC.
        """
        if self._framing is not None:
            return self._framing is Framing.MBAP
        end = _end_of_mbap(data, 0)
        return end < len(data) and self._knows(data[HEADER_SIZE:end]) and crc16(data) != 0

    def _frame(self, data: bytes) -> _Frame:
        if self._framing is not None:
            return _CUTTERS[self._framing](data)
        if data.startswith(b":"):
            return _cut_ascii(data)
        if _is_mbap(data):
            return _cut_mbap(data)
        if len(data) >= 4 and crc16(data) == 0:
            return _cut_rtu(data)
        candidates = (
            (data[2:4] == b"\x00\x00" and len(data) > HEADER_SIZE, _cut_mbap),
            (True, _cut_pdu),
            (len(data) >= 4, _cut_rtu),
        )
        frames = [cut(data) for possible, cut in candidates if possible]
        for frame in frames:
            if self._is_right(frame.pdu):
                return frame
        return next(
            (frame for frame in frames if self._knows(frame.pdu)), frames[-1] if len(data) < 4 else _cut_pdu(data)
        )

    def _is_right(self, pdu: bytes) -> bool:
        """Whether a PDU is a valid request or a valid reply of a known function."""
        both = (describe_request(pdu, self._functions), describe_reply(pdu, self._functions))
        return self._knows(pdu) and any(not one.problems for one in both)

    def _knows(self, pdu: bytes) -> bool:
        return bool(pdu) and pdu[0] & 0x7F in self._functions

    # Direction.

    def _dissected(self, frame: _Frame) -> Dissection:
        direction, description, answers, mismatch = self._directed(frame)
        if direction is MessageDirection.REPLY:
            self._asked = None if answers else self._asked
        elif isinstance(description.message, Request):
            self._asked = _Asked(description.message, frame.pdu[0], frame.unit, frame.transaction)
        inner = [replace(part, offset=frame.pdu_at + part.offset * frame.characters) for part in description.parts]
        around = [f"{part.name}: {part.problem}" for part in (*frame.head, *frame.tail) if part.problem]
        title = f"{frame.title}: {description.title}"
        if direction is MessageDirection.EITHER:
            title += " or its reply, which is alike"
        return Dissection(
            frame.framing,
            direction,
            title,
            (*frame.head, *inner, *frame.tail),
            (*around, *description.problems, *mismatch),
            answers,
        )

    def _directed(self, frame: _Frame) -> tuple[MessageDirection, Description, bool, tuple[str, ...]]:
        """Return a frame's direction, its fields, whether it answers the last request, and problems as sentences.

        There is a problem only if the frame is a reply to the last request's function, but not to that request.
        """
        asked = self._asked
        due = asked is not None and bool(frame.pdu) and frame.pdu[0] & 0x7F == asked.code
        as_request = describe_request(frame.pdu, self._functions)
        as_reply = describe_reply(frame.pdu, self._functions, request=asked.request if asked and due else None)
        direction = self.direction or _likelier(as_request, as_reply, frame.pdu, due=due)
        if direction is MessageDirection.REQUEST:
            return direction, as_request, False, ()
        if asked is None or not due or as_reply.problems:
            return direction, as_request if direction is MessageDirection.EITHER else as_reply, False, ()
        mismatch = _mismatch(asked, frame)
        if not mismatch:
            return MessageDirection.REPLY, as_reply, True, ()
        if direction is MessageDirection.EITHER:
            return direction, as_request, False, ()
        return direction, as_reply, False, (f"does not answer the request before it: {mismatch}",)


def _likelier(as_request: Description, as_reply: Description, pdu: bytes, *, due: bool) -> MessageDirection:
    if pdu and pdu[0] & 0x80:
        return MessageDirection.REPLY
    wrong, answer_wrong = len(as_request.problems), len(as_reply.problems)
    if not wrong and not answer_wrong:
        return MessageDirection.EITHER
    if wrong == answer_wrong:
        return MessageDirection.REPLY if due else MessageDirection.REQUEST
    return MessageDirection.REQUEST if wrong < answer_wrong else MessageDirection.REPLY


def _mismatch(asked: _Asked, frame: _Frame) -> str:
    """Return why a frame cannot be the reply to the last request, as text; empty if it can."""
    if asked.transaction != frame.transaction and None not in (asked.transaction, frame.transaction):
        return f"transaction {frame.transaction} where {asked.transaction} was asked"
    if asked.unit != frame.unit and None not in (asked.unit, frame.unit):
        return f"unit {frame.unit} where {asked.unit} was asked"
    if frame.pdu[0] & 0x80:
        return ""
    try:
        asked.request.prepare()
        asked.request.accept(frame.pdu)
    except MalformedPdu as error:
        return error.reason
    return ""


# What surrounds a PDU.


def _is_mbap(data: bytes) -> bool:
    """Whether bytes are exactly one MBAP frame, by its protocol and length fields."""
    return len(data) > HEADER_SIZE and data[2:4] == b"\x00\x00" and data[4] << 8 | data[5] == len(data) - 6


def _end_of_mbap(data: bytes, at: int) -> int:
    """Return the end of the MBAP frame at ``at`` if another one follows it; else the end of the data."""
    if _looks_like_mbap(data[at : at + HEADER_SIZE + 1]):
        end = at + 6 + (data[at + 4] << 8 | data[at + 5])
        if _looks_like_mbap(data[end : end + HEADER_SIZE + 1]):
            return end
    return len(data)


def _cut_mbap(data: bytes) -> _Frame:
    if len(data) < HEADER_SIZE:
        cut_off = Part(0, data, "header", problem=f"{counted(len(data), 'byte')} where MBAP has {HEADER_SIZE}")
        return _Frame(Framing.MBAP, b"", (cut_off,), pdu_at=len(data))
    transaction, protocol, length = (data[at] << 8 | data[at + 1] for at in (0, 2, 4))
    following = len(data) - 6
    problem = ""
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        problem = impossible_length(length)
    elif length != following:
        problem = f"announces {counted(length, 'byte')}, and {following} follow"
    head = (
        Part(0, data[:2], "transaction", str(transaction)),
        Part(2, data[2:4], "protocol", str(protocol), "is 0 in Modbus" if protocol else ""),
        Part(4, data[4:6], "length", str(length), problem),
        Part(6, data[6:7], "unit", str(data[6])),
    )
    return _Frame(Framing.MBAP, data[HEADER_SIZE:], head, (), data[6], transaction, HEADER_SIZE)


def _looks_like_mbap(data: bytes) -> bool:
    return len(data) > HEADER_SIZE and data[2:4] == b"\x00\x00" and MIN_LENGTH <= data[4] << 8 | data[5] <= MAX_LENGTH


def _cut_rtu(data: bytes) -> _Frame:
    if len(data) < 4:
        head = Part(0, data, "frame", problem=f"{counted(len(data), 'byte')} where RTU has at least 4")
        return _Frame(Framing.RTU, b"", (head,))
    wanted = crc_bytes(data[:-2])
    problem = "" if wanted == data[-2:] else f"is {data[-2:].hex(' ')} where {wanted.hex(' ')} fits"
    limit = f"the frame has {len(data)} bytes, and RTU at most {RTU_ADU_LIMIT}" if len(data) > RTU_ADU_LIMIT else ""
    head = Part(0, data[:1], "unit", str(data[0]), limit)
    tail = Part(len(data) - 2, data[-2:], "CRC", "fits" if not problem else "", problem)
    return _Frame(Framing.RTU, data[1:-2], (head,), (tail,), data[0], pdu_at=1)


def _cut_ascii(data: bytes) -> _Frame:
    """Split an ASCII frame (``:``, pairs of characters, CR LF) into its parts.

    A missing CR LF is no problem, as copies of frames often lose the end. The PDU is empty if a character is no
    hexadecimal digit, their number is odd, or they are fewer than three bytes.
    """
    body = data[1:] if data.startswith(b":") else data
    text = body.rstrip(b"\r\n")
    ending = body[len(text) :]
    wrong = next((index for index, each in enumerate(text) if each not in _HEX), None)
    start = Part(0, b":", "start", ":") if data.startswith(b":") else Part(0, b"", "start", problem="is no ':'")
    first = len(data) - len(body)
    if wrong is not None or len(text) % 2:
        problem = (
            f"character {first + wrong} is {chr(text[wrong])!r}, no hexadecimal digit"
            if wrong is not None
            else f"{len(text)} characters, which is no whole number of bytes"
        )
        return _Frame(Framing.ASCII, b"", (start, Part(first, text, "content", problem=problem)))
    content = bytes.fromhex(text.decode("ascii"))
    if len(content) < 3:
        problem = f"{counted(len(content), 'byte')} where unit, function and LRC are 3"
        return _Frame(Framing.ASCII, b"", (start, Part(first, content, "content", problem=problem)))
    wanted = lrc(content[:-1])
    problem = "" if wanted == content[-1] else f"is {content[-1]:02X} where {wanted:02X} fits"
    limit = f"the frame has {len(data)} characters, and ASCII at most {ASCII_ADU_LIMIT}"
    tail = [Part(first + len(text) - 2, content[-1:], "LRC", "" if problem else "fits", problem)]
    if ending:
        tail.append(Part(first + len(text), ending, "end", "CR LF" if ending == b"\r\n" else repr(ending)))
    return _Frame(
        Framing.ASCII,
        content[1:-1],
        (start, Part(first, content[:1], "unit", str(content[0]), limit if len(data) > ASCII_ADU_LIMIT else "")),
        tuple(tail),
        content[0],
        pdu_at=first + 2,
        characters=2,
    )


def _cut_pdu(data: bytes) -> _Frame:
    if len(data) > PDU_LIMIT:
        head = Part(0, b"", "PDU", problem=f"has {len(data)} bytes, and a PDU at most {PDU_LIMIT}")
        return _Frame(Framing.PDU, data, (head,))
    return _Frame(Framing.PDU, data)


_CUTTERS: Final[dict[Framing, Callable[[bytes], _Frame]]] = {
    Framing.MBAP: _cut_mbap,
    Framing.RTU: _cut_rtu,
    Framing.ASCII: _cut_ascii,
    Framing.PDU: _cut_pdu,
}
