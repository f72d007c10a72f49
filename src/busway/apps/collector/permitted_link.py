"""A link that asks for permission before each transaction, for collectors that share links with others."""

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import LinkDown
from ...pdu.message import Request
from .poller import PollLink


class PermittedLink:
    """A link that sends requests only after a function has permitted it.

    Args:
        name: the name of the link.
        link: the link that sends the requests.
        permit: called with the name right before each transaction; raises `LinkDown` where it may not begin.
    """

    def __init__(self, name: str, link: PollLink, permit: Callable[[str], None]) -> None:
        self._name, self._link, self._permit = name, link, permit

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        """Send requests if permission is given, and return a reply or error for each; else the same error for all."""
        try:
            self._permit(self._name)
        except LinkDown as error:
            return [error] * len(requests)
        return await self._link.run(unit, requests, call_options)
