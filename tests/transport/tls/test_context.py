"""Contexts: what is wrong with a file is said with its name, and files that change are read again."""

import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tls_peers import OF_SSL, agreed

from busway.errors import ConfigError
from busway.options.text import build_parameters
from busway.options.tls import SUITES, Curve, TlsParameters, TlsVersion, Verify
from busway.testing.certificates import CertificateFiles, CertificateStore
from busway.transport.tls.context import client_context, server_context
from busway.transport.tls.failures import FailureKind


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
    assert "anyone on the way can read" in caplog.text


@pytest.mark.parametrize("ciphers", ["DES-CBC3-SHA", "RC4-MD5", "ECDHE-RSA-AES128-SHA", "ALL", "AES128-GCM-SHA256"])
@pytest.mark.clause("M2")
def test_other_suites_cannot_be_chosen(ciphers: str) -> None:
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
    chosen = build_parameters(
        TlsParameters, {"certificate": files.certificate, "key": files.key, "minimum_version": "1.3"}
    )
    assert chosen.certificate == str(files.certificate)
    assert chosen.minimum_version is TlsVersion.TLS_1_3


Damage = Callable[[CertificateFiles, CertificateStore], TlsParameters]


def _with(files: CertificateFiles, **changed: str) -> TlsParameters:
    return build_parameters(TlsParameters, {**files.options(), **changed})


def _written(files: CertificateFiles, name: str, data: bytes) -> str:
    path = files.certificate.parent / name
    path.write_bytes(data)
    return str(path)


