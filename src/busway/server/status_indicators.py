"""The three status indicators of a listener (communication, error, device status) that the serial specification asks
for.

Knows when something happened; knows no bytes and no clock.

1. Communication: on while frames come or go.
2. Error: steady for an internal fault (a responder failed, no new connection can be accepted), flashing for a fault of
   communication or configuration (a damaged frame, an absent port). With both, it is steady.
3. Device status: on when the listener is open, flashing while one of its units is in listen-only mode, off otherwise.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final

ACTIVITY_SHOWN: Final = 0.5
"""Seconds for which the communication indicator is on after a frame: long enough to be seen."""
FAULT_SHOWN: Final = 10.0
"""Seconds for which the error indicator shows a fault, if it does not happen again."""
_NEVER: Final = float("-inf")


class StatusIndicator(Enum):
    """The state of one status indicator: on, off or flashing."""

    OFF = "off"
    ON = "on"
    FLASHING = "flashing"


@dataclass(frozen=True, slots=True)
class StatusIndicators:
    """The three status indicators of a listener at one moment."""

    communication: StatusIndicator
    error: StatusIndicator
    device_status: StatusIndicator


class Diagnosis:
    """When a listener last had traffic and faults, from which the states of its status indicators follow.

    Attributes:
        is_open: whether the listener can be reached.
        traffic: time of the last received or sent frame, in seconds by the clock of ``now`` of `indicators`; minus
            infinity before the first.
        communication_fault: time of the last damaged frame, by the same clock; minus infinity before the first.
        internal_fault: time at which a responder last failed, or the system had no resources for a new connection;
            minus infinity before the first.
    """

    __slots__ = ("communication_fault", "internal_fault", "is_open", "traffic")

    def __init__(self) -> None:
        self.is_open: bool = False
        self.traffic: float = _NEVER
        self.communication_fault: float = _NEVER
        self.internal_fault: float = _NEVER

    def indicators(self, now: float, *, listen_only: bool = False) -> StatusIndicators:
        """Return the states of the three status indicators at ``now`` (seconds).

        ``listen_only``: whether one of the listener's units is in listen-only mode.
        """
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
