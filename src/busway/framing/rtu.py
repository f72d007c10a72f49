"""RTU receiver that tolerates gaps inside frames: finds their ends by length and CRC (Serial Line V1.02 §2.5.1).

Knows bytes and the times at which they were read; knows no port, no request table and no device.

1. Length and CRC together complete a frame of a known function at once, without waiting for a silence to confirm it.
2. Silence alone makes no frame. If the function is unknown, or the byte count contradicts the frame, all bytes between
   two silences of t3.5, a *chunk*, are the frame if its CRC is right. Several frames without a visible silence between
   them are told apart if they fill the chunk exactly.
3. Bytes of one frame may be read in bursts: adapters and operating systems add gaps far above t1.5. An unfinished frame
   waits for the rest up to ``gap_limit``. If a master has received the beginning of the reply that it expects (unit,
   function and size fit), it waits for the rest until the response timeout: nothing else may be sent before that
   anyway, a pause of an adapter or network then needs no repetition, and the CRC still decides. If a ``gap_limit`` was
   given, it limits this wait too. `StrictRtuReceiver` (``rtu_strict``) allows no such gaps.
4. Bytes that may still become a frame have precedence over a frame found inside them. The inner frame is accepted after
   t3.5 of silence if the outer bytes cannot be a frame, otherwise after ``gap_limit``. The wait for t3.5 costs no
   time: before, no station may send.
5. A master and an observer look for the next frame inside a damaged chunk; a master only for the expected reply. A
   server never does: after damage it ignores all bytes up to a silence of t3.5, and then accepts a frame only between
   two such silences, until one was good.
6. Each byte is examined a bounded number of times: running CRC states, one comparison per candidate, at most 256 bytes
   of an undecided chunk, rejected positions are not tried again, and at most one pass per silence.

A silence before a burst is measured up to the begin of the burst's first byte, which is computed as if its bytes had
been received without gaps. A late read makes the silence look longer than it was, never shorter than zero.
"""

from collections.abc import Container
from typing import Final

from ..codes import RTU_ADU_LIMIT
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.message import NEED_MORE, UNKNOWN_LENGTH
from .byte_times import NEVER, ByteTimes
from .character_times import SerialTiming
from .crc import crc_bytes, running_states, span_check
from .echo import Echo, EchoFilter
from .frame_direction import REPLY_WINDOW, Conversation, Due, LineRole
from .lengths import AROUND_PDU, SHORTEST, lengths_of
from .lost import LostBytes
from .received import Damage, Direction, FrameOrDamage, SerialFrame
from .rtu_search import DEAD, WAITS, find_any, find_reply

DEFAULT_GAP_LIMIT: Final = 0.050
"""Seconds that an unfinished frame waits for its rest: USB adapters deliver every 16 ms, slow systems later."""

_PIECE: Final = RTU_ADU_LIMIT
_SILENCES_KEPT: Final = 4
"""How many silences inside an undecided chunk a server remembers: a frame may have begun after each."""


def encode_rtu(unit: int, pdu: bytes) -> bytes:
    """Return the RTU frame of a PDU: unit, PDU, CRC (Serial Line V1.02 §2.5.1).

    Args:
        unit: unit identifier, 0…255.
        pdu: function code and data, 1…253 bytes.
    """
    body = bytes((unit,)) + pdu
    return body + crc_bytes(body)


