"""`busway certs`: certificates for tests in one command, and what a certificate says."""

import shlex
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.testing.certificates import CertificateStore
from busway.transport.tls.certificates.facts import facts_of_file

Run = Callable[..., Any]


def test_one_command_makes_an_authority_a_server_and_a_client_with_a_role(run: Run, tmp_path: Path) -> None:
    directory = tmp_path / "lab"
    result = run("certs", str(directory))
    assert result.code == 0
    expected = ["ca.pem", "ca.key", "server.pem", "server.key", "client-operator.pem", "client-operator.key"]
    assert result.out.splitlines() == [str(directory / name) for name in expected]
    (authority,) = facts_of_file(str(directory / "ca.pem"))
    (server,) = facts_of_file(str(directory / "server.pem"))
    (client,) = facts_of_file(str(directory / "client-operator.pem"))
    assert authority.is_authority
    assert server.issuer == client.issuer == authority.subject
    assert server.names == ("localhost", "127.0.0.1", "::1")
    assert (server.role, client.role) == (None, "Operator")
    assert server.key == "EC secp256r1"
    assert 364 < server.days_left() <= 365


def test_private_keys_can_be_read_by_their_owner_alone(run: Run, tmp_path: Path) -> None:
    assert run("certs", str(tmp_path)).code == 0
    for key in tmp_path.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600


@pytest.mark.clause("M5")
def test_hosts_roles_and_days_can_be_chosen(run: Run, tmp_path: Path) -> None:
    options = ["--host", "plc-7", "--host", "10.0.0.5", "--role", "Operator", "--role", "Line 3/Viewer", "--days", "7"]
    result = run("certs", str(tmp_path), *options, "--without-role")
    assert result.code == 0
    assert facts_of_file(str(tmp_path / "server.pem"))[0].names == ("plc-7", "10.0.0.5")
    assert facts_of_file(str(tmp_path / "client-line-3-viewer.pem"))[0].role == "Line 3/Viewer"
    plain = facts_of_file(str(tmp_path / "client.pem"))[0]
    assert plain.role is None
    assert plain.days_left() <= 7


def test_what_is_there_is_not_overwritten_without_force(run: Run, tmp_path: Path) -> None:
    assert run("certs", str(tmp_path)).code == 0
    before = (tmp_path / "ca.pem").read_bytes()
    refused = run("certs", str(tmp_path), "--role", "Viewer")
    assert refused.code == 2
    assert "is there already; --force writes over it" in refused.err
    assert (tmp_path / "ca.pem").read_bytes() == before
    assert not (tmp_path / "client-viewer.pem").exists()
    assert run("certs", str(tmp_path), "--force").code == 0
    assert (tmp_path / "ca.pem").read_bytes() != before


def test_the_commands_it_names_are_commands_that_work(run: Run, tmp_path: Path) -> None:
    made = run("certs", str(tmp_path / "a b"))
    serve, read = (shlex.split(line) for line in made.err.splitlines() if line.startswith("  busway "))
    assert serve[:3] == ["busway", "serve", "--listen"]
    device = busway.Device(holding_registers=[7])
    with busway.serve_in_thread(serve[3].replace(":8802", ":0"), units={255: device}) as server:
        port = server.endpoints[0].rpartition(":")[2]
        result = run(*(word.replace(":8802", f":{port}") for word in read[1:]))
    assert result.code == 0, result.err
    assert result.out.split()[-1] == "0007"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["a", "b"], "one directory is needed, not 2"),
        (["show"], "name the file with the certificate"),
        (["show", "missing.pem"], "missing.pem: cannot be read: no such file or directory"),
        (["lab", "--days", "0"], "--days: a whole number 1…36500 is needed"),
        (["lab", "--role", "a b", "--role", "a-b"], "two roles would have the file client-a-b.pem"),
        (["lab", "--host", "ä ö"], "'ä ö' is no host name or address"),
        (["lab", "--role", ""], "a role has 1…65535 bytes"),
    ],
)
def test_what_cannot_be_is_said_and_nothing_is_written(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("certs", *arguments)
    assert result.code == 2
    assert sentence in result.err
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_cannot_be_made_is_named(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = run("certs", str(tmp_path / "file" / "lab"))
    assert result.code == 2
    assert "file/lab" in result.err


def test_show_tells_what_a_certificate_says(run: Run, tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    client = store.client("hmi", role="Viewer", days=12.5)
    shown = run("certs", "show", str(client.certificate)).out
    lines = dict(line.split(maxsplit=1) for line in shown.splitlines())
    assert lines["subject"] == "CN=hmi"
    assert lines["issuer"] == "CN=test authority"
    assert lines["role"] == "'Viewer'"
    assert "expires on" in lines["valid"]
    assert "in 12 days" in lines["valid"]


def test_show_tells_what_is_wrong(run: Run, tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    two = store.client_with_two_roles(b"\x0c\x01a", b"\x0c\x01b")
    odd = store.client_with_role_value(b"\x13\x01a")
    expired = store.expired_server()
    assert "the client's certificate has two roles" in run("certs", "show", str(two.certificate)).out
    assert "its ASN.1 type is 0x13, and not UTF8String" in run("certs", "show", str(odd.certificate)).out
    assert "has expired on" in run("certs", "show", str(expired.certificate)).out


def test_show_goes_through_all_certificates_of_all_files(run: Run, tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    below = store.server(authority=store.authority.intermediate("plant authority"))
    shown = run("certs", "show", str(below.certificate), str(store.authority_file)).out
    subjects = [line.split(maxsplit=1)[1] for line in shown.splitlines() if line.startswith("subject")]
    assert subjects == ["CN=server", "CN=plant authority", "CN=test authority"]
