"""A listener as it is declared: an endpoint to listen on, with options that hold for it alone.

Knows the names of the settings; their meaning is defined with their classes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..access.addresses import HostAuthorizer
from ..errors import ConfigError
from ..options.endpoints import Endpoint
from ..options.server import ListenerParameters

if TYPE_CHECKING:
    from ..options.tls import TlsParameters


@dataclass(frozen=True, slots=True)
class Listener:
    """An endpoint to listen on, with its own limits, address lists or TLS options where they differ from the server's.

    Attributes:
        endpoint: URL.
        access: called with the host of each new connection; a host may connect only if this and the server's own
            ``authorize`` return True. None adds no check.
        tls: certificate, key and authorities of a ``tls://`` listener; None for those of the server. Options in the URL
            override them, one by one.
        limits: limits of its connections; None for those of the server.
    """

    endpoint: str | Endpoint
    access: HostAuthorizer | None = None
    tls: "TlsParameters | None" = None
    limits: ListenerParameters | None = None


def as_listeners(wanted: Sequence[str | Endpoint | Listener]) -> list[Listener]:
    """Turn URLs and `Listener` objects into a list of `Listener` objects. Raises `ConfigError` if it is empty."""
    if not wanted:
        raise ConfigError("at least one endpoint to listen on is needed", key="endpoints")
    return [one if isinstance(one, Listener) else Listener(one) for one in wanted]
