"""What can be set about Modbus/TCP Security: certificates, versions, suites, deadlines (port 802, ``tls://``).

Knows names and ranges; opens no file and no connection, and does not load ``ssl``: every start of a program sees this.

1. A peer is verified, unless `Verify.OFF_INSECURE` is asked for by that name.
2. Only suites with ECDHE and AES-GCM can be chosen. A suite without encryption must be named by itself.
3. A password never stands in a URL; ``password_file`` names the file that holds it.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from ...errors import ConfigError
from ...options.text import build_parameters

SUITES: Final = (
    "ECDHE-ECDSA-AES128-GCM-SHA256",
    "ECDHE-RSA-AES128-GCM-SHA256",
    "ECDHE-ECDSA-AES256-GCM-SHA384",
    "ECDHE-RSA-AES256-GCM-SHA384",
)
"""The suites of TLS 1.2, the preferred first. Those of TLS 1.3 all have AEAD and forward secrecy and are not chosen."""
NULL_SUITES: Final = ("NULL-SHA256",)
"""Authenticated and readable by everybody on the way (TLS_RSA_WITH_NULL_SHA256): only where they are named."""

OF_CLIENTS: Final = frozenset({"server_name", "verify"})
"""What has no effect with a listener."""
OF_SERVERS: Final = frozenset({"require_role", "require_purpose", "max_handshakes"})
"""What has no effect with a client."""


class TlsVersion(Enum):
    """A version that may be spoken; older ones do not exist here."""

    TLS_1_2 = "1.2"
    TLS_1_3 = "1.3"


class Curve(Enum):
    """The curve over which keys are agreed on."""

    P_256 = "P-256"
    ANY = "any"
    """Whatever OpenSSL offers: X25519, P-256, X448, P-384, P-521 and finite fields."""


class Verify(Enum):
    """Whether a client believes who the server says it is."""

    ALWAYS = "always"
    OFF_INSECURE = "off-insecure"
    """Anybody on the way can be the server. Each connection logs a warning."""


@dataclass(frozen=True, slots=True)
class TlsParameters:
    """Parameters of a secure connection or listener.

    Attributes:
        certificate: file with the own certificate in PEM, followed by those of the authorities between it and the
            root, which are sent along. A listener needs one; a client whose server asks for one, too.
        key: file with its private key in PEM; None where it stands in the same file.
        password_file: file whose first line opens the key; None for a key that is not encrypted.
        authority: file with the certificates of the authorities that peers may come from, or a directory of such files.
        minimum_version, maximum_version: 1.2 or 1.3.
        ciphers: suites of TLS 1.2, out of `SUITES` and `NULL_SUITES`, with commas between; None takes `SUITES`.
        curve: ``P-256`` alone, or ``any`` that OpenSSL has. With TLS 1.2, EC keys of certificates are bound to it too.
        revocation_list: file with the revocation lists (CRLs) in PEM of every authority that certificates of peers come
            from, up to the root; a peer whose certificate is revoked, or about which no valid list is there, is
            refused. None looks at none.
        handshake_timeout: seconds from the connection until both sides have agreed, 0.1…600.
        require_role: a listener refuses clients whose certificate has no role.
        require_purpose: a listener refuses clients whose certificate does not say what it is for (extended key usage).
            One that says it is for something else is refused in any case.
        max_handshakes: clients of a listener whose handshake is not finished, 1…10000; the next one takes the place of
            the oldest of them.
        server_name: the name (or address) that the server's certificate must have; None takes the host of the URL.
        verify: ``always``, or ``off-insecure``.
    """

    certificate: str | None = None
    key: str | None = None
    password_file: str | None = None
    authority: str | None = None
    minimum_version: TlsVersion = TlsVersion.TLS_1_2
    maximum_version: TlsVersion = TlsVersion.TLS_1_3
    ciphers: str | None = None
    curve: Curve = Curve.P_256
    revocation_list: str | None = None
    handshake_timeout: float = 10.0
    require_role: bool = False
    require_purpose: bool = False
    max_handshakes: int = 64
    server_name: str | None = None
    verify: Verify = Verify.ALWAYS

    def __post_init__(self) -> None:
        if self.minimum_version.value > self.maximum_version.value:
            raise ConfigError(f"must not be above maximum_version, {self.maximum_version.value}", key="minimum_version")
        if not 0.1 <= self.handshake_timeout <= 600:
            raise ConfigError(f"must be 0.1…600, not {self.handshake_timeout:g}", key="handshake_timeout")
        if not 1 <= self.max_handshakes <= 10_000:
            raise ConfigError(f"must be 1…10000, not {self.max_handshakes}", key="max_handshakes")
        if self.key is not None and self.certificate is None:
            raise ConfigError("there is a key, but no certificate", key="certificate")
        for name in self.suites:
            if name not in SUITES + NULL_SUITES:
                allowed = ", ".join(SUITES + NULL_SUITES)
                raise ConfigError(f"{name!r} is none of the suites {allowed}", key="ciphers")
        if not self.suites:
            raise ConfigError("at least one suite is needed", key="ciphers")

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites of TLS 1.2 that may be agreed on, by OpenSSL's names."""
        if self.ciphers is None:
            return SUITES
        return tuple(one.strip().upper() for one in self.ciphers.replace(":", ",").split(",") if one.strip())

    def check_server(self) -> None:
        """Raises `ConfigError` where a listener lacks something."""
        if self.certificate is None:
            raise ConfigError("a tls:// listener needs a certificate", key="certificate")
        if self.authority is None:
            raise ConfigError("a tls:// listener needs the authority that its clients come from", key="authority")

    def check_client(self) -> None:
        """Raises `ConfigError` where a client lacks something."""
        if self.authority is None and self.verify is Verify.ALWAYS:
            raise ConfigError(
                "the authority that the server's certificate comes from is needed; "
                "verify=off-insecure believes any server",
                key="authority",
            )


def tls_parameters(options: Mapping[str, object]) -> TlsParameters:
    """Parameters from options of a URL, or from keywords, where a file may be a path object. Raises `ConfigError`."""
    return build_parameters(
        TlsParameters,
        {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in options.items()},
    )
