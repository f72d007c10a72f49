"""Connections that a secure device must refuse: old TLS versions, weak suites, no client certificate, or a wrong one.

Knows sockets and TLS contexts; knows no request. If this machine's TLS library cannot make such a connection, or the
user has not given the certificate for it, `CannotOffer` is raised, and the check is undecided.
"""

import socket
import ssl
import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ...client.settings import LinkSettings
from ...errors import LinkDown, MissingExtra
from ...transport.local_end import connect_failure
from ...transport.tls.context import client_context
from .check import TlsChange

_VERSIONS: Final = {TlsChange.TLS_1_0: ssl.TLSVersion.TLSv1, TlsChange.TLS_1_1: ssl.TLSVersion.TLSv1_1}
_SUITES: Final = {
    TlsChange.SHA_1: "ECDHE-ECDSA-AES128-SHA:ECDHE-RSA-AES128-SHA:AES128-SHA:@SECLEVEL=0",
    TlsChange.NO_ENCRYPTION: "eNULL:@SECLEVEL=0",
}
_NOT_HERE: Final = frozenset(
    {"NO_PROTOCOLS_AVAILABLE", "NO_CIPHERS_AVAILABLE", "NO_CIPHER_MATCH", "UNSUPPORTED_PROTOCOL"}
)
CERTIFICATES: Final = {
    "expired": TlsChange.EXPIRED_CERTIFICATE,
    "revoked": TlsChange.REVOKED_CERTIFICATE,
    "denied": TlsChange.DENIED_ROLE,
    "no-role": TlsChange.NO_ROLE,
}
"""The changes of a handshake that need a certificate of the user, by the word that ``--certificates`` has for each."""
_ASKED_FOR: Final = {
    "expired": "a client certificate of the device's authority whose time is over",
    "revoked": "a client certificate that the device's revocation list names",
    "denied": "a client certificate with a role that may not read the item of --probe",
    "no-role": "a client certificate without a role, which may not read the item of --probe",
}


@dataclass(frozen=True, slots=True)
class ClientCertificate:
    """Paths of the PEM files of a client certificate that the user has given, and of its key."""

    certificate: str
    key: str


class CannotOffer(Exception):
    """Error: this machine cannot make the changed TLS handshake, or the certificate for it is missing or unsuitable."""


def changed_channel(
    settings: LinkSettings, change: TlsChange, given: Mapping[TlsChange, ClientCertificate]
) -> "socket.socket | ChangedChannel":
    """Connect to a device over TCP, and make a TLS handshake with one change.

    Args:
        settings: the settings of the link to the device.
        change: what is changed in the handshake.
        given: the client certificates that the user has given, by the change that they are for.

    Returns:
        The connection, whose socket does not block: a plain socket for `TlsChange.PLAIN`, otherwise one over TLS.

    Raises:
        LinkDown: the device cannot be reached, or refuses the handshake.
        CannotOffer: this machine cannot make the handshake, or the user's certificate for it is missing or unsuitable.
        ConfigError: a certificate or key cannot be read.
    """
    endpoint, limit = settings.endpoint, settings.sockets.connect_timeout
    own = settings.sockets.local_address
    context = None if change is TlsChange.PLAIN else _context(settings, change, given)
    try:
        plain = socket.create_connection((endpoint.host, endpoint.port or 0), limit, (own, 0) if own else None)
    except OSError as error:
        raise connect_failure(error, endpoint=endpoint.url, host=endpoint.host, local_address=own) from error
    if context is None:
        plain.setblocking(False)
        return plain
    assert settings.security is not None
    try:
        channel = context.wrap_socket(plain, server_hostname=settings.security.server_name or endpoint.host)
    except OSError as error:
        plain.close()
        if isinstance(error, ssl.SSLError) and error.reason in _NOT_HERE:
            raise CannotOffer(f"the TLS library of this machine offers no connection {change.value}") from error
        raise LinkDown(f"the handshake is refused: {error}", kind="tls", endpoint=endpoint.url) from error
    channel.setblocking(False)
    return ChangedChannel(channel)


