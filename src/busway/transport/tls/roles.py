"""The role of a client, read from its certificate: one UTF-8 string in an extension (MODBUS/TCP Security).

Knows the extension and its encoding; does not know what a role permits.

1. The whole string is the role. If the value of the extension is not exactly one UTF8String, there is no role.
2. A certificate that has an extension twice is refused: which of them counts is undefined.
3. No role is None, never an empty text.
"""

from dataclasses import dataclass
from typing import Final

from ...errors import ConfigError, MissingExtra
from .failures import FailureKind, TlsFailure

ROLE_EXTENSION: Final = "1.3.6.1.4.1.50316.802.1"
_UTF8_STRING: Final = 0x0C
_LONG_LENGTH: Final = 0x80


@dataclass(frozen=True, slots=True)
class RoleReading:
    """Result of reading a certificate: the client's role, or why it has none.

    Attributes:
        role: the role; None without one.
        reason: what is wrong with the extension for roles; empty if it is valid or missing.
    """

    role: str | None = None
    reason: str = ""


def require_cryptography(purpose: str) -> None:
    """Raise `MissingExtra`, which names the extra to install, if the package ``cryptography`` is missing.

    ``purpose``: what the package is needed for, for the message.
    """
    try:
        import cryptography.x509  # noqa: F401
    except ImportError:
        raise MissingExtra("cryptography", "tls", purpose=purpose) from None


def role_of_certificate(certificate: bytes) -> RoleReading:
    """Return the role in a certificate in DER, or why it has none.

    Raises:
        TlsFailure: the certificate has an extension twice, or cannot be read.
    """
    from cryptography import x509

    try:
        extensions = x509.load_der_x509_certificate(certificate).extensions
    except x509.DuplicateExtension as error:
        if error.oid.dotted_string == ROLE_EXTENSION:
            raise TlsFailure(FailureKind.TWO_ROLES, "the client's certificate has two roles") from error
        number = error.oid.dotted_string
        sentence = f"the client's certificate has the extension {number} twice"
        raise TlsFailure(FailureKind.BAD_CERTIFICATE, sentence) from error
    except ValueError as error:
        sentence = f"the client's certificate cannot be read: {error}"
        raise TlsFailure(FailureKind.BAD_CERTIFICATE, sentence) from error
    for one in extensions:
        if one.oid.dotted_string == ROLE_EXTENSION and isinstance(one.value, x509.UnrecognizedExtension):
            return decode_role(one.value.value)
    return RoleReading()


def decode_role(value: bytes) -> RoleReading:
    """Return the role in the value of the certificate extension, or what is wrong with the value."""
    if len(value) < 2:
        return RoleReading(reason="the extension is empty")
    if value[0] != _UTF8_STRING:
        return RoleReading(reason=f"its ASN.1 type is 0x{value[0]:02X}, and not UTF8String")
    size, start = value[1], 2
    if size == _LONG_LENGTH + 1 and len(value) > 2 and value[2] >= _LONG_LENGTH:
        size, start = value[2], 3
    elif size == _LONG_LENGTH + 2 and len(value) > 3 and value[2]:
        size, start = int.from_bytes(value[2:4], "big"), 4
    elif size >= _LONG_LENGTH:
        return RoleReading(reason="its length is not in DER, or above 65535")
    if start + size != len(value):
        return RoleReading(reason=f"its length says {size} bytes, and there are {len(value) - start}")
    if not size:
        return RoleReading(reason="the text is empty")
    try:
        return RoleReading(value[start:].decode("utf-8"))
    except UnicodeDecodeError:
        return RoleReading(reason="the text is no UTF-8")


def encode_role(role: str) -> bytes:
    """Return a role as the value of the certificate extension. Raises `ConfigError` unless it has 1…65535 bytes."""
    text = role.encode("utf-8")
    if not 1 <= len(text) <= 0xFFFF:
        raise ConfigError("a role has 1…65535 bytes", key="role")
    if len(text) < _LONG_LENGTH:
        head = bytes([_UTF8_STRING, len(text)])
    elif len(text) <= 0xFF:
        head = bytes([_UTF8_STRING, _LONG_LENGTH + 1, len(text)])
    else:
        head = bytes([_UTF8_STRING, _LONG_LENGTH + 2]) + len(text).to_bytes(2, "big")
    return head + text
