"""Strict RTU receiver, of the option ``strict_timing``: a gap above t1.5 spoils a frame (Serial Line V1.02 §2.5.1.1).

Knows bytes and the times at which they were received; uses length rules only to guess the direction of a frame.

1. It follows the state diagram of the specification to the letter: initial –t3.5→ idle –character→ reception –t1.5→
   control and waiting –t3.5→ idle; there the frame is processed, or deleted whole. A character in "control and waiting"
   marks the frame as not OK.
2. A frame ends by silence and is good if its CRC fits; nothing is merged, nothing is looked for inside it.
3. This receiver is of use only where the times of single characters are known: the driver reads each at once and
   passes its time. Adapters that deliver in bursts need `RtuReceiver`.
"""

from collections.abc import Container
from enum import Enum
from typing import Final

from ..codes import RTU_ADU_LIMIT
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.message import UNKNOWN_LENGTH
from .character_times import SerialTiming
from .crc import crc16
from .echo import Echo, EchoFilter
from .frame_direction import REPLY_WINDOW, Conversation, Due, LineRole
from .lengths import SHORTEST, lengths_of
from .lost import LostBytes
from .received import Damage, Direction, FrameOrDamage, SerialFrame


class LineState(Enum):
    """States of the serial line in figure 14 of Serial Line V1.02."""

    INITIAL = "initial"
    IDLE = "idle"
    RECEIVING = "reception"
    CONTROL_AND_WAITING = "control and waiting"
    EMISSION = "emission"


class LineEvent(Enum):
    """Events that change the state of the line: a character, t1.5 or t3.5 of silence, a frame to send."""

    CHARACTER = "character"
    T1_5 = "t1.5 expired"
    T3_5 = "t3.5 expired"
    CALL = "demand of emission"


_NEXT: Final = {
    (LineState.INITIAL, LineEvent.CHARACTER): LineState.INITIAL,
    (LineState.INITIAL, LineEvent.T3_5): LineState.IDLE,
    (LineState.IDLE, LineEvent.CHARACTER): LineState.RECEIVING,
    (LineState.IDLE, LineEvent.CALL): LineState.EMISSION,
    (LineState.RECEIVING, LineEvent.CHARACTER): LineState.RECEIVING,
    (LineState.RECEIVING, LineEvent.T1_5): LineState.CONTROL_AND_WAITING,
    (LineState.CONTROL_AND_WAITING, LineEvent.CHARACTER): LineState.CONTROL_AND_WAITING,
    (LineState.CONTROL_AND_WAITING, LineEvent.T3_5): LineState.IDLE,
    (LineState.EMISSION, LineEvent.CHARACTER): LineState.EMISSION,
    (LineState.EMISSION, LineEvent.T3_5): LineState.IDLE,
}


