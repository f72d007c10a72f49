"""Collects bytes on a serial line that are no frame, until the disturbance ends, to report them as one `Damaged`.

Knows bytes and times; knows no framing. However long a disturbance lasts, no more bytes of it are kept than a frame
has.
"""

from typing import Final

from ..codes import RTU_ADU_LIMIT
from .lengths import SHORTEST
from .received import Damage, Damaged

_NEVER: Final = float("-inf")


class LostBytes:
    """The bytes of one disturbance on a serial line, collected until it ends.

    Attributes:
        reason: why the bytes are no frame, as `mark` or the receiver has set it; None if neither has, and then `report`
            finds the reason by the size: too long, too short or a wrong CRC.
        size: the number of all bytes added, also of those that were not stored: at most 256 are.
        is_marked: whether `mark` was called; then there is a disturbance even if ``size`` is 0.
    """

    __slots__ = ("_began", "_ended", "_overrun", "_raw", "is_marked", "reason", "size")

    def __init__(self) -> None:
        self._raw = bytearray()
        self._began = self._ended = _NEVER
        self._overrun = False
        self.is_marked: bool = False
        self.reason: Damage | None = None
        self.size: int = 0

    def add(self, data: bytes | bytearray, began: float, ended: float) -> None:
        """Add received bytes, which were on the line from ``began`` to ``ended`` (seconds), to the disturbance."""
        if self._began == _NEVER:
            self._began = began
        self._ended = ended
        self.size += len(data)
        room = RTU_ADU_LIMIT - len(self._raw)
        if room > 0:
            self._raw += data[:room]

    def mark(self, reason: Damage, now: float) -> None:
        """Add an error that was noticed at ``now`` (seconds) to the disturbance, such as wrong parity.

        The latest error is the ``reason``.
        """
        if self._began == _NEVER:
            self._began = now
        self._ended = now
        self.reason = reason
        self._overrun = self._overrun or reason is Damage.OVERRUN
        self.is_marked = True

    def report(self) -> Damaged:
        """Return the whole disturbance as one `Damaged`; use a new `LostBytes` for the next disturbance."""
        reason = self.reason
        if reason is None:
            reason = Damage.TOO_LONG if self.size > RTU_ADU_LIMIT else Damage.CHECKSUM
            if self.size < SHORTEST:
                reason = Damage.TOO_SHORT
        return Damaged(bytes(self._raw), reason, self.size, self._began, self._ended, self._overrun)
