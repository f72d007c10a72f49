"""Visual diagnosis of a listener: three status indicators, as states that a status, a page or a real status indicator
shows (S19).

Knows when something happened; knows no bytes and no clock.

1. Communication: on while frames come or go.
2. Error: steady for an internal fault (a handler failed, no new connection can be accepted), flashing for a fault of
   communication or configuration (a damaged frame, a port that is not there). The steady one goes before.
3. Device status: on when it answers, flashing in listen-only mode, off otherwise.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final

ACTIVITY_SHOWN: Final = 0.5
"""Seconds for which a frame shows as activity: long enough to be seen."""
FAULT_SHOWN: Final = 10.0
"""Seconds for which a fault that did not happen again shows."""
_NEVER: Final = float("-inf")


class StatusIndicator(Enum):
    """The states of one status indicator."""

    OFF = "off"
    ON = "on"
    FLASHING = "flashing"


@dataclass(frozen=True, slots=True)
class StatusIndicators:
    """The status indicators of a listener at one moment."""

    communication: StatusIndicator
    error: StatusIndicator
    device_status: StatusIndicator


class Diagnosis:
    """When what happened on a listener last.

    Attributes:
        is_open: whether it can be reached.
        traffic: when a frame came or went, in seconds of whatever clock ``now`` is of.
        communication_fault: when one was damaged.
        internal_fault: when a handler failed, or the system had nothing left for a new connection.
    """

    __slots__ = ("communication_fault", "internal_fault", "is_open", "traffic")

    def __init__(self) -> None:
        self.is_open = False
        self.traffic = self.communication_fault = self.internal_fault = _NEVER

    def lamps(self, now: float, *, listen_only: bool = False) -> StatusIndicators:
        """What the status indicators show at ``now``."""
        error = StatusIndicator.OFF
        if now < self.internal_fault + FAULT_SHOWN:
            error = StatusIndicator.ON
        elif not self.is_open or now < self.communication_fault + FAULT_SHOWN:
            error = StatusIndicator.FLASHING
        device = StatusIndicator.OFF
        if self.is_open:
            device = StatusIndicator.FLASHING if listen_only else StatusIndicator.ON
        return StatusIndicators(
            StatusIndicator.ON if now < self.traffic + ACTIVITY_SHOWN else StatusIndicator.OFF, error, device
        )
