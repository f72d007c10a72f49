"""Handlers that need time, and handlers that fail: awaited, answered, logged.

Knows contexts and their replies; knows no transport.
"""

import asyncio
import logging
from collections.abc import Iterable

from ..codes import ExceptionCode
from ..errors import ModbusError
from ..pdu.message import Message
from ..session.handler import Refusal
from ..session.server import Deferred, HandlerFailure

_log = logging.getLogger("busway.server")


def report_failures(peer: str, failures: Iterable[HandlerFailure]) -> None:
    """Log what handlers raised."""
    for failure in failures:
        _log.error(
            "%s: unit %s, function %s: the handler failed and the client was answered 04",
            peer,
            failure.context.unit,
            failure.context.function,
            exc_info=failure.error,
        )


async def answer_later(deferred: Deferred) -> None:
    """Await what a handler promised, and reply."""
    context = deferred.context
    try:
        reply: Message = await deferred.awaitable
    except Refusal as refusal:
        context.refuse(refusal.code)
    except asyncio.CancelledError:
        if not context.replied:
            context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
        raise
    except ModbusError as error:
        _log.error("%s: unit %s: the handler failed: %s", context.peer, context.unit, error)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    except Exception:
        _log.exception("%s: unit %s, function %s: the handler failed", context.peer, context.unit, context.function)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    else:
        context.reply(reply)
