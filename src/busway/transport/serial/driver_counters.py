"""Error counters that a port's driver keeps since the system started (``struct serial_icounter_struct``).

Knows the numbers only, and not what they mean for a request.
"""

import struct
from dataclasses import dataclass

from .ioctl import Ioctl, asked, system_ioctl

TIOCGICOUNT = 0x545D

_LAYOUT = struct.Struct("11i9i")


@dataclass(frozen=True, slots=True)
class DriverCounters:
    """What a port's driver has counted: characters, errors and breaks.

    Attributes:
        received, sent: characters.
        framing_errors, parity_errors: characters whose stop or parity bit was wrong.
        overruns: characters lost in the port because the driver did not read them in time.
        buffer_overruns: characters lost because the system's buffer was full.
        breaks: how often the line was at 0 for longer than a character.
    """

    received: int = 0
    sent: int = 0
    framing_errors: int = 0
    parity_errors: int = 0
    overruns: int = 0
    buffer_overruns: int = 0
    breaks: int = 0

    def since(self, earlier: "DriverCounters") -> "DriverCounters":
        """Return the difference between these counters and ``earlier`` ones of the same port."""
        return DriverCounters(
            received=self.received - earlier.received,
            sent=self.sent - earlier.sent,
            framing_errors=self.framing_errors - earlier.framing_errors,
            parity_errors=self.parity_errors - earlier.parity_errors,
            overruns=self.overruns - earlier.overruns,
            buffer_overruns=self.buffer_overruns - earlier.buffer_overruns,
            breaks=self.breaks - earlier.breaks,
        )


def read_counters(descriptor: int, ioctl: Ioctl = system_ioctl) -> DriverCounters | None:
    """Return the counters of an open port; None if its driver keeps none (many USB adapters, pseudo-terminals)."""
    buffer = bytearray(_LAYOUT.size)
    if not asked(ioctl, descriptor, TIOCGICOUNT, buffer):
        return None
    _, _, _, _, received, sent, framing, overrun, parity, breaks, buffer_overrun, *_ = _LAYOUT.unpack(buffer)
    return DriverCounters(received, sent, framing, parity, overrun, buffer_overrun, breaks)
