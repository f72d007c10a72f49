"""Which exception code (0A or 0B) a client gets when an upstream is down, overloaded, silent or dies.

Knows errors and exception codes (Messaging on TCP/IP V1.0b §4.4.2.5, Application Protocol V1.1b3 §7).

1. An exception of the device is passed on.
2. 0A: the request was not sent, because the upstream is down, overloaded or cannot have such a request, or the client's
   deadline passed before.
3. 0B: the request was sent and brought no valid reply, or the unit is known not to answer. A write that may have been
   executed gets 0B too: the client must not take it for refused.
"""

from ...codes import ExceptionCode
from ...errors import ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoReply, Overloaded, UnitSuspended

NO_PATH = int(ExceptionCode.GATEWAY_PATH_UNAVAILABLE)
NO_ANSWER = int(ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND)


def code_for(error: ModbusError) -> int:
    """Return the exception code that a client gets for the error of its forwarded request.

    If the device replied with an exception, this is its code; so it is for a write of unknown outcome to which another
    gateway replied with an exception. Otherwise it is 0A if the request was not sent because of the upstream (down,
    overloaded) or the client's deadline, and 0B if it was sent, or was not sent because its unit does not answer.
    """
    if isinstance(error, ExceptionReply):
        return error.code
    if isinstance(error, Overloaded | InvalidRequest):
        return NO_PATH
    if isinstance(error, LinkDown):
        return NO_ANSWER if error.sent else NO_PATH
    if isinstance(error, NoReply) and error.attempt is None and not _does_not_answer(error):
        return NO_PATH
    cause = error.__cause__
    if isinstance(cause, ExceptionReply):  # a write behind another gateway, which got no reply itself
        return cause.code
    return NO_ANSWER


def _does_not_answer(error: NoReply) -> bool:
    """Whether a request was not sent because of its unit: the unit's breaker is open, or the unit owes a reply."""
    return isinstance(error, UnitSuspended) or error.kind == "in doubt"