class RtuReceiver:
    """Receiver of RTU frames: takes bytes with their times, returns frames and damaged bytes.

    Gaps inside a frame are allowed (rule 3 of this file). All times are seconds of the caller's clock. Received bytes
    that are not yet known to be a frame or damaged are called *undecided*.

    Attributes:
        conversation: role, own units and the expected reply; used to tell requests from replies.
        echo: the filter that removes the echo of what this station sends.
        timing: character time, t1.5 and t3.5.
        gap_limit: seconds that an unfinished frame waits for its rest, at least t3.5.
    """

    __slots__ = (
        "_at",
        "_buffer",
        "_in_step",
        "_last",
        "_lengths",
        "_lost",
        "_patient",
        "_prefix_end",
        "_quiet",
        "_scan",
        "_sent_until",
        "_silences",
        "_skipping",
        "_states",
        "_times",
        "conversation",
        "echo",
        "gap_limit",
        "timing",
    )

    def __init__(
        self,
        role: LineRole,
        timing: SerialTiming,
        *,
        functions: FunctionTable = STANDARD,
        units: Container[int] = (),
        gap_limit: float | None = None,
        reply_window: float = REPLY_WINDOW,
        echo: Echo = Echo.OFF,
        started: float | None = None,
    ) -> None:
        """Create a receiver of RTU frames that has received nothing yet.

        Args:
            role: master, server or observer.
            timing: the times of the line, as `SerialTiming.of_line` or `SerialTiming.of_network` gives them.
            functions: the functions whose lengths are known.
            units: the own units of a server; a container whose content changes is allowed.
            gap_limit: seconds that an unfinished frame waits for its rest. None: 50 ms or t3.5, whichever is longer,
                and for the reply that a master expects, until `flush`.
            reply_window: seconds for which a server or observer expects the reply to a request to another unit.
            echo: whether this station receives what it sends.
            started: when the port was opened, in seconds, so that nothing is sent before t3.5 has passed (state
                "initial" of §2.5.1.1); None where the line is known to be idle.

        Raises:
            ValueError: a ``gap_limit`` below t3.5.
        """
        limit = max(timing.t3_5, DEFAULT_GAP_LIMIT) if gap_limit is None else gap_limit
        if limit < timing.t3_5:
            raise ValueError(f"the gap limit must be t3.5 ({timing.t3_5} s) or more, not {limit} s")
        self.conversation: Conversation = Conversation(role, units, reply_window)
        self.echo: EchoFilter = EchoFilter(echo)
        self.timing: SerialTiming = timing
        self.gap_limit: float = limit
        self._lengths = lengths_of(functions)
        self._patient = gap_limit is None and role is LineRole.MASTER
        self._buffer = bytearray()
        self._states = [0]  # the running CRC ahead of each byte of the buffer, and behind the last one
        self._at = 0  # where the undecided chunk begins
        self._scan = 1  # places of the chunk before this one are rejected as beginnings of a frame inside it
        self._prefix_end = SHORTEST  # lengths of the chunk below this one are no frame of an unknown function
        self._silences: list[int] = []
        self._times = ByteTimes()
        self._last = NEVER if started is None else started
        self._sent_until = NEVER
        self._quiet = True  # whether the t3.5 after the last byte has been dealt with
        self._in_step = started is None  # a server opened amid traffic believes what is between two silences
        self._skipping = False
        self._lost = LostBytes()

    # What the driver calls.

    def receive(self, data: bytes | bytearray, now: float) -> list[FrameOrDamage]:
        """Return the frames and damaged bytes that ``data``, read at ``now`` (seconds), completes, in order."""
        found: list[FrameOrDamage] = []
        if not data:
            return found
        began = max(self._last, now - len(data) * self.timing.character)
        self._pass_time(began, found)
        if self.echo.mode is not Echo.OFF:
            data = self.echo.receive(bytes(data), began)
        self._accept(data, began, now, found)
        return found

    def tick(self, now: float) -> list[FrameOrDamage]:
        """Return the frames and damaged bytes that the silence until ``now`` (seconds) completes, in order."""
        found: list[FrameOrDamage] = []
        released = self.echo.tick(now)
        if released:
            self._accept(released, self._last, self._last, found)
        self._pass_time(now, found)
        return found

    def deadline(self) -> float | None:
        """Return the time, in seconds, at which to call `tick`; None if silence completes nothing.

        That is so if no bytes are undecided or held as a possible echo, and while a master waits for the rest of the
        reply that it expects.
        """
        echo = self.echo.deadline()
        if not self._undecided:
            return echo
        if self._quiet and self._due_has_begun():
            return echo
        own = self._last + (self.gap_limit if self._quiet else self.timing.t3_5)
        return own if echo is None else min(own, echo)

    def expect(self, unit: int, function: int, size: int = UNKNOWN_LENGTH) -> None:
        """Announce the request of this master that is sent next, so that the reply to it is recognised.

        Args:
            unit: unit of the request, 0…255.
            function: its function code, 1…127.
            size: length of the reply's PDU in bytes (`Request.reply_shape`), which ends a reply whose own bytes do not
                tell its length; `UNKNOWN_LENGTH` if the request does not tell it either.
        """
        self.conversation.due = Due(unit, function, size)
        self._scan = self._at + 1  # what was rejected was rejected for another reply

    def expect_nothing(self) -> None:
        """Stop expecting a reply, because the master no longer waits for one."""
        self.conversation.due = None

    def sent(self, raw: bytes, ends: float) -> None:
        """Tell the receiver that this station sends the bytes ``raw`` until the time ``ends``; their echo is removed.

        ``ends`` is in seconds. The t3.5 that must pass before the next frame is sent counts from it.
        """
        self._sent_until = ends
        if self.conversation.role is LineRole.SERVER:
            others_from = ends + self.timing.t3_5 - self.timing.character / 2  # half a character: times are estimates
            self.echo.replied(raw, ends, others_from, may_be_request=self._lengths.may_be_request(bytearray(raw)))
            return
        code = raw[1] if len(raw) > 1 else 0
        may_be_reply = self.conversation.role is LineRole.MASTER and self._answers_itself(code)
        self.echo.sent(raw, ends, may_be_reply=may_be_reply, replies_from=ends - self.timing.character / 2)

    def damaged(self, now: float, *, overrun: bool = False) -> list[FrameOrDamage]:
        """Tell the receiver that the port reported an error or lost characters after the bytes received so far.

        The frame in progress is discarded; it is reported with the rest of the disturbance. Returns the frames that the
        silence before the error completed.

        Args:
            now: time of the report, in seconds.
            overrun: True for lost characters, False for a parity or framing error.
        """
        found: list[FrameOrDamage] = []
        self._pass_time(now, found)
        self._lose(len(self._buffer))
        self._lost.mark(Damage.OVERRUN if overrun else Damage.CHARACTER, now)
        self._fall_out_of_step()
        self._last = max(self._last, now)
        self._quiet = False
        return found

    def flush(self, now: float) -> list[FrameOrDamage]:
        """Return the frames and damaged bytes among all unfinished bytes, as if ``gap_limit`` had passed.

        Called at a response timeout, or when closing.
        """
        found: list[FrameOrDamage] = []
        released = self.echo.release()
        if released:
            self._accept(released, self._last, self._last, found)
        if self._undecided:
            self._after_silence(found)
            self._after_limit(found)
            self._quiet = True
        return found

    def skip_requests(self, now: float) -> bool:
        """Record that the caller answers requests to own units itself, without passing their bytes to `receive`.

        ``now`` is when they were read, in seconds. Returns True if that is recorded. Returns False, and records
        nothing, if the bytes must go through `receive`: earlier bytes are undecided, the receiver waits for a silence
        after damage, or an echo could have to be removed.
        """
        if self._undecided or not self._in_step or self.echo.mode is not Echo.OFF:
            return False
        self.conversation.due = None
        self._last = max(self._last, now)
        self._quiet = False
        return True

    def clear_at(self) -> float:
        """Return the earliest time, in seconds, at which a frame may be sent: t3.5 after the last byte on the line."""
        return max(self._last, self._sent_until) + self.timing.t3_5

    # Time and bytes.

    @property
    def _undecided(self) -> bool:
        return self._at < len(self._buffer) or self._skipping or self._lost.size > 0 or self._lost.is_marked

    def _pass_time(self, until: float, found: list[FrameOrDamage]) -> None:
        """Add to ``found`` the frames and damaged bytes that are complete because of silences up to ``until``."""
        if self._undecided:
            if not self._quiet and until >= self._last + self.timing.t3_5:
                self._quiet = True
                self._after_silence(found)
            if self._undecided and until >= self._last + self.gap_limit and not self._due_has_begun():
                self._after_limit(found)
        if until >= self._last + self.gap_limit and not self._undecided:
            self._in_step = True

    def _due_has_begun(self) -> bool:
        """Return True if the undecided bytes are the beginning, but not all, of the reply that a master expects.

        Always False if the receiver was created with a ``gap_limit``, which limits this wait too (rule 3).
        """
        due = self.conversation.due
        at, size = self._at, len(self._buffer)
        if not self._patient or due is None or at == size or self._buffer[at] != due.unit:
            return False
        if size - at == 1:
            return True
        code = self._buffer[at + 1]
        if code & 0x7F != due.function:
            return False
        length = self._length(Direction.REPLY, at, size)
        return length == NEED_MORE or (at + length > size and (code >= 0x80 or length == due.size + AROUND_PDU))

    def _accept(self, data: bytes | bytearray, began: float, now: float, found: list[FrameOrDamage]) -> None:
        if data and self._at < len(self._buffer) and self._quiet:
            self._silences = [*self._silences[1 - _SILENCES_KEPT :], len(self._buffer)]
        each = (now - began) / len(data) if data else 0.0
        for start in range(0, len(data), _PIECE):
            self._append(data[start : start + _PIECE], began + start * each, each)
            self._follow(found)
        self._last = max(self._last, now)
        self._quiet = False

    def _append(self, piece: bytes | bytearray, began: float, each: float) -> None:
        gone = self._at
        if gone:
            del self._buffer[:gone]
            del self._states[:gone]
            self._scan -= gone
            self._silences = [place - gone for place in self._silences]
            self._at = 0
            self._times.forget(gone)
        if self._skipping:
            self._lost.add(piece, began, began + len(piece) * each)
            return
        self._times.add(len(self._buffer), began, each)
        self._buffer += piece
        self._states += running_states(piece, self._states[-1])

    # Decisions that need no silence (rule 1).

    def _follow(self, found: list[FrameOrDamage]) -> None:
        """Add each frame that is complete by length and CRC to ``found``.

        Of more undecided bytes than a frame has, the first are moved to the lost bytes: no frame begins there.
        """
        server = self.conversation.role is LineRole.SERVER
        while self._at < len(self._buffer):
            end, direction = self._look(self._at)
            if end > 0 and (self._in_step or not server):
                self._give(end, direction, found, recovered=not self._in_step)
            elif len(self._buffer) - self._at <= RTU_ADU_LIMIT:
                return
            else:
                self._give_up_beginning(found)

    def _look(self, at: int) -> tuple[int, Direction]:
        """Return the end and direction of the frame that begins at position ``at``, by length rule and CRC.

        The end is the position after the frame, `WAITS` while the frame is unfinished, and `DEAD` if no frame of a
        known function begins there.
        """
        buffer = self._buffer
        size = len(buffer)
        if size - at < 2:
            return WAITS, Direction.UNKNOWN
        unit, code = buffer[at], buffer[at + 1]
        for direction in self.conversation.order(unit, code, self._times.latest):
            length = self._length(direction, at, size)
            if length == NEED_MORE:
                return WAITS, direction
            if not SHORTEST <= length <= RTU_ADU_LIMIT:
                continue
            if at + length > size:
                return WAITS, direction
            if self._fits(at, at + length):
                return at + length, direction
        return DEAD, Direction.UNKNOWN

    def _length(self, direction: Direction, at: int, end: int) -> int:
        """Return the length in bytes of the frame at ``at``, taken for a request or a reply, from bytes up to ``end``.

        `NEED_MORE` if they are too few to tell. `UNKNOWN_LENGTH` if the bytes of such a frame never tell it; but if it
        can be the expected reply, by unit and function, the length of that is returned.
        """
        length = self._lengths.length(direction, self._buffer, at, end)
        if length == UNKNOWN_LENGTH and direction is Direction.REPLY:
            due = self.conversation.due
            if due is not None and due.size > 0 and due.answers(self._buffer[at], self._buffer[at + 1], self._last):
                return due.size + AROUND_PDU
        return length

    def _fits(self, at: int, end: int) -> bool:
        return span_check(end - at).fits(self._states[at], self._states[end])

    def _give_up_beginning(self, found: list[FrameOrDamage]) -> None:
        """Move the first undecided bytes to the lost bytes: they begin no frame, as there are more than it can have.

        The bytes from the next possible begin of a frame on remain: for a server after a silence, for others where
        `_search` finds one; a frame that is complete there is added to ``found``.
        """
        if self.conversation.role is LineRole.SERVER:
            later = next((place for place in self._silences if place > self._at), None)
            self._lose(len(self._buffer) if later is None else later)
            self._in_step = False
            self._skipping = later is None
            return
        end, direction = self._search(at_limit=False)
        self._lose(self._scan)
        self._in_step = False
        if end > 0:
            self._give(end, direction, found, recovered=True)

    # Decisions at a silence (rules 2, 4 and 5).

    def _after_silence(self, found: list[FrameOrDamage]) -> None:
        """Add the frames among the undecided bytes to ``found``, after a silence of t3.5 (rules 2, 4, 5 of this file).

        If bytes remain that can still become a frame, they stay undecided; otherwise the damaged bytes are added too.
        """
        self._skipping = False
        while self._at < len(self._buffer):
            self._follow(found)
            if self._take_divided(self._at, found):
                break
            if self._look(self._at)[0] == WAITS or not self._take_inner(found, at_limit=False):
                return
        self._report_lost(found)

    def _after_limit(self, found: list[FrameOrDamage]) -> None:
        """Report all undecided bytes after a silence of ``gap_limit``: the frames among them, the rest as damaged."""
        while self._at < len(self._buffer):
            self._follow(found)
            if not self._take_divided(self._at, found) and not self._take_inner(found, at_limit=True):
                self._lost.reason = self._lost.reason or self._reason()
                self._lose(len(self._buffer))
                self._in_step = False
        self._report_lost(found)

    def _take_divided(self, at: int, found: list[FrameOrDamage]) -> bool:
        """Add the frames to ``found`` if all bytes from ``at`` on are whole frames, one or several; return whether so.

        Bytes before ``at`` are then reported as damaged.
        """
        pieces = self._divide(at)
        if not pieces:
            return False
        recovered = at > self._at and self.conversation.role is not LineRole.SERVER
        self._lose(at)
        for end, direction in pieces:
            self._give(end, direction, found, recovered=recovered)
        return True

    def _divide(self, at: int) -> list[tuple[int, Direction]]:
        """Divide the bytes from ``at`` on into whole frames: end and direction of each; empty if that is impossible."""
        size = len(self._buffer)
        # Zeros behind a frame leave its CRC at 0: where a rule fits, it decides, and not the whole.
        if SHORTEST <= size - at <= RTU_ADU_LIMIT and self._fits(at, size) and not self._end_of_known(at, size):
            return [(size, self._direction(at, size))]
        pieces: list[tuple[int, Direction]] = []
        due = self.conversation.due
        while at < size:
            end = self._end_of_known(at, size) or self._end_of_unknown(at, size)
            if not end:
                break
            direction = self._direction(at, end)
            pieces.append((end, direction))
            self.conversation.follow(self._buffer[at], self._buffer[at + 1], direction, self._last)
            at = end
        self.conversation.due = due  # what is taken is followed when it is taken
        return pieces if at == size else []

    def _end_of_known(self, at: int, size: int) -> int:
        """Return the end of the frame at ``at`` if its length by rule (request or reply) and CRC fit; 0 otherwise."""
        if size - at < SHORTEST:
            return 0
        for direction in self.conversation.order(self._buffer[at], self._buffer[at + 1], self._times.latest):
            length = self._length(direction, at, size)
            if SHORTEST <= length <= min(size - at, RTU_ADU_LIMIT) and self._fits(at, at + length):
                return at + length
        return 0

    def _end_of_unknown(self, at: int, size: int) -> int:
        """Return the end of the shortest frame at ``at`` with a right CRC, whatever the length rules; 0 for none.

        Used where the length rules give no frame.
        """
        if size - at < SHORTEST or self._look(at)[0] == WAITS:
            return 0
        first = self._prefix_end if at == self._at else SHORTEST
        last = min(size - at, RTU_ADU_LIMIT)
        for length in range(first, last + 1):
            if self._fits(at, at + length):
                return at + length
        if at == self._at:
            self._prefix_end = max(first, last + 1)
        return 0

    def _direction(self, at: int, end: int) -> Direction:
        """Return whether a frame is a request or a reply: the likelier one whose length fits, otherwise a guess."""
        unit, code = self._buffer[at], self._buffer[at + 1]
        for direction in self.conversation.order(unit, code, self._times.latest):
            if self._length(direction, at, end) == end - at:
                return direction
        return self.conversation.guess(unit, code, self._times.latest)

    def _take_inner(self, found: list[FrameOrDamage], *, at_limit: bool) -> bool:
        """Add a frame that begins inside the undecided bytes, after the first, to ``found``; return whether one does.

        The bytes before it are reported as damaged. For a server a frame begins only after a silence; for a master or
        observer anywhere. Without ``at_limit``, a frame that is unfinished there is waited for: the result is False.
        """
        if self.conversation.role is LineRole.SERVER:
            return any(self._take_divided(place, found) for place in self._silences if place > self._at)
        end, direction = self._search(at_limit=at_limit)
        if end <= 0:
            return False
        self._lose(self._scan)
        self._give(end, direction, found, recovered=True)
        return True

    def _reason(self) -> Damage:
        """Return why the whole disturbance, which ends with the undecided bytes, is no frame."""
        undecided = len(self._buffer) - self._at
        size = self._lost.size + undecided
        if size < SHORTEST:
            return Damage.TOO_SHORT
        if size > RTU_ADU_LIMIT:
            return Damage.TOO_LONG
        is_unfinished = undecided >= SHORTEST and self._look(self._at)[0] == WAITS
        return Damage.INCOMPLETE if is_unfinished else Damage.CHECKSUM

    # Looking for a frame inside a damaged chunk (rules 5 and 6).

    def _search(self, *, at_limit: bool) -> tuple[int, Direction]:
        """Find the next position after the first undecided byte where a frame begins or can begin; set ``_scan`` to it.

        Returns the frame's end and direction. The end is `WAITS` if an unfinished frame can begin there (with
        ``at_limit`` such a position is rejected), and `DEAD` if nothing is found; then ``_scan`` is the end of the
        buffer.
        """
        start = max(self._scan, self._at + 1)
        if self.conversation.role is LineRole.MASTER:
            self._scan, end = find_reply(
                self._buffer, self._states, start, self._lengths, self.conversation.due, at_limit=at_limit
            )
            return end, Direction.REPLY
        self._scan, end = find_any(self._buffer, self._states, start, self._lengths, at_limit=at_limit)
        return end, self._direction(self._scan, end) if end > 0 else Direction.UNKNOWN

    # Giving and losing.

    def _give(self, end: int, direction: Direction, found: list[FrameOrDamage], *, recovered: bool) -> None:
        """Add the lost bytes, then the frame from the first undecided byte to ``end``, to ``found``.

        The undecided bytes begin after the frame then.
        """
        self._report_lost(found)
        raw = bytes(self._buffer[self._at : end])
        ended = self._times.ended(end)
        found.append(SerialFrame(raw[0], raw[1:-2], raw, direction, self._times.began(self._at), ended, recovered))
        self.conversation.follow(raw[0], raw[1], direction, ended)
        self._move_to(end)
        self._in_step = True

    def _lose(self, end: int) -> None:
        """Add the undecided bytes before ``end`` to the lost bytes, which are reported when the disturbance ends."""
        if end > self._at:
            self._lost.add(self._buffer[self._at : end], self._times.began(self._at), self._times.ended(end))
            self._move_to(end)

    def _move_to(self, at: int) -> None:
        self._at = at
        self._scan = max(self._scan, at + 1)
        self._prefix_end = SHORTEST
        if self._silences:
            self._silences = [place for place in self._silences if place > at]

    def _fall_out_of_step(self) -> None:
        self._in_step = False
        self._skipping = self.conversation.role is LineRole.SERVER

    def _report_lost(self, found: list[FrameOrDamage]) -> None:
        if self._lost.size or self._lost.is_marked:
            found.append(self._lost.report())
            self._lost = LostBytes()

    def _answers_itself(self, code: int) -> bool:
        """Whether request and reply of this function can be the same bytes: their lengths are equal or unknown."""
        request = self._lengths.requests[code]
        return request == 0 or request == self._lengths.replies[code]