DAMAGES: dict[str, tuple[Damage, str]] = {
    "no revocation list file": (
        lambda files, store: _with(files, revocation_list="/missing.crl"),
        "/missing.crl: revocation_list: cannot be read: no such file or directory",
    ),
    "a revocation list that is none": (
        lambda files, store: _with(files, revocation_list=str(files.key)),
        "server.key: revocation_list: there is no revocation list in it (a PEM file is needed)",
    ),
    "a certificate among revocation lists": (
        lambda files, store: _with(
            files,
            revocation_list=_written(
                files, "both.crl", store.revocation_list().read_bytes() + files.certificate.read_bytes()
            ),
        ),
        "both.crl: revocation_list: there is a certificate in it; it holds revocation lists alone",
    ),
    "a damaged revocation list": (
        lambda files, store: _with(
            files, revocation_list=_written(files, "odd.crl", b"-----BEGIN X509 CRL-----\nAAAA\n-----END X509 CRL-----")
        ),
        "odd.crl: revocation_list: the revocation lists cannot be read",
    ),
    "no certificate file": (
        lambda files, store: _with(files, certificate="/missing.pem"),
        "/missing.pem: certificate: cannot be read: no such file or directory",
    ),
    "no key file": (
        lambda files, store: _with(files, key="/missing.key"),
        "/missing.key: key: cannot be read: no such file or directory",
    ),
    "no authority": (
        lambda files, store: _with(files, authority="/missing"),
        "/missing: authority: cannot be read: no such file or directory",
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
        "bad.pem: certificate: certificate and key cannot be used: ",
    ),
    "damaged authority": (
        lambda files, store: _with(
            files, authority=_written(files, "bad-ca.pem", files.authority.read_bytes().replace(b"M", b"N", 3))
        ),
        "bad-ca.pem: authority: the certificates cannot be read: ",
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


# ---- curves and revocation lists: handshakes in memory


def pair(
    store: CertificateStore, version: TlsVersion | None = None, **more: Any
) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """A server and a client of ours with the same options."""
    versions = {} if version is None else {"minimum_version": version, "maximum_version": version}
    server, client = store.server().options(), store.client().options()
    return (
        server_context(TlsParameters(**server, **versions, **more)),
        client_context(TlsParameters(**client, **versions, **more)),
    )


def foreign(files: CertificateFiles, protocol: int, group: str | None, version: TlsVersion) -> ssl.SSLContext:
    """A context of the standard library with one group, or all that OpenSSL has."""
    context = ssl.SSLContext(protocol)
    context.minimum_version = context.maximum_version = OF_SSL[version]
    context.load_cert_chain(files.certificate, files.key)
    context.load_verify_locations(files.authority)
    if group is not None:
        context.set_ecdh_curve(group)
    return context


@pytest.mark.clause("M2")
@pytest.mark.parametrize("version", list(TlsVersion))
@pytest.mark.parametrize("group", [None, "prime256v1", "X25519", "X448", "secp384r1", "secp521r1"])
def test_keys_are_agreed_on_over_p_256_alone(store: CertificateStore, version: TlsVersion, group: str | None) -> None:
    ours = dict(zip((True, False), pair(store, version), strict=True))
    client = foreign(store.client(), ssl.PROTOCOL_TLS_CLIENT, group, version)
    server = foreign(store.server(), ssl.PROTOCOL_TLS_SERVER, group, version)
    may = group in (None, "prime256v1")
    assert (agreed(ours[True], client) is None) is may
    assert (agreed(server, ours[False]) is None) is may


def test_with_any_curve_others_are_taken(store: CertificateStore) -> None:
    version = TlsVersion.TLS_1_3  # with 1.2 a list of one group is about the keys of certificates too
    server, client = pair(store, version, curve=Curve.ANY)
    for group in ("X25519", "secp384r1", "prime256v1"):
        assert agreed(server, foreign(store.client(), ssl.PROTOCOL_TLS_CLIENT, group, version)) is None
        assert agreed(foreign(store.server(), ssl.PROTOCOL_TLS_SERVER, group, version), client) is None


@pytest.mark.clause("M3")
@pytest.mark.parametrize("version", list(TlsVersion))
def test_a_revoked_certificate_is_refused_by_either_side_and_others_are_not(
    store: CertificateStore, version: TlsVersion
) -> None:
    good, lost, bad_server = store.client(), store.client("lost"), store.server("bad server")
    revocations = str(store.revocation_list(lost, bad_server))
    server, client = pair(store, version, revocation_list=revocations)
    assert agreed(server, client) is None
    assert agreed(server, foreign(good, ssl.PROTOCOL_TLS_CLIENT, None, version)) is None
    assert agreed(server, foreign(lost, ssl.PROTOCOL_TLS_CLIENT, None, version)) is FailureKind.REVOKED
    assert agreed(foreign(store.server(), ssl.PROTOCOL_TLS_SERVER, None, version), client) is None
    assert agreed(foreign(bad_server, ssl.PROTOCOL_TLS_SERVER, None, version), client) is FailureKind.REVOKED


@pytest.mark.clause("M3")
def test_without_a_valid_list_of_each_authority_above_no_client_is_let_in(store: CertificateStore) -> None:
    between = store.authority.intermediate("between")
    below = store.client("below", authority=between)
    context = foreign(below, ssl.PROTOCOL_TLS_CLIENT, None, TlsVersion.TLS_1_3)
    files = store.server().options()
    of_root = store.revocation_list(name="root").read_bytes()
    of_between = store.revocation_list(name="between", authority=between).read_bytes()
    expired = store.revocation_list(name="old", days=-1.0).read_bytes()
    foreign_list = store.revocation_list(name="foreign", authority=store.foreign).read_bytes()
    known = FailureKind.NOT_KNOWN_WHETHER_REVOKED
    for lists, outcome in (
        (of_root + of_between, None),
        (of_root, known),
        (of_between, known),
        (of_between + expired, known),
        (foreign_list, known),
    ):
        file = _written(below, "lists.crl", lists)
        assert agreed(server_context(TlsParameters(**files, revocation_list=file)), context) is outcome


def test_an_authority_that_was_revoked_takes_with_it_what_it_has_signed(store: CertificateStore) -> None:
    between = store.authority.intermediate("between")
    below = store.client("below", authority=between)
    revoked = CertificateFiles(Path(), Path(), Path(), between.issued)
    lists = store.revocation_list(revoked).read_bytes()
    lists += store.revocation_list(name="between", authority=between).read_bytes()
    file = _written(below, "lists.crl", lists)
    server = server_context(TlsParameters(**store.server().options(), revocation_list=file))
    client = foreign(below, ssl.PROTOCOL_TLS_CLIENT, None, TlsVersion.TLS_1_3)
    assert agreed(server, client) is FailureKind.REVOKED
