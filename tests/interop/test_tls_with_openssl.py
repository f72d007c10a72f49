"""Our secure listener as ``openssl s_client`` sees it: a tool that shares no line of Python with us."""

import select
import shutil
import subprocess
from collections.abc import Iterator

import foreign
import pytest

import busway
from busway.testing.certificates import CertificateFiles, CertificateStore

READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
REPLY = bytes.fromhex("0001 0000 0005 01 03 02 04D2")


@pytest.fixture(scope="module")
def openssl() -> str:
    return shutil.which("openssl") or foreign.missing("no openssl (Debian: openssl)")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CertificateStore:
    return CertificateStore(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def port(store: CertificateStore) -> Iterator[str]:
    files = store.server("server", authority=store.authority.intermediate("plant authority"))
    device = busway.Device(holding_registers=[1234])
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}", units=device) as server:
        yield server.endpoints[0].rpartition(":")[2]


@pytest.fixture(scope="module")
def client(store: CertificateStore) -> CertificateFiles:
    return store.client("openssl", role="Operator")


def command(openssl: str, port: str, files: CertificateFiles, *options: str) -> list[str]:
    """``s_client`` with certificates, which ends where the server's is not good."""
    return [
        *(openssl, "s_client", "-connect", f"127.0.0.1:{port}", "-verify_return_error", "-verify_ip", "127.0.0.1"),
        *("-cert", str(files.certificate), "-key", str(files.key), "-CAfile", str(files.authority), *options),
    ]


def report(command: list[str]) -> str:
    """What it tells of a handshake, whatever comes of it."""
    done = subprocess.run(command, input=b"", capture_output=True, timeout=foreign.LIMIT, check=False)
    return (done.stdout + done.stderr).decode("utf-8", "replace")


@pytest.mark.clause("M1")
@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
def test_a_request_through_openssl_is_answered(openssl: str, port: str, client: CertificateFiles, version: str) -> None:
    words = command(openssl, port, client, version, "-quiet")
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        program.stdin.write(READ)
        program.stdin.flush()
        readable, _, _ = select.select([program.stdout], [], [], foreign.LIMIT)
        answer = program.stdout.read(len(REPLY)) if readable else b""
        program.kill()
    assert answer == REPLY


@pytest.mark.clause("M2")
@pytest.mark.clause("M3")
def test_openssl_sees_an_agreement_as_the_clauses_want_it(openssl: str, port: str, client: CertificateFiles) -> None:
    seen = report(command(openssl, port, client, "-tls1_2", "-showcerts", "-curves", "P-256"))
    assert "Verify return code: 0 (ok)" in seen
    assert "Secure Renegotiation IS supported" in seen
    assert "Compression: NONE" in seen
    assert "Cipher is ECDHE-ECDSA-AES128-GCM-SHA256" in seen
    assert "ECDH, prime256v1" in seen or "ECDH, P-256" in seen
    assert seen.count("-----BEGIN CERTIFICATE-----") >= 2  # its own, and the authority between it and the root
    assert "CN = plant authority" in seen or "CN=plant authority" in seen


@pytest.mark.clause("M2")
@pytest.mark.parametrize(
    "options",
    [
        ("-tls1", "-cipher", "ALL:@SECLEVEL=0"),
        ("-tls1_1", "-cipher", "ALL:@SECLEVEL=0"),
        ("-tls1_2", "-cipher", "ECDHE-ECDSA-AES128-SHA"),
        ("-tls1_2", "-cipher", "ECDHE-ECDSA-AES256-SHA384"),
        ("-tls1_2", "-cipher", "eNULL:@SECLEVEL=0"),
        ("-tls1_2", "-cipher", "AECDH-AES128-SHA:@SECLEVEL=0"),
    ],
    ids=" ".join,
)
def test_old_versions_and_weak_suites_are_refused(
    openssl: str, port: str, client: CertificateFiles, options: tuple[str, ...]
) -> None:
    seen = report(command(openssl, port, client, *options))
    assert "Cipher is (NONE)" in seen
    assert "alert" in seen


@pytest.mark.clause("M2")
@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
@pytest.mark.parametrize(
    ("groups", "agreed"),
    [
        ("X25519:P-256", True),
        ("X448:P-521:P-384:X25519:P-256", True),
        ("X25519", False),
        ("X448", False),
        ("P-384", False),
        ("P-521", False),
    ],
)
def test_keys_are_agreed_on_over_p_256_alone_whatever_is_offered(
    openssl: str, port: str, client: CertificateFiles, version: str, groups: str, agreed: bool
) -> None:
    seen = report(command(openssl, port, client, version, "-groups", groups))
    assert ("ECDH, prime256v1" in seen or "ECDH, P-256" in seen or "secp256r1" in seen) is agreed
    assert ("alert handshake failure" in seen) is not agreed


@pytest.mark.clause("M3")
@pytest.mark.parametrize(("version", "alert"), [("-tls1_2", "handshake failure"), ("-tls1_3", "certificate required")])
def test_without_a_certificate_there_is_a_fatal_alert(
    openssl: str, port: str, client: CertificateFiles, version: str, alert: str
) -> None:
    words = [openssl, "s_client", "-connect", f"127.0.0.1:{port}", "-CAfile", str(client.authority), version, "-quiet"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program:
        _, complaints = program.communicate(READ, timeout=foreign.LIMIT)
    assert f"alert {alert}" in complaints.decode("utf-8", "replace")


@pytest.mark.clause("M4")
@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
def test_openssl_resumes_its_session(
    openssl: str, port: str, client: CertificateFiles, version: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = str(tmp_path_factory.mktemp("session") / "session")
    for option, expected in (("-sess_out", "New"), ("-sess_in", "Reused")):
        words = command(openssl, port, client, version, "-quiet", "-ign_eof", option, file)
        words.remove("-quiet")
        with subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        ) as program:
            assert program.stdin is not None
            assert program.stdout is not None
            program.stdin.write(READ)
            program.stdin.flush()
            seen = b""
            while REPLY not in seen:
                readable, _, _ = select.select([program.stdout], [], [], foreign.LIMIT)
                assert readable
                more = program.stdout.read1(10_000)  # type: ignore[attr-defined]
                assert more
                seen += more
            program.kill()
        assert f"{expected}, TLSv1".encode() in seen
