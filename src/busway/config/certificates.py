"""The certificates of a listener as they hold in the end: its URL goes before its section, that before the rest."""

from ..options.server import ListenerParameters
from ..options.tls import TlsParameters
from ..server.listener import Listener
from ..server.listener_settings import listener_settings


def tls_of(listener: Listener) -> TlsParameters | None:
    """What a listener does about TLS; None where its carrier is another. Raises `ConfigError`."""
    return listener_settings(listener, limits=ListenerParameters()).tls


def try_certificates(listener: Listener) -> None:
    """Read the certificates of a listener, to see whether they can be used. Raises `ConfigError` with the file."""
    tls = tls_of(listener)
    if tls is not None:
        from ..transport.tls.context import server_context

        server_context(tls)
