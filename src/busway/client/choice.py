"""Explicit management: how many connections one endpoint may have, and which of them takes a request.

Knows what a rule looks at; knows no pool and no connection (Messaging on TCP/IP V1.0b §4.2.1.1, §4.2.1.2).
"""

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from ..errors import LinkDown, Overloaded
from .management import LinkSelection
from .settings import LinkSettings


class Choosable(Protocol):
    """A link, as far as it matters which one it is.

    Attributes:
        shared: whether all users of the endpoint share it.
        opened: when its connection was made.
    """

    shared: bool
    opened: float

    @property
    def is_connected(self) -> bool:
        """Whether a connection stands."""


AnyLink = TypeVar("AnyLink", bound=Choosable)


def check_room(links: Iterable[Choosable], settings: LinkSettings) -> None:
    """Raise `Overloaded` where an endpoint has as many connections of explicit management as it may have."""
    limit = settings.management.max_connections
    held = sum(not link.shared for link in links)
    if held >= limit:
        raise Overloaded(
            f"{held} links with a connection of their own are open already, and max_connections is {limit}; "
            "nothing was sent",
            endpoint=settings.endpoint.url,
        )


def chosen(links: Sequence[AnyLink], settings: LinkSettings, rule: LinkSelection) -> AnyLink:
    """The link that takes a request: one that is connected, by the rule; else the first, which connects at this need.

    ``links`` are in the order they were made. Raises `LinkDown` where there is none.
    """
    if not links:
        raise LinkDown(
            "no link to it is open, so there is none to choose; nothing was sent", endpoint=settings.endpoint.url
        )
    standing = [link for link in links if link.is_connected]
    if not standing:
        return links[0]
    return standing[0] if rule is LinkSelection.FIRST else min(standing, key=lambda link: link.opened)
