"""A certificate authority for tests and trials: issues certificates with EC keys on P-256 and SHA-256.

Knows how such certificates look; not meant for real installations, which have an authority of their own.

1. Certificates of servers are for servers, those of clients for clients (extended key usage).
2. A role is in the extension that MODBUS/TCP Security names.
3. A private key is written so that only its owner can read it.
"""

import datetime
import ipaddress
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ....errors import ConfigError
from ..roles import ROLE_EXTENSION, encode_role, require_cryptography

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

_BACKDATED: Final = datetime.timedelta(minutes=5)
"""How long before its creation a new certificate is valid already, so that devices whose clocks are slow accept it."""
KEY_MODE: Final = 0o600


@dataclass(frozen=True, slots=True)
class Issued:
    """An issued certificate with its private key.

    Attributes:
        certificate, key: objects of the package ``cryptography``.
        chain: the authorities between the certificate and the root, the nearest first.
    """

    certificate: "x509.Certificate"
    key: "EllipticCurvePrivateKey"
    chain: "tuple[x509.Certificate, ...]" = ()

    def certificate_pem(self) -> bytes:
        """Return the certificate in PEM, followed by those of the authorities between it and the root."""
        from cryptography.hazmat.primitives.serialization import Encoding

        return b"".join(one.public_bytes(Encoding.PEM) for one in (self.certificate, *self.chain))

    def key_pem(self, password: bytes | None = None) -> bytes:
        """Return the private key in PEM (PKCS 8), encrypted if there is a password."""
        from cryptography.hazmat.primitives import serialization

        encryption = (
            serialization.NoEncryption() if password is None else serialization.BestAvailableEncryption(password)
        )
        return self.key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)

    def write(self, certificate: Path, key: Path, *, password: bytes | None = None) -> None:
        """Write certificate (with ``chain``) and key to files, replacing old ones; only the owner can read the key.

        Raises:
            ConfigError: a file cannot be written.
        """
        write_private(key, self.key_pem(password))
        try:
            certificate.write_bytes(self.certificate_pem())
        except OSError as error:
            raise _unwritable(certificate, error) from error


class Authority:
    """A certificate authority: a certificate and the private key that signs others.

    Args:
        issued: its own certificate and key.
    """

    def __init__(self, issued: Issued) -> None:
        self.issued = issued

    @classmethod
    def create(cls, name: str = "busway test authority", *, days: float = 3650.0) -> "Authority":
        """Return a new self-signed authority whose certificate expires ``days`` days from now.

        Raises `ConfigError` if the package ``cryptography`` is missing, or the name has not 1…64 characters.
        """
        require_cryptography("making certificates")
        return cls(_build(name, None, days=days, extensions=_authority_extensions(None)))

    def intermediate(self, name: str, *, days: float = 3650.0) -> "Authority":
        """Return a new intermediate authority, whose certificate this one signs; it can sign no further authorities.

        Arguments and errors are those of `create`.
        """
        return Authority(_build(name, self.issued, days=days, extensions=_authority_extensions(0)))

    def server(
        self, hosts: Sequence[str], *, name: str | None = None, days: float = 825.0, starts_in: float = 0.0
    ) -> Issued:
        """Issue a certificate for a server with these host names and addresses.

        Args:
            hosts: host names and IP addresses of the server, at least one.
            name: its name in the certificate, 1…64 characters; None: the first of ``hosts``.
            days, starts_in: as for `client`.

        Raises:
            ConfigError: there is no host, an element is no host name or address, the name is too long, or the
                certificate would expire before it becomes valid.
        """
        from cryptography import x509
        from cryptography.x509.oid import ExtendedKeyUsageOID

        if not hosts:
            raise ConfigError("a server's certificate needs at least one host", key="host")
        extensions: list[x509.ExtensionType] = [
            x509.SubjectAlternativeName([_host_name(one) for one in hosts]),
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]),
        ]
        subject = hosts[0] if name is None else name
        return _build(subject, self.issued, days=days, starts_in=starts_in, extensions=extensions)

    def client(self, name: str, *, role: str | None = None, days: float = 825.0, starts_in: float = 0.0) -> Issued:
        """Issue a certificate for a client.

        Args:
            name: the name of the client in the certificate, 1…64 characters.
            role: its role (Modbus/TCP Security); None for none.
            days: the certificate expires so many days from now; negative: it has expired already.
            starts_in: days until the certificate becomes valid; 0 or negative: it is valid now.

        Raises:
            ConfigError: name or role has a wrong length, or the certificate would expire before it becomes valid.
        """
        return self.client_with(name, [] if role is None else [encode_role(role)], days=days, starts_in=starts_in)

    def client_with(
        self,
        name: str,
        role_values: Sequence[bytes],
        *,
        days: float = 825.0,
        starts_in: float = 0.0,
        more: Mapping[str, bytes] | None = None,
        states_purpose: bool = True,
    ) -> Issued:
        """Issue a certificate for a client with arbitrary bytes in its role extension, to test how they are refused.

        Args:
            name: the name of the client in the certificate.
            role_values: the values of the role extension, one for each time that it occurs.
            days, starts_in: as for `client`.
            more: values of further extensions, by object identifier (``1.2.3``).
            states_purpose: whether the certificate has the extended key usage for clients.

        Raises:
            ConfigError: the name has a wrong length, or the certificate would expire before it becomes valid.
        """
        from cryptography import x509
        from cryptography.x509.oid import ExtendedKeyUsageOID

        extensions: list[x509.ExtensionType] = []
        if states_purpose:
            extensions.append(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]))
        raw = [(ROLE_EXTENSION, one) for one in role_values] + list((more or {}).items())
        extensions += [x509.UnrecognizedExtension(x509.ObjectIdentifier(number), one) for number, one in raw]
        return _build(name, self.issued, days=days, starts_in=starts_in, extensions=extensions)

    def revocation_list(self, serials: Sequence[int], *, days: float) -> bytes:
        """Return a new revocation list in PEM with these serial numbers; it expires ``days`` days from now.

        Negative ``days`` give an expired list.
        """
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.serialization import Encoding

        now = datetime.datetime.now(datetime.UTC)
        ends = now + datetime.timedelta(days=days)
        begins = min(now - _BACKDATED, ends - _BACKDATED)
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(self.issued.certificate.subject)
            .last_update(begins)
            .next_update(ends)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self.issued.key.public_key()), critical=False
            )
        )
        for serial in serials:
            one = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(begins).build()
            builder = builder.add_revoked_certificate(one)
        return builder.sign(self.issued.key, hashes.SHA256()).public_bytes(Encoding.PEM)

    @staticmethod
    def self_signed(name: str, hosts: Sequence[str], *, days: float = 825.0) -> Issued:
        """Issue a self-signed certificate that is no authority, for servers and clients; it expires in ``days`` days.

        ``name`` is its name, ``hosts`` the host names and addresses that it is for, possibly none. Raises `ConfigError`
        if the name has not 1…64 characters, a host is no host name or address, or ``cryptography`` is missing.
        """
        from cryptography import x509

        require_cryptography("making certificates")
        return _build(name, None, days=days, extensions=[x509.SubjectAlternativeName([_host_name(h) for h in hosts])])


