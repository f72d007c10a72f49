"""The certificates of a listener: whether they can be used.

Knows how they are loaded. Which of two sources of an option counts is decided in `busway.server.listener_settings`.
"""

from ..options.server import ListenerParameters
from ..options.tls import TlsParameters
from ..server.listener import Listener
from ..server.listener_settings import listener_settings


def tls_of(listener: Listener) -> TlsParameters | None:
    """Return the TLS options of a listener: those of its `TlsParameters`, overridden by those of its URL.

    None for a listener without TLS.

    Raises:
        ConfigError: the URL or an option is invalid, or the certificate is missing.
    """
    return listener_settings(listener, limits=ListenerParameters()).tls


def try_certificates(listener: Listener) -> None:
    """Load the certificates of a listener to check that they can be used; does nothing without TLS.

    Raises:
        ConfigError: an option is invalid, the certificate or the authority is missing, or a file cannot be used; the
            error names the option, and the file if there is one.
    """
    tls = tls_of(listener)
    if tls is not None:
        from ..transport.tls.context import server_context

        server_context(tls)
