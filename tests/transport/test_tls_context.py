"""Contexts: what is wrong with a file is said with its name, and files that change are read again."""

import logging
import os
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest

from busway.errors import ConfigError
from busway.testing.certificates import CertificateFiles, CertificateStore
from busway.testing.clock import FakeClock
from busway.transport.tls import SUITES, TlsParameters, TlsVersion, Verify, tls_parameters
from busway.transport.tls_context import WatchedContext, client_context, server_context


@pytest.fixture
def store(tmp_path: Path) -> CertificateStore:
    return CertificateStore(tmp_path)


@pytest.fixture
def files(store: CertificateStore) -> CertificateFiles:
    return store.server()


def refusal(parameters: TlsParameters) -> str:
    with pytest.raises(ConfigError) as caught:
        server_context(parameters)
    return str(caught.value)


@pytest.mark.clause("M2")
def test_a_context_allows_the_versions_and_suites_of_the_clause_only(files: CertificateFiles) -> None:
    for context in (
        server_context(TlsParameters(**files.options())),
        client_context(TlsParameters(**files.options())),
    ):
        assert context.minimum_version is ssl.TLSVersion.TLSv1_2
        assert context.maximum_version is ssl.TLSVersion.TLSv1_3
        names = {suite["name"] for suite in context.get_ciphers()}
        assert {name for name in names if not name.startswith("TLS_")} == set(SUITES)
        assert all("GCM" in name or "POLY1305" in name for name in names)
        assert context.options & ssl.OP_NO_COMPRESSION
        assert context.options & ssl.OP_NO_RENEGOTIATION
        assert context.verify_mode is ssl.CERT_REQUIRED


