"""Judges whether a time service keeps the wall clock of the machine right: asks the kernel, and weighs its answer.

Knows the kernel's call and how long the machine has run; `sample_clock` knows what follows for samples.

1. The kernel knows whether a time service (chrony, ntpd, timesyncd, PTP) has set the clock: the bit ``STA_UNSYNC`` of
   adjtimex is then clear. The kernel sets the bit again when no service has set the clock for hours. A container shares
   the bit with its host.
2. *Synchronised* proves that the clock is right. *Unsynchronised* proves nothing: chrony without ``rtcsync`` and the
   tools of virtual machines set the clock and leave the bit as it is, and a plant may have no time service at all. So
   *unsynchronised* counts only for the first `SETTLES` seconds after the machine has started, while a time service may
   still come, and again when a time service that was there has been lost for `SETTLES` seconds.
3. If the kernel cannot be asked, the clock counts as right.
4. For a machine whose clock is set by other means, the environment variable ``BUSWAY_CLOCK`` says so.
"""

import ctypes
import os
import time
from enum import Enum
from typing import Final, Literal, cast, get_args

from ...errors import ConfigError

SETTLES: Final = 600.0
"""Seconds allowed for a time service to set the clock after a start of the machine, or to come back once lost."""
_UNSYNCHRONISED_BIT: Final = 0x0040
"""``STA_UNSYNC`` of <sys/timex.h>."""

ClockTrust = Literal["auto", "synchronised", "trusted"]
_VARIABLE: Final = "BUSWAY_CLOCK"
"""Environment variable with the `ClockTrust` of collectors whose file has no option ``clock``."""


class Synchronisation(Enum):
    """Whether the kernel says that a time service keeps the wall clock right; ``UNKNOWN`` if it cannot be asked."""

    YES = "synchronised"
    NO = "unsynchronised"
    UNKNOWN = "unknown"


class _Timex(ctypes.Structure):
    """The first fields of ``struct timex`` of Linux, and room for the others."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("maximum_error", ctypes.c_long),
        ("estimated_error", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def kernel_synchronisation() -> Synchronisation:
    """Ask the kernel whether a time service keeps the wall clock right; changes nothing, and raises nothing."""
    found = _Timex()  # `modes` of 0: only asks
    try:
        code = ctypes.CDLL(None).adjtimex(ctypes.byref(found))
    except (OSError, AttributeError, TypeError):  # another system than Linux has no such call
        return Synchronisation.UNKNOWN
    if code < 0:  # a sandbox that forbids it
        return Synchronisation.UNKNOWN
    return Synchronisation.NO if found.status & _UNSYNCHRONISED_BIT else Synchronisation.YES


def seconds_since_boot() -> float:
    """Return the seconds since the machine was started, including the time it slept.

    On other systems than Linux it is `time.monotonic`.
    """
    boot = getattr(time, "CLOCK_BOOTTIME", None)  # Linux alone has it
    return time.monotonic() if boot is None else time.clock_gettime(boot)


def trust_of(option: ClockTrust | None) -> ClockTrust:
    """Return how far the wall clock is trusted: ``option``, or else the value of ``BUSWAY_CLOCK``, or else ``auto``.

    Args:
        option: the option of the collector file; None if it has none.

    Raises:
        ConfigError: ``BUSWAY_CLOCK`` has a value that is no `ClockTrust`.
    """
    said = option or os.environ.get(_VARIABLE) or "auto"
    if said not in get_args(ClockTrust):
        raise ConfigError(f"must be {', '.join(get_args(ClockTrust))}, not {said!r}", key=_VARIABLE)
    return cast(ClockTrust, said)


class ClockJudge:
    """Judges whether the wall clock is known to be right.

    Args:
        trust: ``auto`` judges by the rules of this module; ``synchronised`` believes the clock only while the kernel
            says that a time service keeps it right; ``trusted`` always.
    """

    def __init__(self, trust: ClockTrust = "auto") -> None:
        self._trust = trust
        self._was_synchronised = False
        self._lost_at: float | None = None

    def is_known(self, says: Synchronisation, now: float) -> bool:
        """Return whether the wall clock is known to be right. To be called every few seconds.

        With ``auto``: False if the kernel says that the clock is unsynchronised, and either no time service was seen
        yet and the machine has run for less than `SETTLES` seconds, or a time service that was seen has been lost for
        `SETTLES` seconds. Otherwise True. Each call is remembered for the later ones.

        Args:
            says: what the kernel says now.
            now: seconds since the machine was started.
        """
        if self._trust != "auto":
            return self._trust == "trusted" or says is Synchronisation.YES
        if says is not Synchronisation.NO:
            self._was_synchronised |= says is Synchronisation.YES
            self._lost_at = None
            return True
        if not self._was_synchronised:
            return now >= SETTLES
        self._lost_at = now if self._lost_at is None else self._lost_at
        return now - self._lost_at < SETTLES
