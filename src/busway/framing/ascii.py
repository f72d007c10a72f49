"""ASCII framing: between a colon and the end delimiter, two characters for each byte (Serial Line V1.02 §2.5.2).

Knows characters and the times at which they were read; knows no port and no function's length.

1. ``:`` begins a frame wherever it is received, also after CR. An unfinished frame before the colon is discarded. It is
   reported when the next frame ends, together with other unfinished frames before that one, as one disturbance. CR and
   the delimiter, one character each, end a frame; the delimiter is LF until function 08/03 changes it.
2. A pause above ``character_timeout``, 1 s by default, between two characters of a frame damages the frame.
3. A frame has at most 513 characters. Characters between frames are skipped; they are no error.
4. Frames are sent in upper case. Lower case is received too, unless ``upper_case_only`` is set: devices send it, and
   the LRC protects the content. With ``strip_parity`` the eighth bit is ignored: ports without 7 data bits deliver it.
"""

from collections.abc import Container
from enum import Enum
from typing import Final

from ..codes import ASCII_ADU_LIMIT
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.message import UNKNOWN_LENGTH
from .character_times import SerialTiming
from .echo import Echo, EchoFilter
from .frame_direction import REPLY_WINDOW, Conversation, Due, LineRole
from .lengths import AROUND_PDU, lengths_of
from .lrc import lrc
from .received import Damage, Damaged, Direction, FrameOrDamage, SerialFrame

COLON: Final = 0x3A
CR: Final = 0x0D
LF: Final = 0x0A
DEFAULT_CHARACTER_TIMEOUT: Final = 1.0
SHORTEST_CONTENT: Final = 3
"""Fewest bytes of a frame's content: unit, function code, LRC."""
_MOST_DIGITS: Final = ASCII_ADU_LIMIT - 3
_UPPER_CASE: Final = b"0123456789ABCDEF"
_ANY_CASE: Final = _UPPER_CASE + b"abcdef"
_SEVEN_BITS: Final = bytes(value & 0x7F for value in range(256))
_NEVER: Final = float("-inf")


def encode_ascii(unit: int, pdu: bytes, delimiter: int = LF) -> bytes:
    """Return the ASCII frame of a PDU: colon, hexadecimal digits with LRC, CR, delimiter (Serial Line V1.02 §2.5.2.1).

    Args:
        unit: unit identifier, 0…255.
        pdu: function code and data, 1…253 bytes.
        delimiter: code of the character that ends the frame after CR, 0…127; LF by default.
    """
    body = bytes((unit,)) + pdu
    return b":%b%02X\r%c" % (body.hex().upper().encode(), lrc(body), delimiter)


class AsciiState(Enum):
    """States of the ASCII receiver: which part of a frame it waits for (Serial Line V1.02, figure 18)."""

    IDLE = "idle"
    RECEIVING = "reception"
    WAITING_FOR_DELIMITER = "waiting for the end delimiter"


