"""What a certificate says (subject, names, role, validity), for a status, a log line, and ``busway certs show``.

Knows certificates; knows no connection.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ....errors import ConfigError
from ....values.printable import printable
from ..failures import TlsFailure, date_of
from ..roles import require_cryptography, role_of_certificate

if TYPE_CHECKING:
    from cryptography import x509

DAY: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class CertificateFacts:
    """What people need to know of a certificate: subject, names, role, validity.

    Attributes:
        subject, issuer: names, as ``CN=plc-7,O=Acme``.
        serial: serial number in hexadecimal.
        not_before, not_after: seconds since 1970 between which it is valid.
        names: host names and addresses that it is for.
        role: role of a client; None without one.
        role_problem: what is wrong with the role; empty otherwise. If the certificate has an extension twice, this says
            so, and ``names``, ``is_authority`` and ``states_purpose`` are empty or False.
        is_authority: whether it is allowed to sign other certificates.
        states_purpose: whether it has an extended key usage (for servers, for clients).
        key: kind and size of the key, as ``EC secp256r1``.
        fingerprint: SHA-256 in hexadecimal.
    """

    subject: str
    issuer: str
    serial: str
    not_before: float
    not_after: float
    names: tuple[str, ...]
    role: str | None
    role_problem: str
    is_authority: bool
    states_purpose: bool
    key: str
    fingerprint: str

    def days_left(self, now: float | None = None) -> float:
        """Return the days until the certificate expires; negative after that.

        ``now`` is in seconds since 1970; None for the present time.
        """
        return (self.not_after - (time.time() if now is None else now)) / DAY

    def validity(self, now: float | None = None) -> str:
        """Return a warning if the certificate is not valid yet, has expired or expires within 30 days; else empty.

        It is a text such as ``has expired on 2027-03-01 12:00 UTC``. ``now`` is as for `days_left`.
        """
        moment = time.time() if now is None else now
        if moment < self.not_before:
            return f"is not valid before {date_of(self.not_before)}"
        if moment > self.not_after:
            return f"has expired on {date_of(self.not_after)}"
        days = self.days_left(moment)
        if days <= WARNING_DAYS:
            return f"expires on {date_of(self.not_after)}, in {days:.0f} days"
        return ""


WARNING_DAYS: Final = 30.0
"""A certificate that expires within so many days gets a warning (`CertificateFacts.validity`)."""


def facts_of_file(name: str) -> list[CertificateFacts]:
    """Return the facts of each certificate in a PEM file, in order.

    Raises:
        ConfigError: the file cannot be read, or has no certificate or a broken one; the error names the file. Or the
            package ``cryptography`` is missing.
    """
    require_cryptography("reading certificates")
    from cryptography import x509

    try:
        data = Path(name).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"cannot be read: {reason[:1].lower()}{reason[1:]}", file=name) from error
    if b"-----BEGIN CERTIFICATE-----" not in data:
        raise ConfigError("there is no certificate in it (a PEM file is needed)", file=name)
    try:
        return [_facts(one) for one in x509.load_pem_x509_certificates(data)]
    except ValueError as error:
        raise ConfigError(f"a certificate in it cannot be read: {error}", file=name) from error


def facts_of_der(data: bytes) -> CertificateFacts:
    """Return the facts of a certificate in DER. Raises `ValueError` if the bytes are no certificate."""
    from cryptography import x509

    return _facts(x509.load_der_x509_certificate(data))


def _facts(certificate: "x509.Certificate") -> CertificateFacts:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.serialization import Encoding

    role, problem = None, ""
    names: tuple[str, ...] = ()
    is_authority = states_purpose = False
    try:
        reading = role_of_certificate(certificate.public_bytes(Encoding.DER))
        role, problem = reading.role, reading.reason
    except TlsFailure as failure:
        problem = str(failure)
    else:
        for one in certificate.extensions:
            if isinstance(one.value, x509.SubjectAlternativeName):
                names = tuple(printable(str(name.value)) for name in one.value)
            elif isinstance(one.value, x509.BasicConstraints):
                is_authority = one.value.ca
            elif isinstance(one.value, x509.ExtendedKeyUsage):
                states_purpose = True
    return CertificateFacts(
        subject=printable(certificate.subject.rfc4514_string()),
        issuer=printable(certificate.issuer.rfc4514_string()),
        serial=f"{certificate.serial_number:x}",
        not_before=certificate.not_valid_before_utc.timestamp(),
        not_after=certificate.not_valid_after_utc.timestamp(),
        names=names,
        role=role,
        role_problem=problem,
        is_authority=is_authority,
        states_purpose=states_purpose,
        key=_key_words(certificate),
        fingerprint=certificate.fingerprint(hashes.SHA256()).hex(),
    )


def _key_words(certificate: "x509.Certificate") -> str:
    from cryptography.hazmat.primitives.asymmetric import ec, rsa

    key = certificate.public_key()
    if isinstance(key, ec.EllipticCurvePublicKey):
        return f"EC {key.curve.name}"
    if isinstance(key, rsa.RSAPublicKey):
        return f"RSA {key.key_size}"
    return type(key).__name__.strip("_").removesuffix("PublicKey")