def _context(settings: LinkSettings, change: TlsChange, given: Mapping[TlsChange, ClientCertificate]) -> ssl.SSLContext:
    assert settings.security is not None
    if change in CERTIFICATES.values():
        own = _given(change, given)
        return client_context(replace(settings.security, certificate=own.certificate, key=own.key, password_file=None))
    if change in (TlsChange.NO_CERTIFICATE, TlsChange.FOREIGN_CERTIFICATE):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        if change is TlsChange.FOREIGN_CERTIFICATE:
            _load_foreign(context)
        return context
    context = client_context(settings.security)
    try:
        if change in _VERSIONS:
            context.set_ciphers("ALL:@SECLEVEL=0")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # that it is old is what this is about
                context.minimum_version = context.maximum_version = _VERSIONS[change]
        else:
            context.maximum_version = ssl.TLSVersion.TLSv1_2
            context.set_ciphers(_SUITES[change])
    except (ssl.SSLError, ValueError) as error:
        raise CannotOffer(f"the TLS library of this machine offers no connection {change.value}: {error}") from error
    return context


def _given(change: TlsChange, given: Mapping[TlsChange, ClientCertificate]) -> ClientCertificate:
    """Return the client certificate that the user has given for a changed handshake.

    Raises:
        CannotOffer: the user has given none; it is expired where another fault is tested, or not expired where that is
            tested; it has a role where a missing role is tested; or the package that reads certificates is not
            installed. Whether it is revoked, or its role is denied, is not checked.
        ConfigError: the file of the certificate cannot be read.
    """
    word = next(word for word, one in CERTIFICATES.items() if one is change)
    if change not in given:
        raise CannotOffer(f"it needs {_ASKED_FOR[word]}: --certificates {word}=CERTIFICATE:KEY")
    own = given[change]
    try:
        from ...transport.tls.certificates.facts import facts_of_file

        facts = facts_of_file(own.certificate)[0]
    except MissingExtra as error:
        raise CannotOffer(f"it needs to be known what {own.certificate} says: {error}") from error
    is_over = facts.not_after < time.time()
    if is_over != (change is TlsChange.EXPIRED_CERTIFICATE):
        raise CannotOffer(
            f"{own.certificate} is {'expired' if is_over else 'not expired'}; it needs {_ASKED_FOR[word]}"
        )
    if change is TlsChange.NO_ROLE and facts.role:
        raise CannotOffer(f"{own.certificate} has the role {facts.role}; it needs {_ASKED_FOR[word]}")
    return own


def _load_foreign(context: ssl.SSLContext) -> None:
    """Load a new client certificate into a TLS context, of a new authority that the device does not know.

    Raises:
        CannotOffer: the package that creates certificates is not installed.
    """
    try:
        from ...transport.tls.certificates.authority import Authority

        issued = Authority.create("busway check").client("busway check")
    except (ImportError, MissingExtra) as error:
        raise CannotOffer(f"a foreign certificate cannot be made: {error}") from error
    with tempfile.TemporaryDirectory() as folder:
        certificate, key = Path(folder) / "certificate.pem", Path(folder) / "key.pem"
        issued.write(certificate, key)
        context.load_cert_chain(certificate, key)


class ChangedChannel:
    """A TLS connection with a non-blocking socket, wrapped to behave like a plain non-blocking socket."""

    def __init__(self, channel: ssl.SSLSocket) -> None:
        self._channel = channel

    def fileno(self) -> int:
        """Return the file descriptor of the socket."""
        return self._channel.fileno()

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes into a buffer and return their number; 0 at the end of the connection.

        Raises:
            BlockingIOError: no bytes have come yet.
        """
        try:
            return self._channel.recv_into(buffer)
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError) as error:
            raise BlockingIOError from error

    def send(self, data: bytes, /) -> int:
        """Send bytes and return how many of them the socket has taken.

        Raises:
            BlockingIOError: the socket takes no bytes now.
        """
        try:
            return self._channel.send(data)
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError) as error:
            raise BlockingIOError from error

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()
