"""`WatchedContext`: when certificate files are read again, and what holds where they cannot be used."""

import logging
import os
from pathlib import Path

import pytest
from tls_peers import agreed, foreign_context

from busway.errors import ConfigError
from busway.faults.clock import FakeClock
from busway.options.tls import TlsParameters, TlsVersion
from busway.testing.certificates import CertificateFiles, CertificateStore
from busway.transport.tls.context import server_context
from busway.transport.tls.failures import FailureKind
from busway.transport.tls.renewal import WatchedContext


@pytest.fixture
def store(tmp_path: Path) -> CertificateStore:
    return CertificateStore(tmp_path)


@pytest.fixture
def files(store: CertificateStore) -> CertificateFiles:
    return store.server()


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


def test_files_that_cannot_be_used_are_said_once_and_the_old_context_stays(
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
    with pytest.raises(ConfigError, match="cannot be read"):
        watched.reload()
    assert watched.current() is first


def test_a_new_authority_in_a_directory_is_noticed(store: CertificateStore, files: CertificateFiles) -> None:
    directory = files.certificate.parent / "authorities"
    directory.mkdir()
    (directory / "one.pem").write_bytes(store.authority.issued.certificate_pem())
    clock = FakeClock()
    parameters = TlsParameters(**(files.options() | {"authority": str(directory)}))
    watched = WatchedContext(parameters, server_context, name="here", clock=clock.now)
    (directory / "two.pem").write_bytes(store.foreign.issued.certificate_pem())
    clock.advance(1.0)
    assert watched.current().cert_store_stats()["x509_ca"] == 2


def test_a_list_that_is_read_again_holds_for_the_next_connection(store: CertificateStore) -> None:
    clock = FakeClock()
    files = store.client()
    client = foreign_context(files, files, TlsVersion.TLS_1_3)
    parameters = TlsParameters(**store.server().options(), revocation_list=str(store.revocation_list()))
    watched = WatchedContext(parameters, server_context, name="x", clock=clock.now)
    assert agreed(watched.current(), client) is None
    store.revocation_list(files)
    clock.advance(2)
    assert agreed(watched.current(), client) is FailureKind.REVOKED
    store.revocation_list()
    watched.reload()
    assert agreed(watched.current(), client) is None