@pytest.mark.clause("M2")
def test_a_suite_without_encryption_has_to_be_named_and_is_warned_of(
    files: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    server_context(TlsParameters(**files.options()))
    assert caplog.text == ""
    context = server_context(TlsParameters(**files.options(), ciphers="NULL-SHA256"))
    assert "NULL-SHA256" in {suite["name"] for suite in context.get_ciphers()}
    assert "can be read by everybody" in caplog.text


@pytest.mark.parametrize("ciphers", ["DES-CBC3-SHA", "RC4-MD5", "ECDHE-RSA-AES128-SHA", "ALL", "AES128-GCM-SHA256"])
@pytest.mark.clause("M2")
def test_other_suites_can_not_be_chosen(ciphers: str) -> None:
    with pytest.raises(ConfigError, match="is none of the suites"):
        TlsParameters(ciphers=ciphers)


def test_suites_can_be_chosen_in_their_order() -> None:
    chosen = TlsParameters(ciphers="ECDHE-RSA-AES256-GCM-SHA384, ecdhe-rsa-aes128-gcm-sha256")
    assert chosen.suites == ("ECDHE-RSA-AES256-GCM-SHA384", "ECDHE-RSA-AES128-GCM-SHA256")


def test_a_client_verifies_unless_it_is_told_not_to(files: CertificateFiles) -> None:
    context = client_context(TlsParameters(**files.options()))
    assert context.check_hostname
    context = client_context(TlsParameters(verify=Verify.OFF_INSECURE))
    assert context.verify_mode is ssl.CERT_NONE


def test_paths_may_be_path_objects(files: CertificateFiles) -> None:
    chosen = tls_parameters({"certificate": files.certificate, "key": files.key, "minimum_version": "1.3"})
    assert chosen.certificate == str(files.certificate)
    assert chosen.minimum_version is TlsVersion.TLS_1_3


Damage = Callable[[CertificateFiles, CertificateStore], TlsParameters]


def _with(files: CertificateFiles, **changed: str) -> TlsParameters:
    return tls_parameters({**files.options(), **changed})


def _written(files: CertificateFiles, name: str, data: bytes) -> str:
    path = files.certificate.parent / name
    path.write_bytes(data)
    return str(path)


DAMAGES: dict[str, tuple[Damage, str]] = {
    "no certificate file": (
        lambda files, store: _with(files, certificate="/missing.pem"),
        "/missing.pem: certificate: can not be read: no such file or directory",
    ),
    "no key file": (
        lambda files, store: _with(files, key="/missing.key"),
        "/missing.key: key: can not be read: no such file or directory",
    ),
    "no authority": (
        lambda files, store: _with(files, authority="/missing"),
        "/missing: authority: can not be read: no such file or directory",
    ),
    "key for certificate": (
        lambda files, store: _with(files, certificate=str(files.key)),
        "server.key: certificate: there is no certificate in it (a PEM file is needed)",
    ),
    "certificate for key": (
        lambda files, store: _with(files, key=str(files.certificate)),
        "server.pem: key: there is no private key in it (a PEM file is needed)",
    ),
    "DER": (
        lambda files, store: _with(files, authority=_written(files, "ca.der", b"\x30\x82\x01\x00")),
        "ca.der: authority: there is no certificate in it (a PEM file is needed)",
    ),
    "another's key": (
        lambda files, store: _with(files, key=str(store.client().key)),
        "client.key: key: the key does not belong to the certificate",
    ),
    "damaged certificate": (
        lambda files, store: _with(
            files, certificate=_written(files, "bad.pem", files.certificate.read_bytes().replace(b"M", b"N", 3))
        ),
        "bad.pem: certificate: certificate and key can not be used: ",
    ),
    "damaged authority": (
        lambda files, store: _with(
            files, authority=_written(files, "bad-ca.pem", files.authority.read_bytes().replace(b"M", b"N", 3))
        ),
        "bad-ca.pem: authority: the certificates can not be read: ",
    ),
    "encrypted key": (
        lambda files, store: _with(files, key=_written(files, "locked.key", files.issued.key_pem(b"secret"))),
        "locked.key: password_file: the key is encrypted: name the file with its password",
    ),
    "wrong password": (
        lambda files, store: _with(
            files,
            key=_written(files, "locked.key", files.issued.key_pem(b"secret")),
            password_file=_written(files, "password", b"guess\n"),
        ),
        "password does not open the key",
    ),
    "empty directory": (
        lambda files, store: _with(files, authority=str(_empty(files.certificate.parent / "authorities"))),
        "authorities: authority: there is no file *.pem, *.crt, *.cer, *.ca in it",
    ),
}


def _empty(directory: Path) -> Path:
    directory.mkdir()
    return directory


@pytest.mark.parametrize("case", DAMAGES)
def test_what_is_wrong_with_a_file_is_said_with_its_name(
    store: CertificateStore, files: CertificateFiles, case: str
) -> None:
    damage, sentence = DAMAGES[case]
    assert sentence in refusal(damage(files, store))


def test_an_encrypted_key_is_opened_by_the_first_line_of_a_file(files: CertificateFiles) -> None:
    locked = _written(files, "locked.key", files.issued.key_pem(b"secret"))
    password = _written(files, "password", b"secret\r\nnot this\n")
    server_context(_with(files, key=locked, password_file=password))


def test_authorities_may_lie_in_a_directory(store: CertificateStore, files: CertificateFiles) -> None:
    directory = files.certificate.parent / "authorities"
    directory.mkdir()
    (directory / "one.pem").write_bytes(store.authority.issued.certificate_pem())
    (directory / "two.crt").write_bytes(store.foreign.issued.certificate_pem())
    (directory / "notes.txt").write_text("not read")
    context = server_context(_with(files, authority=str(directory)))
    assert context.cert_store_stats()["x509_ca"] == 2


# --- files that change ------------------------------------------------------------------------------------------------


def touched(path: Path, seconds: float) -> None:
    """Give a file another time, whatever the clock of the file system can tell apart."""
    os.utime(path, (path.stat().st_atime, path.stat().st_mtime + seconds))


def test_the_context_changes_with_its_files(store: CertificateStore, files: CertificateFiles) -> None:
    clock = FakeClock()
    watched = WatchedContext(TlsParameters(**files.options()), server_context, name="here", clock=clock.now)
    first = watched.current()
    clock.advance(1.0)
    assert watched.current() is first
    store.server("other").issued.write(files.certificate, files.key)
    touched(files.certificate, 5)
    assert watched.current() is first  # looked at less than a second ago
    clock.advance(1.0)
    second = watched.current()
    assert second is not first
    assert watched.generation == 1
    touched(files.authority, 5)
    clock.advance(1.0)
    assert watched.current() is not second


def test_files_that_can_not_be_used_are_said_once_and_the_old_context_stays(
    store: CertificateStore, files: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    clock = FakeClock()
    watched = WatchedContext(TlsParameters(**files.options()), server_context, name="here", clock=clock.now)
    first = watched.current()
    good = files.certificate.read_bytes()
    files.certificate.write_text("half of a")
    with caplog.at_level(logging.ERROR, "busway.tls"):
        for _ in range(3):
            clock.advance(1.0)
            assert watched.current() is first
    assert caplog.text.count("here: the certificates stay as they were: ") == 1
    assert "server.pem: certificate: there is no certificate in it" in caplog.text
    files.certificate.write_bytes(good)
    clock.advance(1.0)
    assert watched.current() is not first


def test_a_file_that_vanished_leaves_the_old_context(files: CertificateFiles) -> None:
    clock = FakeClock()
    watched = WatchedContext(TlsParameters(**files.options()), server_context, name="here", clock=clock.now)
    first = watched.current()
    files.authority.unlink()
    clock.advance(1.0)
    assert watched.current() is first
    with pytest.raises(ConfigError, match="can not be read"):
        watched.reload()
    assert watched.current() is first


def test_a_new_authority_in_a_directory_is_noticed(store: CertificateStore, files: CertificateFiles) -> None:
    directory = files.certificate.parent / "authorities"
    directory.mkdir()
    (directory / "one.pem").write_bytes(store.authority.issued.certificate_pem())
    clock = FakeClock()
    parameters = _with(files, authority=str(directory))
    watched = WatchedContext(parameters, server_context, name="here", clock=clock.now)
    (directory / "two.pem").write_bytes(store.foreign.issued.certificate_pem())
    clock.advance(1.0)
    assert watched.current().cert_store_stats()["x509_ca"] == 2
