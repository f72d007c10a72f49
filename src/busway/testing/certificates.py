"""Certificates for tests: valid ones, and one of each kind that a peer must refuse.

Knows what can be wrong with a certificate; knows no connection. Needs the package ``cryptography``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ..transport.tls.certificates.authority import Authority, Issued
from ..transport.tls.roles import ROLE_EXTENSION

HOSTS: Final = ("localhost", "127.0.0.1", "::1")
"""Names and addresses of this machine, for which server certificates are valid by default."""
_EXPIRED_DAYS: Final = -1.0
_STAND_IN: Final = "1.3.6.1.4.1.50316.802.2"
"""Object identifier as long as that of the role extension, which replaces it in the finished certificate."""


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """Paths of the files of one certificate: certificate, key and authority.

    Attributes:
        certificate, key: paths of the certificate and its private key.
        authority: path of the authority that the holder of the certificate trusts.
        issued: the certificate itself.
    """

    certificate: Path
    key: Path
    authority: Path
    issued: Issued

    def options(self) -> dict[str, str]:
        """Return the files as keywords or URL options of a link or server: ``certificate``, ``key``, ``authority``."""
        return {"certificate": str(self.certificate), "key": str(self.key), "authority": str(self.authority)}

    def query(self) -> str:
        """Return the files as the query of a URL, to be put after ``?``: ``certificate=…&key=…&authority=…``."""
        return "&".join(f"{name}={value}" for name, value in self.options().items())


class CertificateStore:
    """A directory with a trusted and an untrusted authority, and certificates that they sign.

    Args:
        directory: an existing directory, where the files are written.

    Attributes:
        directory: as given.
        authority: the authority that all programs trust.
        foreign: the authority that no program trusts.
        authority_file: path of the certificate of ``authority``.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.authority: Authority = Authority.create("test authority")
        self.foreign: Authority = Authority.create("foreign authority")
        self.authority_file: Path = directory / "ca.pem"
        self.authority_file.write_bytes(self.authority.issued.certificate_pem())

    def server(
        self,
        name: str = "server",
        *,
        hosts: Sequence[str] = HOSTS,
        days: float = 30.5,
        authority: Authority | None = None,
    ) -> CertificateFiles:
        """Create a server certificate and write its files.

        Args:
            name: name of the certificate and of its files.
            hosts: host names and addresses for which it is valid.
            days: days for which it is valid from now on; negative for an expired one.
            authority: the authority that signs it; the trusted one by default.
        """
        return self.write(name, (authority or self.authority).server(hosts, name=name, days=days))

    def client(
        self, name: str = "client", *, role: str | None = None, days: float = 30.5, authority: Authority | None = None
    ) -> CertificateFiles:
        """Create a client certificate and write its files.

        Args:
            name: name of the certificate and of its files.
            role: role that it carries; None for none.
            days: days for which it is valid from now on; negative for an expired one.
            authority: the authority that signs it; the trusted one by default.
        """
        return self.write(name, (authority or self.authority).client(name, role=role, days=days))

    def expired_server(self) -> CertificateFiles:
        """Create a server certificate that expired a day ago, and write its files."""
        return self.server("expired server", days=_EXPIRED_DAYS)

    def expired_client(self, *, role: str | None = None) -> CertificateFiles:
        """Create a client certificate that expired a day ago, and write its files."""
        return self.client("expired client", role=role, days=_EXPIRED_DAYS)

    def self_signed(self, name: str = "self-signed", *, hosts: Sequence[str] = HOSTS) -> CertificateFiles:
        """Create a self-signed certificate, valid for ``hosts``, and write its files."""
        return self.write(name, Authority.self_signed(name, hosts))

    def client_with_role_value(self, value: bytes, *, name: str = "odd role") -> CertificateFiles:
        """Create a client certificate whose role extension holds the raw bytes ``value``, and write its files."""
        return self.write(name, self.authority.client_with(name, [value]))

    def client_with_two_roles(self, first: bytes, second: bytes, *, name: str = "two roles") -> CertificateFiles:
        """Create a client certificate with two role extensions, which hold these raw bytes, and write its files."""
        return self.write(name, self._two_roles(name, first, second))

    def client_without_purpose(self, name: str = "any purpose") -> CertificateFiles:
        """Create a client certificate without extended key usage, and write its files."""
        return self.write(name, self.authority.client_with(name, [], states_purpose=False))

    def revocation_list(
        self,
        *revoked: CertificateFiles,
        authority: Authority | None = None,
        days: float = 30.5,
        name: str = "revoked",
    ) -> Path:
        """Create a file with the revocation list of an authority, and return its path.

        Args:
            revoked: the certificates on the list.
            authority: the authority that signs it; the trusted one by default.
            days: days for which it is valid from now on; negative for an expired list.
            name: the file is NAME.crl in the directory; an old one is replaced.
        """
        file = self.directory / f"{name}.crl"
        serials = [one.issued.certificate.serial_number for one in revoked]
        file.write_bytes((authority or self.authority).revocation_list(serials, days=days))
        return file

    def write(self, name: str, issued: Issued) -> CertificateFiles:
        """Write a certificate and its key as NAME.pem and NAME.key, and return their paths; a space becomes ``-``."""
        stem = name.replace(" ", "-")
        files = CertificateFiles(
            self.directory / f"{stem}.pem", self.directory / f"{stem}.key", self.authority_file, issued
        )
        issued.write(files.certificate, files.key)
        return files

    def _two_roles(self, name: str, first: bytes, second: bytes) -> Issued:
        """Issue a certificate with two role extensions, by changing one and signing it again: no library does this."""
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec

        made = self.authority.client_with(name, [first], more={_STAND_IN: second})
        number, stand_in = (_identifier(one) for one in (ROLE_EXTENSION, _STAND_IN))
        content = made.certificate.tbs_certificate_bytes
        assert content.count(stand_in) == 1
        content = content.replace(stand_in, number)
        signature = self.authority.issued.key.sign(content, ec.ECDSA(hashes.SHA256()))
        algorithm = bytes.fromhex("300A 0608 2A8648CE3D040302")  # ecdsa-with-SHA256
        whole = _tagged(0x30, content + algorithm + _tagged(0x03, b"\x00" + signature))
        return Issued(x509.load_der_x509_certificate(whole), made.key)


def _identifier(dotted: str) -> bytes:
    """Return an object identifier such as ``1.3.6.1`` encoded in DER."""
    first, second, *rest = (int(part) for part in dotted.split("."))
    content = bytes([first * 40 + second])
    for number in rest:
        digits = [number & 0x7F]
        while number := number >> 7:
            digits.append(number & 0x7F | 0x80)
        content += bytes(reversed(digits))
    return _tagged(0x06, content)


def _tagged(tag: int, content: bytes) -> bytes:
    """Return a value with its tag and length in DER."""
    size = len(content)
    if size < 0x80:
        return bytes([tag, size]) + content
    length = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes([tag, 0x80 | len(length)]) + length + content
