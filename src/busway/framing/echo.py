"""Removes the echo of a two-wire serial line: a station first receives the bytes that it sent itself.

Knows bytes and times; knows no frame.

1. ``ON``: the bytes received after a sent frame are its copy, and are removed. If they differ (a collision, or a
   converter that was switched over), nothing is removed.
2. ``AUTOMATIC``: the first sent frames decide. A copy proves the echo; other bytes first, or none within the window
   after the end of the frame, prove that there is none. A later frame that behaves otherwise changes the decision.
3. A reply can be the same bytes as the request (05, 06, 08, 22). While it is not known whether the line echoes, such a
   copy is held back. If more bytes follow, it was the echo; if the response timeout passes first (`release`), it was
   the reply. Once it is known whether the line echoes, no copy is held.
"""

from typing import Final

from ..values.caseless_enum import CaselessEnum

ECHO_WINDOW: Final = 0.050
"""Seconds after the end of a frame within which its echo begins, adapters and system included."""


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
        window: seconds after the end of a frame within which its echo begins.
    """

    __slots__ = ("_awaited", "_held", "_may_be_reply", "_until", "mode", "present", "window")

    def __init__(self, mode: Echo, window: float = ECHO_WINDOW) -> None:
        self.mode: Echo = mode
        self.present: bool | None = None if mode is Echo.AUTOMATIC else mode is Echo.ON
        self.window: float = window
        self._awaited = b""
        self._held = b""
        self._until = 0.0
        self._may_be_reply = False

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

    def sent(self, raw: bytes, ends: float, *, may_be_reply: bool) -> None:
        """Announce a frame that this station sends, so that `receive` removes its echo; no effect with the mode OFF.

        The echo of an earlier frame is no longer expected. All held bytes are dropped, also a whole copy: call
        `release` before.

        Args:
            raw: the bytes of the frame.
            ends: time at which its last byte has been sent, in seconds.
            may_be_reply: whether the reply can be the same bytes as the frame; then a copy is held until it is known
                whether the line echoes (rule 3).
        """
        if self.mode is Echo.OFF:
            return
        self._awaited, self._held, self._until = raw, b"", ends + self.window
        self._may_be_reply = may_be_reply

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
        if len(self._held) == len(awaited):  # rule 3: something follows the copy
            return self._taken_out(data)
        if not self._held and now > self._until:
            return self._no_copy(data)
        whole = self._held + data
        if not awaited.startswith(whole[: len(awaited)]):
            return self._no_copy(whole)
        self._held = whole[: len(awaited)]
        if len(whole) < len(awaited):
            return b""
        if self.present is True or not self._may_be_reply or len(whole) > len(awaited):
            return self._taken_out(whole[len(awaited) :])
        if self.present is False:
            return self._no_copy(whole)
        return b""

    def tick(self, now: float) -> bytes:
        """Return the held bytes, as received, if the rest of the echo has not come by `deadline`; otherwise no bytes.

        ``now`` is the time in seconds.
        """
        deadline = self.deadline()
        return b"" if deadline is None or now < deadline else self._no_copy(self._held)

    def release(self) -> bytes:
        """Return all held bytes as received, and stop waiting for the echo; empty if none are held.

        Called at a response timeout, or when closing.
        """
        if not self._held:
            self._awaited = b""
            return b""
        return self._no_copy(self._held)

    def _taken_out(self, rest: bytes) -> bytes:
        self._learn(present=True)
        return rest

    def _no_copy(self, data: bytes) -> bytes:
        self._learn(present=False)
        return data

    def _learn(self, *, present: bool) -> None:
        self._awaited = self._held = b""
        if self.mode is Echo.AUTOMATIC:
            self.present = present
