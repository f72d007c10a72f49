"""Explicit connection management: the limit of links per endpoint, and links that choose one of them (``select``).

Knows no pool and no connection (Messaging on TCP/IP V1.0b §4.2.1.1, §4.2.1.2).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol, TypeVar

from ..errors import ConfigError, InvalidRequest, LinkDown, Overloaded
from ..options.client import LinkSelection
from .settings import CALL_DEFAULTS, LinkSettings


class Choosable(Protocol):
    """Interface of a link to an endpoint, for the option ``select``, which chooses one of several.

    Attributes:
        shared: whether all users of the endpoint share the link.
        opened: when the last connection was opened, in seconds by the clock of the link.
    """

    shared: bool
    opened: float

    @property
    def is_connected(self) -> bool:
        """Whether the link has an open connection now."""


AnyLink = TypeVar("AnyLink", bound=Choosable)


def check_room(links: Iterable[Choosable], settings: LinkSettings) -> None:
    """Raise `Overloaded` if no further link with ``shared=False`` to the endpoint is allowed (``max_connections``).

    ``links`` are all links to the endpoint; shared links do not count.
    """
    limit = settings.management.max_connections
    held = sum(not link.shared for link in links)
    if held >= limit:
        raise Overloaded(
            f"{held} links with a connection of their own are open already, and max_connections is {limit}; "
            "nothing was sent",
            endpoint=settings.endpoint.url,
        )


def chosen(links: Sequence[AnyLink], settings: LinkSettings, rule: LinkSelection) -> AnyLink:
    """Return the link that a request uses. Raises `LinkDown` if ``links`` is empty; nothing was sent.

    Args:
        links: all links to the endpoint, in the order in which they were created.
        settings: settings of the calling link; only the endpoint is used, for the error.
        rule: chooses among the connected links: the one created first, or the one whose connection has been open
            longest. If none is connected, the link created first is returned; the request makes it connect.
    """
    if not links:
        raise LinkDown(
            "no link to it is open, so there is none to choose; nothing was sent",
            kind="closed",
            endpoint=settings.endpoint.url,
        )
    standing = [link for link in links if link.is_connected]
    if not standing:
        return links[0]
    return standing[0] if rule is LinkSelection.FIRST else min(standing, key=lambda link: link.opened)


def check_selected(settings: LinkSettings, options: Mapping[str, object], *, shared: bool) -> None:
    """Raise `ConfigError` if a link with ``select`` gets options of a connection, which would have no effect.

    ``options`` are those given by keyword; the options in the URL are in ``settings``. ``shared`` is False for a link
    that is to have a connection of its own.
    """
    context = () if settings.ssl_context is None else ("ssl_context",)
    own = () if shared else ("shared",)
    for name in (*settings.endpoint.options, *options, *context, *own):
        if name not in CALL_DEFAULTS:
            raise ConfigError(
                f"has no effect with select: the connection is another link's; only {', '.join(CALL_DEFAULTS)} may "
                "stand there",
                key=name,
            )


def no_connection_of_its_own(settings: LinkSettings) -> InvalidRequest:
    """Return the error for managing the connection of a link opened with ``select``, which has none of its own."""
    return InvalidRequest("a link opened with select has no connection of its own", endpoint=settings.endpoint.url)
