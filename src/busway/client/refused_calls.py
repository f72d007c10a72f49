"""Errors of calls that a link refuses before anything is sent. Knows no link and does no IO."""

from collections.abc import Sequence

from ..errors import LinkClosed, ModbusError
from ..pdu.message import Request
from ..session.call_retries_and_deadlines import function_of
from .settings import LinkSettings


def refused(refusal: ModbusError, requests: Sequence[Request]) -> list[ModbusError]:
    """Return one error for each request of a call that was refused before anything was sent, in order.

    Each is a copy of ``refusal``, the error of the call, with the request's function and its first address, which is
    None for a request without one.
    """
    errors = []
    for request in requests:
        error = type(refusal).__new__(type(refusal), *refusal.args)
        error.__dict__.update(vars(refusal))
        error.__cause__ = refusal.__cause__
        spans = request.spans()
        error.function = function_of(request)
        error.address = spans[0].address if spans else None
        errors.append(error)
    return errors


def closed_error(settings: LinkSettings) -> LinkClosed:
    """Return the error for a call on a link that the program has closed."""
    return LinkClosed("this link was closed by its user; nothing was sent", endpoint=settings.endpoint.url)
