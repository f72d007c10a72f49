"""Handles responders that need time or raise an exception: awaits them, logs exceptions, and answers the client
instead.

Knows contexts and their replies; knows no transport.
"""

import asyncio
import logging
from collections.abc import Iterable

from ..codes import ExceptionCode
from ..errors import ModbusError
from ..pdu.message import Message
from ..session.responder import SILENCE, Deferral, Refusal
from ..session.server_pipeline import ResponderFailure
from ..session.tcp_server import Deferred

_log = logging.getLogger("busway.server")


def report_failures(peer: str, failures: Iterable[ResponderFailure]) -> None:
    """Log the exceptions that responders raised instead of answering; ``peer`` names the client in the log."""
    for failure in failures:
        _log.error(
            "%s: unit %s, function %s: the responder failed and the client was answered 04",
            peer,
            failure.context.unit,
            failure.context.function,
            exc_info=failure.error,
        )


def begin_late_answers(
    deferred: Iterable[Deferred], loop: asyncio.AbstractEventLoop, *holders: set[asyncio.Task[None]]
) -> None:
    """Start a task for each request that its responder answers later; the task sends the reply.

    Each set in ``holders`` contains the task until it ends.
    """
    for one in deferred:
        task = loop.create_task(answer_later(one))
        for holder in holders:
            holder.add(task)
            task.add_done_callback(holder.discard)


async def answer_later(deferred: Deferred) -> None:
    """Await the reply of a responder that needs time, and send it; an exception is logged and answered with code 04.

    A `Refusal` is answered with its own code. A request that was cancelled before its reply is answered with 04 too,
    and so is one whose awaitable gives neither a reply nor `SILENCE`.
    """
    context = deferred.context
    try:
        reply: Message | Deferral = await deferred.awaitable
        if not isinstance(reply, Message) and reply is not SILENCE:
            raise TypeError(f"the awaitable of a responder gave {reply!r}, which is no reply")
    except Refusal as refusal:
        context.refuse(refusal.code)
    except asyncio.CancelledError:
        if not context.replied:
            context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
        raise
    except ModbusError as error:
        _log.error("%s: unit %s: the responder failed: %s", context.peer, context.unit, error)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    except Exception:
        _log.exception("%s: unit %s, function %s: the responder failed", context.peer, context.unit, context.function)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    else:
        context.reply(reply)
