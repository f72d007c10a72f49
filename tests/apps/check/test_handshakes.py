"""Checks of TLS against a server that takes what it must refuse: each is about one thing, and only that fails."""

import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from checked_device import VirtualDialer, target_of

import busway
from busway.access.rules import Policy, Rule
from busway.apps.check.catalogue import checks_for
from busway.apps.check.catalogue.handshakes import handshake_checks
from busway.apps.check.check import CheckResult, Level, Outcome, TlsChange
from busway.apps.check.run import CheckRun, Pace, probe_of
from busway.apps.check.tls_wire import CERTIFICATES, ClientCertificate
from busway.apps.check.wire import dialer_for
from busway.errors import ConfigError, LinkDown
from busway.testing.certificates import CertificateFiles, CertificateStore

PACE = Pace(timeout=60, quiet=0.05, idle=0.05)


@contextlib.contextmanager
def served(context: ssl.SSLContext) -> Iterator[int]:
    """Yield the port of a server that ends TLS as this context does, and answers each read with a zero."""
    listening = socket.create_server(("127.0.0.1", 0))
    threads: list[threading.Thread] = []

    def talk(plain: socket.socket) -> None:
        with plain, contextlib.suppress(OSError), context.wrap_socket(plain, server_side=True) as channel:
            while len(asked := channel.recv(12)) == 12:
                channel.sendall(asked[:4] + bytes((0, 5, asked[6], asked[7], 2, 0, 0)))

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                threads.append(threading.Thread(target=talk, args=(listening.accept()[0],)))
                threads[-1].start()

    accepting = threading.Thread(target=accept)
    accepting.start()
    try:
        yield listening.getsockname()[1]
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        for each in (accepting, *threads):
            each.join(60)


OF_USERS = {"tls-expired", "tls-revoked", "tls-role-denied", "tls-no-role"}
"""Checks that need a certificate of the user's."""


def run(
    port: int, store: CertificateStore, given: Mapping[str, CertificateFiles] | None = None
) -> dict[str, CheckResult]:
    """All results of the checks of TLS, by name; without certificates, those that need none."""
    url = f"tls://127.0.0.1:{port}?{store.client().query()}"
    target = replace(target_of("mbap", 1), is_secure=True)
    certificates = {
        CERTIFICATES[word]: ClientCertificate(str(one.certificate), str(one.key)) for word, one in (given or {}).items()
    }
    results = CheckRun(dialer_for(url, certificates=certificates), target, PACE).results(
        handshake_checks(probe_of(target))
    )
    return {one.check.id: one for one in results if given is not None or one.check.id not in OF_USERS}