def _build(
    name: str,
    issuer: Issued | None,
    *,
    days: float,
    starts_in: float = 0.0,
    extensions: "Sequence[x509.ExtensionType]",
) -> Issued:
    """Create a key and its certificate, signed with the issuer's key, or with the new key if ``issuer`` is None.

    It becomes valid ``starts_in`` days from now (0: it is valid now), and expires ``days`` days from now (negative: it
    has expired already). Raises `ConfigError` if it would expire before it becomes valid, or the name is no valid one.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    if not 1 <= len(name) <= 64:
        raise ConfigError(f"a name in a certificate has 1…64 characters, not {len(name)}", key="name")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    not_after = now + datetime.timedelta(days=days)
    not_before = min(now - _BACKDATED, not_after - _BACKDATED) + datetime.timedelta(days=starts_in)
    if not_before > not_after:
        raise ConfigError(f"a certificate that expires in {days:g} days cannot begin later", key="starts_in")
    signer = key if issuer is None else issuer.key
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.certificate.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(not_before)
        .not_valid_after(not_after)
    )
    is_authority = any(isinstance(one, x509.BasicConstraints) for one in extensions)
    if not is_authority:
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(_key_usage(signs=False), critical=True)
    for one in extensions:
        builder = builder.add_extension(one, critical=isinstance(one, x509.BasicConstraints | x509.KeyUsage))
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
    )
    chain: tuple[x509.Certificate, ...] = ()
    if issuer is not None and issuer.certificate.subject != issuer.certificate.issuer:
        chain = (issuer.certificate, *issuer.chain)
    return Issued(builder.sign(signer, hashes.SHA256()), key, chain)


def _authority_extensions(path_length: int | None) -> "list[x509.ExtensionType]":
    from cryptography import x509

    return [x509.BasicConstraints(ca=True, path_length=path_length), _key_usage(signs=True)]


def _key_usage(*, signs: bool) -> "x509.KeyUsage":
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _host_name(host: str) -> "x509.GeneralName":
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError:
        raise ConfigError(f"{host!r} is no host name or address", key="host") from None


def write_private(path: Path, data: bytes) -> None:
    """Write or replace a file that only its owner can read. Raises `ConfigError` if that fails."""
    try:
        path.unlink(missing_ok=True)  # an old file would keep its mode, and its readers
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, KEY_MODE)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> ConfigError:
    reason = error.strerror or str(error)
    return ConfigError(f"cannot be written: {reason[:1].lower()}{reason[1:]}", file=str(path))