class StrictRtuReceiver:
    """Receiver of RTU frames by the state diagram: takes bytes with their times, returns frames and damaged bytes.

    All times are seconds of the caller's clock.

    Attributes:
        state: the state of the line.
        conversation: role, own units and the expected reply; used to tell requests from replies.
        echo: the filter that removes the echo of what this station sends.
        timing: character time, t1.5 and t3.5.
    """

    __slots__ = ("_began", "_frame", "_last", "_lengths", "_lost", "conversation", "echo", "state", "timing")

    def __init__(
        self,
        role: LineRole,
        timing: SerialTiming,
        *,
        functions: FunctionTable = STANDARD,
        units: Container[int] = (),
        reply_window: float = REPLY_WINDOW,
        echo: Echo = Echo.OFF,
        started: float | None = None,
    ) -> None:
        """Create a receiver that has received nothing yet.

        Args:
            role: master, server or observer.
            timing: character time, t1.5 and t3.5.
            functions: the functions whose lengths are known.
            units: the own units of a server; a container whose content changes is allowed.
            reply_window: seconds for which a server or observer expects the reply to a request to another unit.
            echo: whether this station receives what it sends.
            started: when the port was opened, in seconds: the state is "initial" until t3.5 of silence has passed.
                None: the line is idle.
        """
        self.conversation: Conversation = Conversation(role, units, reply_window)
        self.echo: EchoFilter = EchoFilter(echo)
        self.timing: SerialTiming = timing
        self.state = LineState.IDLE if started is None else LineState.INITIAL
        self._lengths = lengths_of(functions)
        self._frame = bytearray()
        self._lost = LostBytes()
        self._began = self._last = float("-inf") if started is None else started

    def receive(self, data: bytes | bytearray, now: float) -> list[FrameOrDamage]:
        """Take bytes read at ``now`` (seconds); return the frame, or damaged bytes, that the silence before them ends.

        The result is empty if no t3.5 has passed before ``data``. The bytes count as characters without gaps; their own
        frame is returned by a later call, after the silence that follows them. Bytes that are received in the state
        initial are dropped.
        """
        if not data:
            return []
        computed = now - len(data) * self.timing.character
        began = max(self._last, computed)
        found = self.tick(began)
        data = self.echo.receive(bytes(data), began)
        sends = self.state is LineState.EMISSION
        if data:
            self._characters(data, began, now)
            if sends:
                self._began = computed  # an echo begins before what it is the echo of has ended
        self._last = now
        return found

    def tick(self, now: float) -> list[FrameOrDamage]:
        """Return the frame, or damaged bytes, completed by the silence until ``now`` (seconds); empty before t3.5."""
        released = self.echo.tick(now)
        if released:
            self._characters(released, self._last, self._last)
        is_over = now >= self._last + self.timing.t3_5
        # At t1.5 itself the frame is still whole: only a longer gap makes it incomplete. Over networks t1.5 is t3.5.
        if self.state is LineState.RECEIVING and (is_over or now > self._last + self.timing.t1_5):
            self._move(LineEvent.T1_5)
        if not is_over:
            return []
        received = self.state is LineState.CONTROL_AND_WAITING
        if self.state in (LineState.INITIAL, LineState.CONTROL_AND_WAITING, LineState.EMISSION):
            self._move(LineEvent.T3_5)
        return self._processed_or_deleted() if received else []

    def deadline(self) -> float | None:
        """Return the time, in seconds, at which to call `tick`: at the end of t3.5, or when a possible echo expires.

        None while the line is idle and no bytes are held as a possible echo.
        """
        echo = self.echo.deadline()
        if self.state is LineState.IDLE:
            return echo
        own = self._last + self.timing.t3_5
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
        """Tell the receiver that this station sends the bytes ``raw`` until the time ``ends``.

        ``ends`` is in seconds. The state is idle t3.5 later; an echo of the bytes is removed.

        Raises:
            ValueError: the station may not send now: the state of the line is neither idle nor emission.
        """
        if self.state not in (LineState.IDLE, LineState.EMISSION):
            raise ValueError(f"emission begins only from the state idle, and the line is in {self.state.value}")
        if self.state is LineState.IDLE:
            self._move(LineEvent.CALL)
        self._last = ends
        if self.conversation.role is LineRole.SERVER:
            others_from = ends + self.timing.t3_5 - self.timing.character / 2  # half a character: times are estimates
            self.echo.replied(raw, ends, others_from, may_be_request=self._lengths.may_be_request(bytearray(raw)))
        else:
            is_master = self.conversation.role is LineRole.MASTER
            replies_from = ends + self.timing.character / 2  # `receive` lets bytes begin at ``ends`` at the earliest
            self.echo.sent(raw, ends, may_be_reply=is_master, replies_from=replies_from)

    def damaged(self, now: float, *, overrun: bool = False) -> list[FrameOrDamage]:
        """Mark the frame in progress as damaged, because the port reported an error or lost characters.

        Returns the frame that the silence before the error completes. The marked frame is returned after t3.5 of
        silence. An error where characters are dropped (`receive`) marks nothing.

        Args:
            now: time of the report, in seconds.
            overrun: True for lost characters, False for a parity or framing error.
        """
        found = self.tick(now)
        self._characters(b"", now, now)
        if self.state in (LineState.RECEIVING, LineState.CONTROL_AND_WAITING):
            self._lost.mark(Damage.OVERRUN if overrun else Damage.CHARACTER, now)
        self._last = max(self._last, now)
        return found

    def flush(self, now: float) -> list[FrameOrDamage]:
        """Return the unfinished frame, or damaged bytes, as if t3.5 of silence had passed; empty if there are none."""
        released = self.echo.release()
        if released:
            self._characters(released, self._last, self._last)
        return self.tick(max(now, self._last + self.timing.t3_5))

    def clear_at(self) -> float:
        """Return the earliest time, in seconds, at which a frame may be sent: t3.5 after the last byte on the line."""
        return self._last + self.timing.t3_5

    def _move(self, event: LineEvent) -> None:
        self.state = _NEXT[self.state, event]

    def _characters(self, data: bytes, began: float, ended: float) -> None:
        if self.state is LineState.EMISSION and began >= self._last:
            self._move(LineEvent.T3_5)  # a peer that answers before t3.5 has passed is heard nevertheless
        if self.state is LineState.IDLE:
            self._began = began
        if self.state is LineState.CONTROL_AND_WAITING:
            self._lost.mark(Damage.GAP, ended)
        self._move(LineEvent.CHARACTER)
        if self.state in (LineState.RECEIVING, LineState.CONTROL_AND_WAITING):
            self._frame += data
            if len(self._frame) > RTU_ADU_LIMIT:
                self._lost.add(self._frame, self._began, ended)
                self._lost.mark(Damage.TOO_LONG, ended)
                self._frame.clear()

    def _processed_or_deleted(self) -> list[FrameOrDamage]:
        raw, lost = bytes(self._frame), self._lost
        self._frame.clear()
        self._lost = LostBytes()
        if not lost.is_marked and len(raw) >= SHORTEST and crc16(raw) == 0:
            unit, code = raw[0], raw[1]
            direction = self._direction(raw)
            self.conversation.follow(unit, code, direction, self._last)
            return [SerialFrame(unit, raw[1:-2], raw, direction, self._began, self._last)]
        lost.add(raw, self._began, self._last)
        return [lost.report()]

    def _direction(self, raw: bytes) -> Direction:
        for direction in self.conversation.order(raw[0], raw[1], self._began):
            if self._lengths.length(direction, bytearray(raw), 0, len(raw)) == len(raw):
                return direction
        return self.conversation.guess(raw[0], raw[1], self._began)
