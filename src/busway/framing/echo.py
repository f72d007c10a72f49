"""Removes the echo of a two-wire serial line: a station first receives the bytes that it sent itself.

Knows bytes and times; knows no frame.

1. ``ON``: the first copy of a sent frame among the bytes received after it is its echo, and is removed, however late it
   comes and whatever noise comes before it. If no copy comes (a collision), nothing is removed.
2. ``AUTOMATIC``: the first sent frames decide. A copy proves the echo; other bytes first, or none within the window
   after the end of the frame, prove that there is none. A later frame that behaves otherwise changes the decision. Once
   a copy has come, rule 1 holds until three frames in a row had none: one echo may be late, damaged or lost.
3. A reply can be the same bytes as the request (05, 06, 08, 22). A copy that begins before the request has ended is the
   echo, where characters take time. While it is not known whether the line echoes, another such copy is held back. If
   more bytes follow, it was the echo; if the response timeout passes first (`release`), it was the reply. Once it is
   known whether the line echoes, no copy is held.
4. What passes as a frame of another station must not be an echo: a master would take the echo of a write for its reply,
   and a server would execute its own reply.
5. A master may send the same bytes as a reply of this server (05, 06, 08, 22), but its first byte comes t3.5 after the
   reply at the earliest (ASCII: after it). So a copy that begins before that is the echo. A later one is the echo only
   where other replies, such as those to reads, have shown that the line echoes. `AUTOMATIC` also takes it for the echo
   within the window while nothing is known, and learns nothing from it.
6. A server tells its replies from requests with `OFF` too, and where `AUTOMATIC` missed a copy: `is_own_reply` compares
   whole frames. Bytes are neither held nor removed there.
"""

import math
from typing import Final

from ..values.caseless_enum import CaselessEnum

ECHO_WINDOW: Final = 0.050
"""Seconds after the end of a frame within which its echo begins, adapters and system included."""
_FRAMES_WITHOUT_ECHO: Final = 3
"""Frames in a row without a copy that show that a line echoes no more."""


class Echo(CaselessEnum):
    """Values of the option ``echo``: whether this station receives the bytes that it sends itself.

    AUTOMATIC: not known in advance; the first frames that this station sends show it.
    """

    OFF = "off"
    ON = "on"
    AUTOMATIC = "automatic"


