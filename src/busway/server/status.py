"""A listener as a status shows it."""

from dataclasses import dataclass

from ..session.diagnostics import Counters
from .diagnosis import Lamps


@dataclass(frozen=True, slots=True)
class ListenerStatus:
    """One listener.

    Attributes:
        endpoint: its URL, as it is bound.
        is_open: whether it can be reached: False while a port is waited for.
        lamps: what its lamps show.
        counters: the diagnostic counters of function 08 (Serial Line V1.02 appendix A).
        event_count: successful messages (function 11).
        listen_only: whether nothing is answered until a restart.
        requests: requests for own units since the start.
        foreign: frames of others that passed by; 0 on TCP.
        damaged: disturbances; on UDP, datagrams that were no whole frame.
        abandoned: answers that did not leave because somebody else had spoken.
    """

    endpoint: str
    is_open: bool
    lamps: Lamps
    counters: Counters
    event_count: int
    listen_only: bool
    requests: int = 0
    foreign: int = 0
    damaged: int = 0
    abandoned: int = 0
