"""The role in a certificate: one UTF8String and nothing else."""

from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import Encoding
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import ConfigError
from busway.testing.certificates import CertificateStore
from busway.transport.tls.failures import FailureKind, TlsFailure
from busway.transport.tls.roles import RoleReading, decode_role, encode_role, role_of_certificate


@pytest.mark.clause("M5")
@given(st.text(min_size=1, max_size=300))
def test_what_is_encoded_is_decoded_whole(role: str) -> None:
    assert decode_role(encode_role(role)) == RoleReading(role)


@pytest.mark.clause("M5")
@pytest.mark.parametrize("size", [1, 127, 128, 255, 256, 65535])
def test_every_form_of_the_length_is_read(size: int) -> None:
    assert decode_role(encode_role("r" * size)) == RoleReading("r" * size)


@pytest.mark.clause("M5")
@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("", "the extension is empty"),
        ("0c", "the extension is empty"),
        ("0c 00", "the text is empty"),
        ("13 01 61", "its ASN.1 type is 0x13, and not UTF8String"),  # PrintableString
        ("04 03 0c 01 61", "its ASN.1 type is 0x04, and not UTF8String"),  # wrapped once more
        ("30 03 0c 01 61", "its ASN.1 type is 0x30, and not UTF8String"),  # a list of one
        ("0c 01 61 62", "its length says 1 bytes, and there are 2"),
        ("0c 02 61", "its length says 2 bytes, and there are 1"),
        ("0c 01 61 0c 01 62", "its length says 1 bytes, and there are 4"),  # two strings
        ("0c 81 01 61", "its length is not in DER, or above 65535"),  # one byte would do
        ("0c 82 00 80 61", "its length is not in DER, or above 65535"),
        ("0c 80 61 00 00", "its length is not in DER, or above 65535"),  # of indefinite length
        ("0c 83 01 00 00 61", "its length is not in DER, or above 65535"),
        ("0c 02 c3 28", "the text is no UTF-8"),
        ("0c 03 ed a0 80", "the text is no UTF-8"),  # half of a surrogate pair
        ("2c 03 0c 01 61", "its ASN.1 type is 0x2C, and not UTF8String"),  # in pieces
    ],
)
def test_anything_else_is_no_role_and_says_why(value: str, reason: str) -> None:
    assert decode_role(bytes.fromhex(value)) == RoleReading(None, reason)


@pytest.mark.clause("M5")
@given(st.binary(max_size=20))
def test_no_bytes_raise_and_what_is_a_role_is_encoded_so(value: bytes) -> None:
    reading = decode_role(value)
    assert (reading.role is None) == bool(reading.reason)
    if reading.role is not None:
        assert encode_role(reading.role) == value


@pytest.mark.parametrize("role", ["", "r" * 65536])
def test_a_role_that_cannot_be_is_not_encoded(role: str) -> None:
    with pytest.raises(ConfigError, match=r"a role has 1…65535 bytes"):
        encode_role(role)


@pytest.mark.clause("M5")
def test_the_role_of_a_certificate_is_found_and_absent_is_none(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    with_role = store.client(role="Üser").issued.certificate
    without = store.client("plain").issued.certificate
    assert role_of_certificate(with_role.public_bytes(Encoding.DER)) == RoleReading("Üser")
    assert role_of_certificate(without.public_bytes(Encoding.DER)) == RoleReading()


@pytest.mark.clause("M5")
def test_two_roles_are_refused_even_if_they_are_the_same(tmp_path: Path) -> None:
    two = CertificateStore(tmp_path).client_with_two_roles(encode_role("a"), encode_role("a")).issued.certificate
    with pytest.raises(TlsFailure, match="has two roles") as caught:
        role_of_certificate(two.public_bytes(Encoding.DER))
    assert caught.value.kind is FailureKind.TWO_ROLES


def test_what_is_no_certificate_is_refused() -> None:
    with pytest.raises(TlsFailure, match="cannot be read") as caught:
        role_of_certificate(b"nothing")
    assert caught.value.kind is FailureKind.BAD_CERTIFICATE
