"""Options of Modbus/TCP Security: certificates, TLS versions, cipher suites and deadlines (port 802, ``tls://``).

Knows names and ranges; opens no file and no connection, and does not load ``ssl``, because every program imports this
file at its start.

1. A peer is verified, unless the user chooses `Verify.OFF_INSECURE` by name.
2. Only suites with ECDHE and AES-GCM can be chosen. A suite without encryption is used only if the user names it.
3. A password is never in a URL; ``password_file`` names the file that holds it.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar, Final

from ..errors import ConfigError
from .declaration import Mark, On, Range, Strict, check

SUITES: Final = (
    "ECDHE-ECDSA-AES128-GCM-SHA256",
    "ECDHE-RSA-AES128-GCM-SHA256",
    "ECDHE-ECDSA-AES256-GCM-SHA384",
    "ECDHE-RSA-AES256-GCM-SHA384",
)
"""The default cipher suites of TLS 1.2, the preferred first.

All suites of TLS 1.3 are allowed: they all have AEAD and forward secrecy.
"""
NULL_SUITES: Final = ("NULL-SHA256",)
"""Suites that authenticate but do not encrypt (TLS_RSA_WITH_NULL_SHA256); used only if they are named."""


class TlsVersion(Enum):
    """The TLS versions that may be used; older ones cannot be chosen."""

    TLS_1_2 = "1.2"
    TLS_1_3 = "1.3"


class Curve(Enum):
    """Elliptic curves that may be used for the key agreement of TLS."""

    P_256 = "P-256"
    ANY = "any"
    """All that OpenSSL has: X25519, P-256, X448, P-384, P-521 and finite fields."""


class Verify(Enum):
    """Whether and how a client verifies the certificate of the server."""

    ALWAYS = "always"
    OFF_INSECURE = "off-insecure"
    """Nothing is verified: any host on the way can pose as the server. Each connection logs a warning."""


@dataclass(frozen=True, slots=True)
class TlsParameters:
    """Options of a TLS connection or listener."""

    on: ClassVar[On] = On("tls")

    certificate: Annotated[
        str | None,
        Mark.FILE,
        "file with the own certificate in PEM, followed by those of the authorities between it and the root, which are",
        "sent along. A listener needs one; a client whose server asks for one, too.",
    ] = None
    key: Annotated[
        str | None, Mark.FILE, "file with its private key in PEM; None where it stands in the same file."
    ] = None
    password_file: Annotated[
        str | None, Mark.FILE, "file whose first line opens the key; None for a key that is not encrypted."
    ] = None
    authority: Annotated[
        str | None,
        Mark.FILE,
        "file with the certificates of the authorities that peers may come from, or a directory of such files.",
    ] = None
    minimum_version: Annotated[TlsVersion, "the oldest version that may be spoken."] = TlsVersion.TLS_1_2
    maximum_version: Annotated[TlsVersion, "the newest version that may be spoken."] = TlsVersion.TLS_1_3
    ciphers: Annotated[
        str | None,
        "suites of TLS 1.2, out of `SUITES` and `NULL_SUITES`, with commas between; None takes `SUITES`.",
    ] = None
    curve: Annotated[
        Curve,
        "`P-256` alone, or `any` that OpenSSL has. With TLS 1.2, EC keys of certificates are bound to it too.",
    ] = Curve.P_256
    revocation_list: Annotated[
        str | None,
        Mark.FILE,
        "file with the revocation lists (CRLs) in PEM of every authority that certificates of peers come from, up to",
        "the root; a peer whose certificate is revoked, or about which no valid list is there, is refused. None looks",
        "at none.",
    ] = None
    handshake_timeout: Annotated[
        float, Range(0.1, 600), "seconds from the connection until both sides have agreed."
    ] = 10.0
    require_role: Annotated[bool, On("server"), "a listener refuses clients whose certificate has no role."] = False
    require_purpose: Annotated[
        bool,
        On("server"),
        Strict("M3", True),
        "a listener refuses clients whose certificate does not say what it is for (extended key usage). One that says",
        "it is for something else is refused in any case.",
    ] = False
    max_handshakes: Annotated[
        int,
        Range(1, 10_000),
        On("server"),
        "clients of a listener whose handshake is not finished; the next one takes the place of the oldest of them.",
    ] = 64
    server_name: Annotated[
        str | None,
        On("client"),
        "the name (or address) that the server's certificate must have; None takes the host of the URL.",
    ] = None
    verify: Annotated[Verify, On("client"), "whether the server's certificate is verified."] = Verify.ALWAYS

    def __post_init__(self) -> None:
        check(self)
        if self.minimum_version.value > self.maximum_version.value:
            raise ConfigError(f"must not be above maximum_version, {self.maximum_version.value}", key="minimum_version")
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
        """The cipher suites of TLS 1.2 that may be used, by OpenSSL's names, the preferred first."""
        if self.ciphers is None:
            return SUITES
        return tuple(one.strip().upper() for one in self.ciphers.replace(":", ",").split(",") if one.strip())

    def check_server(self) -> None:
        """Raise `ConfigError` if ``certificate`` or ``authority`` is missing, which a TLS listener needs."""
        if self.certificate is None:
            raise ConfigError("a tls:// listener needs a certificate", key="certificate")
        if self.authority is None:
            raise ConfigError("a tls:// listener needs the authority that its clients come from", key="authority")

    def check_client(self) -> None:
        """Raise `ConfigError` if ``authority`` is missing, which a TLS client needs unless it verifies nothing."""
        if self.authority is None and self.verify is Verify.ALWAYS:
            raise ConfigError(
                "the authority that the server's certificate comes from is needed; "
                "verify=off-insecure believes any server",
                key="authority",
            )