class AsciiReceiver:
    """Receiver of ASCII frames: takes characters with their times, returns frames and damaged bytes.

    All times are seconds of the caller's clock.

    Attributes:
        state: which part of a frame is expected next.
        delimiter: code of the character that ends a frame after CR; can be set at any time (function 08/03).
        conversation: role, own units and the expected reply; used to tell requests from replies.
        echo: the filter that removes the echo of what this station sends.
        timing: the times of the line; only its character time is used, to estimate when frames began and ended.
        character_timeout: longest allowed pause between two characters of a frame, in seconds.
    """

    __slots__ = (
        "_allowed",
        "_began",
        "_interrupted",
        "_interrupted_began",
        "_interrupted_size",
        "_last",
        "_lengths",
        "_sent_until",
        "_strip_parity",
        "_text",
        "character_timeout",
        "conversation",
        "delimiter",
        "echo",
        "state",
        "timing",
    )

    def __init__(
        self,
        role: LineRole,
        timing: SerialTiming,
        *,
        functions: FunctionTable = STANDARD,
        units: Container[int] = (),
        delimiter: int = LF,
        character_timeout: float = DEFAULT_CHARACTER_TIMEOUT,
        upper_case_only: bool = False,
        strip_parity: bool = False,
        reply_window: float = REPLY_WINDOW,
        echo: Echo = Echo.OFF,
    ) -> None:
        """Create a receiver that has received nothing yet.

        Args:
            role: master, server or observer.
            timing: the times of the line; only the character time counts.
            functions: the functions whose lengths are known.
            units: the own units of a server; a container whose content changes is allowed.
            delimiter: code of the character that ends a frame after CR, 0…127.
            character_timeout: longest allowed pause between two characters of a frame, in seconds, above 0.
            upper_case_only: whether a frame with lower-case digits is damaged.
            strip_parity: whether the eighth bit of each character is ignored.
            reply_window: seconds for which a server or observer expects the reply to a request to another unit.
            echo: whether this station receives what it sends.

        Raises:
            ValueError: a delimiter outside 0…127 or a timeout that is not above 0.
        """
        if not 0 <= delimiter <= 0x7F:
            raise ValueError(f"the end delimiter is an ASCII character, 0…127, not {delimiter}")
        if character_timeout <= 0:
            raise ValueError(f"the time between characters is above 0 s, not {character_timeout}")
        self.conversation: Conversation = Conversation(role, units, reply_window)
        self.echo: EchoFilter = EchoFilter(echo)
        self.timing: SerialTiming = timing
        self.delimiter: int = delimiter
        self.character_timeout: float = character_timeout
        self.state: AsciiState = AsciiState.IDLE
        self._lengths = lengths_of(functions)
        self._allowed = _UPPER_CASE if upper_case_only else _ANY_CASE
        self._strip_parity = strip_parity
        self._text = bytearray()
        self._interrupted = bytearray()  # frames that colons cut off, until it is known how the last one ends
        self._interrupted_size = 0
        self._interrupted_began = _NEVER
        self._began = self._last = self._sent_until = _NEVER

    # What the driver calls.

    def receive(self, data: bytes | bytearray, now: float) -> list[FrameOrDamage]:
        """Return the frames and damaged bytes that ``data``, read at ``now`` (seconds), completes, in order."""
        if not data:
            return []
        began = max(self._last, now - len(data) * self.timing.character)
        found = self.tick(began)
        self._accept(self.echo.receive(bytes(data), began), began, found)
        self._last = now
        return found

    def tick(self, now: float) -> list[FrameOrDamage]:
        """Return the frames and damaged bytes that the silence until ``now`` (seconds) completes, in order.

        An unfinished frame is returned as damaged if more than ``character_timeout`` has passed since its last
        character. Bytes that were held back as a possible echo are taken as received if the rest of the echo did not
        come in time; they can complete frames, which are returned too.
        """
        found: list[FrameOrDamage] = []
        released = self.echo.tick(now)
        if released:
            self._accept(released, self._last, found)
        if self.state is not AsciiState.IDLE and now > self._last + self.character_timeout:
            self._discard(Damage.GAP, self._last, found)
        return found

    def deadline(self) -> float | None:
        """Return the time, in seconds, at which to call `tick`: when an unfinished frame or a possible echo expires.

        None if there is neither.
        """
        echo = self.echo.deadline()
        if self.state is AsciiState.IDLE:
            return echo
        # The limit itself is still allowed, so the decision falls just behind it.
        own = self._last + self.character_timeout * (1 + 1e-6) + 1e-6
        return own if echo is None else min(own, echo)

    def expect(self, unit: int, function: int, size: int = UNKNOWN_LENGTH) -> None:
        """Announce the request of this master that is sent next, so that the reply to it is recognised.

        Args:
            unit: unit of the request, 0…255.
            function: its function code, 1…127.
            size: length of the reply's PDU in bytes; `UNKNOWN_LENGTH` if the request does not tell it.
        """
        self.conversation.due = Due(unit, function, size)

    def expect_nothing(self) -> None:
        """Stop expecting a reply, because the master no longer waits for one."""
        self.conversation.due = None

    def sent(self, raw: bytes, ends: float) -> None:
        """Tell the receiver that this station sends the frame ``raw`` until ``ends`` (seconds); its echo is removed."""
        self._sent_until = ends
        if self.conversation.role is LineRole.SERVER:
            others_from = ends - self.timing.character / 2  # half a character: times are estimates
            self.echo.replied(raw, ends, others_from, may_be_request=self._may_be_request(raw))
        else:
            is_master = self.conversation.role is LineRole.MASTER
            self.echo.sent(raw, ends, may_be_reply=is_master, replies_from=ends - self.timing.character / 2)

    def damaged(self, now: float, *, overrun: bool = False) -> list[FrameOrDamage]:
        """Discard the unfinished frame, because the port reports a parity or framing error or lost characters.

        Returns what `tick` returns for ``now``, then one `Damaged`: the discarded frame, or no bytes if no frame was
        unfinished.

        Args:
            now: time of the report, in seconds.
            overrun: True for lost characters, False for a parity or framing error.
        """
        found = self.tick(now)
        self._discard(Damage.OVERRUN if overrun else Damage.CHARACTER, now, found, overrun=overrun)
        self._last = max(self._last, now)
        return found

    def flush(self, now: float) -> list[FrameOrDamage]:
        """Return the unfinished frame as damaged, without waiting for its rest: at a response timeout, or when closing.

        Frames in bytes that were held back as a possible echo are returned before it.
        """
        found: list[FrameOrDamage] = []
        released = self.echo.release()
        if released:
            self._accept(released, self._last, found)
        if self.state is not AsciiState.IDLE:
            self._discard(Damage.INCOMPLETE, now, found)
        return found

    def clear_at(self) -> float:
        """Return the earliest time, in seconds, at which a frame may be sent: after the last character on the line.

        That is the later of the last read and the end of the last sent frame; ASCII needs no silence between frames.
        """
        return max(self._last, self._sent_until)

    # From characters to frames.

    def _accept(self, data: bytes, began: float, found: list[FrameOrDamage]) -> None:
        if self._strip_parity:
            data = data.translate(_SEVEN_BITS)
        at, character = 0, self.timing.character
        for part in data.split(b":"):
            if at:
                self._colon(began + (at - 1) * character, found)
            if part and self.state is not AsciiState.IDLE:
                self._content(part, began + at * character, found)
            at += len(part) + 1

    def _colon(self, time: float, found: list[FrameOrDamage]) -> None:
        """Begin a frame at a colon received at ``time`` (seconds); an unfinished frame before it is reported later.

        If the delimiter is a colon and is expected now, the colon ends the current frame instead.
        """
        if self.state is AsciiState.WAITING_FOR_DELIMITER and self.delimiter == COLON:
            self._complete(time + self.timing.character, found)
            return
        if self._text or self.state is AsciiState.WAITING_FOR_DELIMITER:
            if not self._interrupted_size:
                self._interrupted_began = self._began
            self._interrupted_size += 1 + len(self._text)
            if len(self._interrupted) < ASCII_ADU_LIMIT:
                self._interrupted += b":"
                self._interrupted += self._text
            self._text.clear()
        self.state = AsciiState.RECEIVING
        self._began = time

    def _content(self, part: bytes, began: float, found: list[FrameOrDamage]) -> None:
        """Process characters of a frame, none of which is a colon; the first of them began at ``began`` (seconds)."""
        if self.state is AsciiState.RECEIVING:
            end = part.find(CR)
            self._text += part[: ASCII_ADU_LIMIT if end < 0 else min(end, ASCII_ADU_LIMIT)]
            if len(self._text) > _MOST_DIGITS:
                self._discard(Damage.TOO_LONG, began + len(part) * self.timing.character, found)
                return
            if end < 0:
                return
            self.state = AsciiState.WAITING_FOR_DELIMITER
            if end + 1 == len(part):
                return
            part, began = part[end + 1 :], began + (end + 1) * self.timing.character
        if part[0] == self.delimiter:
            self._complete(began + self.timing.character, found)
        else:
            self._discard(Damage.NO_DELIMITER, began, found)

    def _complete(self, ended: float, found: list[FrameOrDamage]) -> None:
        text = bytes(self._text)
        if text.translate(None, self._allowed):
            self._discard(Damage.NOT_HEXADECIMAL, ended, found)
        elif len(text) < 2 * SHORTEST_CONTENT:
            self._discard(Damage.TOO_SHORT, ended, found)
        elif len(text) % 2:
            self._discard(Damage.INCOMPLETE, ended, found)
        else:
            content = bytes.fromhex(text.decode("ascii"))
            if lrc(content):
                self._discard(Damage.CHECKSUM, ended, found)
                return
            unit, pdu = content[0], content[1:-1]
            direction = self._direction(content, self._began)
            raw = b":%b\r%c" % (text, self.delimiter)
            self._report_interrupted(self._began, found)
            found.append(SerialFrame(unit, pdu, raw, direction, self._began, ended))
            self.conversation.follow(unit, pdu[0], direction, ended)
            self.state = AsciiState.IDLE
            self._text.clear()

    def _direction(self, content: bytes, now: float) -> Direction:
        """Return the likelier direction of a frame, by its length and the frames before it; UNKNOWN if undecided.

        ``content`` has unit, PDU and LRC; ``now`` is the time of the frame, in seconds.
        """
        frame = bytearray(content) + b"\0"
        length_of_frame = len(content) - 2 + AROUND_PDU
        for direction in self.conversation.order(content[0], content[1], now):
            if self._lengths.length(direction, frame, 0, len(frame)) == length_of_frame:
                return direction
        return self.conversation.guess(content[0], content[1], now)

    def _may_be_request(self, raw: bytes) -> bool:
        """Return whether the characters of a whole frame can be a request; True for what is no frame."""
        try:
            content = bytearray.fromhex(raw[1:-2].decode("ascii"))
        except ValueError:
            return True
        return self._lengths.may_be_request(content + b"\0")  # RTU has one byte more: two of CRC instead of one of LRC

    def _discard(self, reason: Damage, ended: float, found: list[FrameOrDamage], *, overrun: bool = False) -> None:
        """Add the unfinished frame to ``found`` as damaged, with those before it that colons cut off.

        Characters are skipped then until the next colon.
        """
        in_frame = self.state is not AsciiState.IDLE
        raw = b":" + bytes(self._text) if in_frame else b""
        began = self._began if in_frame else ended
        size = len(raw)
        if self._interrupted_size:
            raw, began, size = bytes(self._interrupted) + raw, self._interrupted_began, self._interrupted_size + size
            self._forget_interrupted()
        found.append(Damaged(raw[:ASCII_ADU_LIMIT], reason, size, began, ended, overrun))
        self.state = AsciiState.IDLE
        self._text.clear()

    def _report_interrupted(self, ended: float, found: list[FrameOrDamage]) -> None:
        """Add the unfinished frames that colons cut off to ``found``, as one `Damaged`; no effect if there are none.

        Called before the next frame is added. ``ended`` is the time at which that frame began.
        """
        if self._interrupted_size:
            raw = bytes(self._interrupted[:ASCII_ADU_LIMIT])
            found.append(Damaged(raw, Damage.RESTARTED, self._interrupted_size, self._interrupted_began, ended))
            self._forget_interrupted()

    def _forget_interrupted(self) -> None:
        self._interrupted.clear()
        self._interrupted_size = 0
