"""The table of all fault profiles of devices; the profiles are defined in the files beside this one.

===============  ==============================================================================================
`connections`    Fault profiles of devices that close or refuse connections
`contents`       Fault profiles of devices whose replies have wrong contents, or arrive in unusual pieces
`identifiers`    Fault profiles of devices that answer with a wrong transaction identifier or unit
`lines`          Fault profiles of serial lines: junk around frames, echo of the request, replies to broadcasts
`not_simulated`  Fault profiles that no server can simulate, such as those of ports and clients
`refusals`       Fault profiles of devices that refuse valid requests, or answer with unusual exceptions
`timing`         Fault profiles of devices that reply too late, out of order, or not for a while
===============  ==============================================================================================

Where it is decided: what a profile does to a request or a reply, and which parameters it has (the arguments of its
function, with type, range, default and help): its file, such as `refusals` or `timing`. Which faults no server can
simulate: `not_simulated`. Which requests it applies to: `busway.faults.applied_faults`.
"""

from typing import Final

from ..profile import FaultProfileTable
from .connections import CLOSE_IF_SILENT, EXECUTE_THEN_DROP, IDLE_CLOSE, SINGLE_CLIENT
from .contents import DRIBBLE, GLUE, LONG, SHORT, WIDE_REGISTER, WRONG_ECHO
from .identifiers import (
    FOREIGN_TRANSACTION,
    TRANSACTION_PLUS_ONE,
    TRANSACTION_RANDOM,
    TRANSACTION_ZERO,
    UNIT_0,
    UNIT_1,
    UNIT_255,
)
from .lines import BROADCAST_REPLY, ECHO, LEADING_ZERO, NOISE
from .refusals import BUSY, FC6_ONLY, FC16_ONLY, HOLE, MAX_BLOCK, ODD_EXCEPTION
from .timing import LATE, MIN_GAP, MUTE_AFTER_CONNECT, QUEUE_LAG, UNIT_SWITCH, WEDGED

FAULT_PROFILES: Final = FaultProfileTable(
    LATE,
    QUEUE_LAG,
    FOREIGN_TRANSACTION,
    TRANSACTION_PLUS_ONE,
    TRANSACTION_ZERO,
    TRANSACTION_RANDOM,
    UNIT_255,
    UNIT_0,
    UNIT_1,
    MUTE_AFTER_CONNECT,
    CLOSE_IF_SILENT,
    SINGLE_CLIENT,
    IDLE_CLOSE,
    WEDGED,
    MIN_GAP,
    UNIT_SWITCH,
    MAX_BLOCK,
    HOLE,
    WIDE_REGISTER,
    SHORT,
    LONG,
    DRIBBLE,
    GLUE,
    BUSY,
    EXECUTE_THEN_DROP,
    WRONG_ECHO,
    ODD_EXCEPTION,
    FC6_ONLY,
    FC16_ONLY,
    LEADING_ZERO,
    NOISE,
    ECHO,
    BROADCAST_REPLY,
)
"""All fault profiles of devices, by name."""