def new_context(store: CertificateStore) -> ssl.SSLContext:
    files = store.server()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(files.certificate, files.key)
    context.load_verify_locations(files.authority)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def test_a_server_that_asks_for_no_certificate_fails_what_is_about_it(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    context = new_context(store)
    context.verify_mode = ssl.CERT_NONE
    with served(context) as port:
        results = run(port, store)
    found = {name: one.outcome for name, one in results.items() if one.outcome is not Outcome.PASSED}
    found.pop("tls-sha-1", None)  # what a plain context takes depends on the library
    assert found == {"tls-no-certificate": Outcome.FAILED, "tls-foreign": Outcome.FAILED}
    assert any("a connection without a certificate" in each.words for each in results["tls-no-certificate"].evidence)


def test_weak_suites_that_a_server_takes_are_found(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    context = new_context(store)
    context.set_ciphers("ALL:eNULL:@SECLEVEL=0")
    with served(context) as port:
        results = run(port, store)
    found = {name: one.outcome for name, one in results.items() if one.outcome is not Outcome.PASSED}
    assert found["tls-sha-1"] is Outcome.FAILED
    assert found.keys() <= {"tls-sha-1", "tls-no-encryption", "tls-1.0", "tls-1.1"}


@pytest.mark.parametrize("change", [TlsChange.PLAIN, TlsChange.NO_CERTIFICATE])
def test_a_changed_connection_leaves_from_the_chosen_address(tmp_path: Path, change: TlsChange) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(60)
        query = CertificateStore(tmp_path).client().query()
        url = f"tls://127.0.0.1:{listening.getsockname()[1]}?{query}"
        dialer = dialer_for(url, {"local_address": "127.0.0.2", "connect_timeout": 60}).changed(change)
        hosts: list[str] = []

        def accept() -> None:
            peer, address = listening.accept()
            hosts.append(address[0])
            peer.close()

        accepting = threading.Thread(target=accept)
        accepting.start()
        with contextlib.suppress(LinkDown):  # the server ends the handshake
            dialer.open().close()
        accepting.join(60)
        assert hosts == ["127.0.0.2"]
        foreign = dialer_for(url, {"local_address": "192.0.2.1"}).changed(change)
        with pytest.raises(LinkDown, match=r"local_address: '192\.0\.2\.1' is no address of this host"):
            foreign.open()


def test_a_device_over_tls_alone_has_them() -> None:
    target = target_of("mbap")
    plain = {one.id for one in checks_for(target, Level.DISRUPTIVE)}
    secure = {one.id for one in checks_for(replace(target, is_secure=True), Level.DISRUPTIVE)}
    assert len(secure - plain) == len(TlsChange)
    assert not {one.id for one in checks_for(replace(target, is_secure=True), Level.READ)} & (secure - plain)


class WithoutItsFile(VirtualDialer):
    """Has lost the file of a certificate that a changed handshake needs."""

    def changed(self, change: TlsChange) -> "VirtualDialer":
        raise ConfigError("cannot be read: no such file", file="expired.pem")


def test_a_certificate_that_was_deleted_during_the_run_leaves_its_checks_undecided() -> None:
    target = replace(target_of("mbap"), is_secure=True)
    results = list(CheckRun(WithoutItsFile("mbap"), target, Pace()).results(handshake_checks(probe_of(target))))
    assert {(one.outcome, one.reason) for one in results} == {
        (Outcome.UNDECIDED, "expired.pem: cannot be read: no such file")
    }


@pytest.mark.parametrize("change", TlsChange)
def test_a_serial_line_has_no_handshake_to_change(change: TlsChange) -> None:
    dialer = dialer_for("rtu:///dev/busway-none?baud=9600")
    assert dialer.changed(change) is dialer


def certificates_of(store: CertificateStore) -> dict[str, CertificateFiles]:
    """One certificate of each kind that a user may give."""
    return {
        "expired": store.expired_client(role="operator"),
        "revoked": store.client("revoked", role="operator"),
        "denied": store.client("guest", role="guest"),
        "no-role": store.client("bare"),
    }


def test_without_certificates_of_the_user_four_checks_say_what_to_give(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    with served(new_context(store)) as port:
        results = run(port, store, {})
    for word, name in zip(CERTIFICATES, ("tls-expired", "tls-revoked", "tls-role-denied", "tls-no-role"), strict=True):
        assert results[name].outcome is Outcome.UNDECIDED
        assert f"--certificates {word}=CERTIFICATE:KEY" in results[name].reason


def test_our_server_with_rules_and_a_revocation_list_passes_them(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    given = certificates_of(store)
    revoked = store.revocation_list(given["revoked"])
    policy = Policy.of(Rule.of(roles=["operator"]))
    listen = f"tls://127.0.0.1:0?{store.server().query()}&revocation_list={revoked}"
    with busway.serve_in_thread(listen, units={1: busway.Device()}, policy=policy) as server:
        port = int(server.endpoints[0].partition("?")[0].rpartition(":")[2])
        results = run(port, store, given)
    assert {name: results[name].outcome for name in OF_USERS} == dict.fromkeys(OF_USERS, Outcome.PASSED)


def test_a_server_that_knows_no_roles_and_no_revocation_fails_what_is_about_them(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    with served(new_context(store)) as port:
        results = run(port, store, certificates_of(store))
    assert {name for name in OF_USERS if results[name].outcome is Outcome.FAILED} == OF_USERS - {"tls-expired"}


def test_a_certificate_that_is_not_what_it_is_given_for_decides_nothing(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    good = store.client("good", role="operator")
    with served(new_context(store)) as port:
        results = run(port, store, {"expired": good, "no-role": good, "denied": store.expired_client()})
    assert "is not expired" in results["tls-expired"].reason
    assert "has the role operator" in results["tls-no-role"].reason
    assert "is expired" in results["tls-role-denied"].reason
    assert {results[name].outcome for name in OF_USERS} == {Outcome.UNDECIDED}
