"""A link that asks for permission before it sends requests, for collectors that share links with other collectors."""

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import LinkDown
from ...pdu.message import Request
from .poller import PollLink


class PermittedLink:
    """A link that sends requests only if a function permits it at that moment.

    Args:
        name: the name of the link.
        link: the link that sends the requests.
        permit: called with the name right before requests are sent; raises `LinkDown` if they may not be sent.
    """

    def __init__(self, name: str, link: PollLink, permit: Callable[[str], None]) -> None:
        self._name, self._link, self._permit = name, link, permit

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        """Send requests to a unit if ``permit`` allows it now, and return a reply or an error for each, in order.

        In a fleet it does while this collector owns the link. Otherwise nothing is sent, and its `LinkDown` stands for
        each request.
        """
        try:
            self._permit(self._name)
        except LinkDown as error:
            return [error] * len(requests)
        return await self._link.run(unit, requests, call_options)
