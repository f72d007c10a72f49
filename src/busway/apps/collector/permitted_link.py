"""A link that asks a function for permission before it sends requests, for collectors of a fleet, which share links."""

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import ExceptionReply, InvalidRequest, LinkDown, ModbusError, Overloaded, UnitSuspended
from ...pdu.message import Request
from .poller import PollLink


class PermittedLink:
    """A link that sends requests only if a function permits it at that moment.

    Args:
        name: the name of the link.
        link: the link that sends the requests.
        permit: called with the name right before requests are sent; raises `LinkDown` to forbid sending.
        unanswered: called with the name after requests of which at least one may have been sent and got no valid reply;
            None if it is not needed.
    """

    def __init__(
        self, name: str, link: PollLink, permit: Callable[[str], None], unanswered: Callable[[str], None] | None
    ) -> None:
        self._name, self._link = name, link
        self._permit, self._unanswered = permit, unanswered

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        """Send requests to a unit if ``permit`` allows it now, and return a reply or an error for each, in order.

        If ``permit`` raises `LinkDown`, nothing is sent, and the result has that error for each request. In a fleet,
        ``permit`` allows sending while this collector owns the link.
        """
        try:
            self._permit(self._name)
        except LinkDown as error:
            return [error] * len(requests)
        are_answered = False
        try:
            outcomes = await self._link.run(unit, requests, call_options)
            are_answered = not any(map(_may_be_on_its_way, outcomes))
        finally:
            if not are_answered and self._unanswered is not None:
                self._unanswered(self._name)
        return outcomes


def _may_be_on_its_way(outcome: object) -> bool:
    """Whether a request with this outcome (reply or error) may have been sent, and may still reach its device later."""
    if isinstance(outcome, LinkDown):
        return outcome.sent
    answered_or_not_sent = (ExceptionReply, InvalidRequest, Overloaded, UnitSuspended)
    return isinstance(outcome, ModbusError) and not isinstance(outcome, answered_or_not_sent)
