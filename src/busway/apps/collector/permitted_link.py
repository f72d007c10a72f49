"""A link whose transactions must be permitted one by one. Knows the permission and the link; nothing of either."""

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import LinkDown
from ...pdu.message import Request
from .poller import PollLink


class PermittedLink:
    """A link that asks before it sends.

    Args:
        name: of the link.
        link: what sends.
        permit: called with the name right before each transaction; raises `LinkDown` where it may not begin.
    """

    def __init__(self, name: str, link: PollLink, permit: Callable[[str], None]) -> None:
        self._name, self._link, self._permit = name, link, permit

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        """A reply or an error for each request; the error of the permission for all, with nothing sent."""
        try:
            self._permit(self._name)
        except LinkDown as error:
            return [error] * len(requests)
        return await self._link.run(unit, requests, call_options)
