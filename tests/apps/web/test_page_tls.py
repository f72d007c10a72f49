"""The page over HTTPS: roles by the subject of a client certificate, and handshakes that come to nothing."""

import contextlib
import http.client
import json
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from page_collector import WatchedCollector, watched_collector

from busway.apps.collector.configuration import parse_collector
from busway.apps.web import connections
from busway.errors import ConfigError
from busway.testing import CertificateFiles, CertificateStore

ACCESS = """\
[page_access]
certificate = "{server.certificate}"
key = "{server.key}"
authority = "{server.authority}"
[page_access.subjects]
"CN=anna" = "operate"
"CN=eve" = "configure"
"""


class Secured:
    """A page with TLS and the certificates around it."""

    def __init__(self, plant: WatchedCollector, store: CertificateStore) -> None:
        self.plant, self.store = plant, store
        self.port = int(plant.page.url.rstrip("/").rpartition(":")[2])

    def context(self, client: CertificateFiles | None = None) -> ssl.SSLContext:
        context = ssl.create_default_context(cafile=str(self.store.authority_file))
        if client is not None:
            context.load_cert_chain(client.certificate, client.key)
        return context

    def ask(self, path: str, client: CertificateFiles | None = None, **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPSConnection("127.0.0.1", self.port, timeout=20, context=self.context(client))
        try:
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read())
        finally:
            connection.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    store = CertificateStore(tmp_path_factory.mktemp("certificates"))
    with watched_collector(
        tmp_path_factory.mktemp("plant"), "0.0.0.0:0", ACCESS.format(server=store.server())
    ) as plant:
        yield Secured(plant, store)


def test_the_page_says_that_it_is_encrypted(page: Secured) -> None:
    assert page.plant.page.url.startswith("https://")


def test_a_subject_that_the_file_names_has_its_role(page: Secured) -> None:
    assert page.ask("/api/caller", page.store.client("anna")) == (200, {"name": "CN=anna", "role": "operate"})
    assert page.ask("/api/caller", page.store.client("eve")) == (200, {"name": "CN=eve", "role": "configure"})


@pytest.mark.parametrize("name", ["berta", "CN=anna", "anna,O=plant", "Anna"])
def test_any_other_subject_has_none_and_needs_a_token(page: Secured, name: str) -> None:
    client = page.store.client(name)
    assert page.ask("/api/caller", client)[0] == 401
    token = next(line.split()[1] for line in page.plant.page.token_path.read_text().splitlines() if line[0] == "v")
    assert page.ask("/api/caller", client, Authorization=f"Bearer {token}")[1] == {"name": "view", "role": "view"}


def test_a_client_without_a_certificate_needs_a_token(page: Secured) -> None:
    assert page.ask("/api/caller")[0] == 401


def test_a_token_counts_before_the_certificate_and_a_wrong_one_is_refused(page: Secured) -> None:
    token = next(line.split()[1] for line in page.plant.page.token_path.read_text().splitlines() if line[0] == "v")
    anna = page.store.client("anna")
    assert page.ask("/api/caller", anna, Authorization=f"Bearer {token}")[1]["role"] == "view"
    assert page.ask("/api/caller", anna, Authorization="Bearer wrong-token-of-anna")[0] == 401


def test_certificates_that_cannot_be_trusted_end_the_handshake(page: Secured) -> None:
    for client in (page.store.expired_client(), page.store.self_signed("anna")):
        with pytest.raises((ssl.SSLError, ConnectionError, http.client.RemoteDisconnected)):
            page.ask("/api/caller", client)
    assert page.ask("/api/caller", page.store.client("anna"))[0] == 200


def test_a_request_without_tls_is_not_answered(page: Secured) -> None:
    with socket.create_connection(("127.0.0.1", page.port), timeout=60) as plain:
        plain.sendall(b"GET /api/caller HTTP/1.1\r\nHost: x\r\n\r\n")
        assert not plain.recv(100).startswith(b"HTTP")


def test_a_request_in_the_same_packet_as_the_end_of_the_handshake_is_answered(page: Secured) -> None:
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    secured = page.context(page.store.client("anna")).wrap_bio(incoming, outgoing, server_hostname="127.0.0.1")
    with socket.create_connection(("127.0.0.1", page.port), timeout=60) as plain:
        while True:
            try:
                secured.do_handshake()
                break
            except ssl.SSLWantReadError:
                plain.sendall(outgoing.read())
                incoming.write(plain.recv(65536))
        secured.write(b"GET /api/caller HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        plain.sendall(outgoing.read())  # the end of the handshake and the request
        answer = b""
        while b"operate" not in answer:
            try:
                answer += secured.read(65536)
            except ssl.SSLWantReadError:
                incoming.write(plain.recv(65536))
    assert answer.startswith(b"HTTP/1.1 200")


def test_handshakes_that_never_end_leave_room_for_others(page: Secured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "MOST", 5)
    silent = [socket.create_connection(("127.0.0.1", page.port), timeout=60) for _ in range(12)]
    try:
        assert page.ask("/api/caller", page.store.client("anna"))[0] == 200
        assert silent[0].recv(1) == b""
    except ConnectionResetError:
        pass  # an abort may arrive as a reset
    finally:
        for each in silent:
            each.close()


def test_a_handshake_that_is_too_slow_is_closed(page: Secured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.2)
    with socket.create_connection(("127.0.0.1", page.port), timeout=60) as silent:
        begun = time.monotonic()
        with contextlib.suppress(ConnectionResetError):
            assert silent.recv(1) == b""
        assert time.monotonic() - begun < 15


def test_what_is_wrong_with_the_section_is_said_with_line_and_key() -> None:
    text = """\
[poll_class]
all.period = 1
[[link]]
name = "hall"
url = "tcp://127.0.0.1"
[[device]]
name = "meter"
link = "hall"
profile = "meter"
[page_access]
authority = "ca.pem"
[page_access.subjects]
"CN=anna" = "operate"
"CN=bert" = "administer"
"""
    with pytest.raises(ConfigError) as caught:
        parse_collector(text, "plant.toml")
    assert "plant.toml:14" in str(caught.value)
    assert "CN=bert" in str(caught.value)
    with pytest.raises(ConfigError, match="certificate is missing"):
        parse_collector(text.replace("administer", "view"), "plant.toml")
    without = text.replace("administer", "view").replace('authority = "ca.pem"\n', "")
    with pytest.raises(ConfigError, match="authority that issues them is missing"):
        parse_collector(without, "plant.toml")


def test_a_certificate_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match=r"gone\.pem"),
        watched_collector(tmp_path, more='[page_access]\ncertificate = "gone.pem"\n'),
    ):
        pass