class EchoFilter:
    """Removes from received bytes the echo of each frame that this station sends.

    Attributes:
        mode: the configured option.
        present: whether the line echoes: True, False, or None while that is not known. It changes with AUTOMATIC only.
        has_removed: whether the copy of the last frame sent was removed.
        times_tell: whether received bytes have taken their time on a line. False over a network and on a
            pseudo-terminal, where a reply can come before the computed end of its request.
        window: seconds after the end of a frame within which its echo begins, while it is not known that the line
            echoes.
    """

    __slots__ = (
        "_awaited",
        "_held",
        "_held_from",
        "_is_missed",
        "_may_be_reply",
        "_may_be_request",
        "_misses_left",
        "_others_from",
        "_own_reply",
        "_replies_from",
        "_until",
        "has_removed",
        "mode",
        "present",
        "times_tell",
        "window",
    )

    def __init__(self, mode: Echo, window: float = ECHO_WINDOW) -> None:
        self.mode: Echo = mode
        self.present: bool | None = None if mode is Echo.AUTOMATIC else mode is Echo.ON
        self.has_removed: bool = False
        self.times_tell: bool = True
        self.window: float = window
        self._awaited = b""
        self._held = b""
        self._held_from = 0.0
        self._until = 0.0
        self._may_be_reply = False
        self._replies_from = -math.inf
        self._own_reply = b""
        """The last reply, or what is left of it, until the next frame is received; servers only."""
        self._may_be_request = False
        """Whether a master can send the bytes of the last reply; servers only."""
        self._others_from = 0.0
        """Time from which a master may send after the last reply; servers only."""
        self._misses_left = 0
        """Frames without a copy that would show that the line echoes no more."""
        self._is_missed = False
        """Whether the last frame counts as one without a copy until its copy comes."""

    @property
    def pending(self) -> bool:
        """Whether received bytes are held back because they could be an echo."""
        return bool(self._held)

    def deadline(self) -> float | None:
        """Return the time, in seconds, at which `tick` gives out bytes that are held as the beginning of an echo.

        None if no bytes are held, or they are a complete copy of the sent frame: only more bytes or `release` decide
        about that.
        """
        return self._until if self._held and len(self._held) < len(self._awaited) else None

    def sent(self, raw: bytes, ends: float, *, may_be_reply: bool, replies_from: float = -math.inf) -> None:
        """Announce a frame that this station sends, so that `receive` removes its echo; no effect with the mode OFF.

        The echo of an earlier frame is no longer expected. All held bytes are dropped, also a whole copy: call
        `release` before.

        Args:
            raw: the bytes of the frame.
            ends: time at which its last byte has been sent, in seconds.
            may_be_reply: whether the reply can be the same bytes as the frame; then a copy is held until it is known
                whether the line echoes (rule 3).
            replies_from: the earliest time, in seconds, at which a reply may begin.
        """
        if self.mode is Echo.OFF:
            return
        self._awaited, self._held, self._until = raw, b"", ends + self.window
        self._may_be_reply = may_be_reply
        self._replies_from = replies_from
        self._is_missed = self.has_removed = False

    def replied(self, raw: bytes, ends: float, others_from: float, *, may_be_request: bool) -> None:
        """Announce a reply that this server sends, instead of `sent`: `receive` or `is_own_reply` recognises its echo.

        Args:
            raw: the bytes of the reply.
            ends: time at which its last byte has been sent, in seconds.
            others_from: the earliest time, in seconds, at which a master may begin to send.
            may_be_request: whether the same bytes can be a request.
        """
        self.sent(raw, ends, may_be_reply=False)
        self._own_reply, self._others_from, self._may_be_request = raw, others_from, may_be_request
        if may_be_request and self.present is False:
            self._until = others_from

    def is_own_reply(self, raw: bytes, began: float) -> bool:
        """Return whether a received frame is the echo of the last reply, or a part of it that passes for a frame.

        Called once for each frame, in order. False for all but the first frame after the reply, or the parts of its
        echo; always False with the mode ON, which removes the echo.

        Args:
            raw: the bytes of the frame.
            began: time at which its first byte was on the line, in seconds.
        """
        own, self._own_reply = self._own_reply, b""
        if not own or self.has_removed or self.mode is Echo.ON:
            return False
        if raw == own and not self._may_be_request:
            self._misses_left = _FRAMES_WITHOUT_ECHO
            self.present = True if self.mode is Echo.AUTOMATIC else self.present
            return True
        if own.startswith(raw) and (began < self._others_from or self._misses_left > 0):
            self._own_reply = own[len(raw) :]
            return True
        if self.mode is Echo.OFF:
            self._misses_left = max(self._misses_left - 1, 0)
        return False

    def receive(self, data: bytes, now: float) -> bytes:
        """Return received bytes without the echo; bytes held earlier that turn out to be no echo come first.

        Empty if all bytes are echo, or are held because they could be.

        Args:
            data: the received bytes.
            now: time at which the first of them was on the line, in seconds.
        """
        awaited = self._awaited
        if not awaited:
            return data
        if self._echoes:
            return self._without_copy(self._held + data, now)
        if len(self._held) == len(awaited):  # rule 3: something follows the copy
            return self._taken_out(data)
        if not self._held and now > self._until:
            return self._no_copy(data)
        self._held_from = self._held_from if self._held else now
        whole = self._held + data
        if not awaited.startswith(whole[: len(awaited)]):
            return self._no_copy(whole)
        self._held = whole[: len(awaited)]
        if len(whole) < len(awaited):
            return b""
        is_echo = not self._may_be_reply or (self.times_tell and self._held_from < self._replies_from)
        if is_echo or len(whole) > len(awaited):
            return self._taken_out(whole[len(awaited) :])
        if self.present is False:
            return self._no_copy(whole)
        return b""

    def tick(self, now: float) -> bytes:
        """Return the held bytes, as received, if the rest of the echo has not come by `deadline`; otherwise no bytes.

        ``now`` is the time in seconds.
        """
        deadline = self.deadline()
        if deadline is None or now < deadline:
            return b""
        return self._held_without_rest() if self._echoes else self._no_copy(self._held)

    def release(self) -> bytes:
        """Return all held bytes as received, and stop waiting for the echo; empty if none are held.

        If it is known that the line echoes, the echo is still removed when it comes later. Called at a response
        timeout, or when closing.
        """
        if self._echoes and self._awaited:
            return self._held_without_rest()
        if not self._held:
            self._awaited = b""
            return b""
        return self._no_copy(self._held)

    @property
    def _echoes(self) -> bool:
        """Whether a copy of each frame is to be expected (rules 1 and 2)."""
        return self.mode is Echo.ON or self._misses_left > 0

    def _without_copy(self, whole: bytes, now: float) -> bytes:
        """Return bytes without the copy of the sent frame; bytes that may be the begin of it are held."""
        awaited = self._awaited
        at = whole.find(awaited)
        if at >= 0:
            self._learn(present=True)
            return whole[:at] + whole[at + len(awaited) :]
        kept = self._begin_of_copy(whole, now)
        given, self._held = whole[: len(whole) - kept], whole[len(whole) - kept :]
        if given:
            self._miss()
        else:
            self._until = max(self._until, now + self.window)
        return given

    def _begin_of_copy(self, whole: bytes, now: float) -> int:
        """Return how many bytes at the end may be the begin of the copy; after the window, all of them or none."""
        longest = min(len(self._awaited) - 1, len(whole))
        shortest = 1 if now <= self._until else len(whole)
        sizes = range(longest, shortest - 1, -1)
        return next((size for size in sizes if self._awaited.startswith(whole[-size:])), 0)

    def _held_without_rest(self) -> bytes:
        released, self._held = self._held, b""
        self._miss()
        return released

    def _miss(self) -> None:
        """Count the last frame as one without a copy, until its copy comes; no effect with the mode ON."""
        if self.mode is Echo.AUTOMATIC and not self._is_missed:
            self._is_missed = True
            self.present = False
            self._misses_left -= 1

    def _taken_out(self, rest: bytes) -> bytes:
        if self._may_be_request and self._held_from >= self._others_from:
            self._awaited = self._held = b""
            self.has_removed = True  # it may also be a request (rule 5)
        else:
            self._learn(present=True)
        return rest

    def _no_copy(self, data: bytes) -> bytes:
        self._learn(present=False)
        return data

    def _learn(self, *, present: bool) -> None:
        self._awaited = self._held = b""
        self.has_removed = present
        if self.mode is Echo.AUTOMATIC:
            self.present = present
            self._misses_left = _FRAMES_WITHOUT_ECHO if present else 0
