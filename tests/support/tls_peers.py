"""Peers of secure connections that are not ours: the standard library's TLS, with the certificates of a test."""

import contextlib
import socket
import ssl
from collections.abc import Iterator, Mapping

from busway.options.tls import TlsVersion
from busway.testing.certificates import CertificateFiles
from busway.transport.tls.failures import FailureKind, failure_of

VERSIONS = (TlsVersion.TLS_1_2, TlsVersion.TLS_1_3)
OF_SSL = {TlsVersion.TLS_1_2: ssl.TLSVersion.TLSv1_2, TlsVersion.TLS_1_3: ssl.TLSVersion.TLSv1_3}
LIMIT = 10.0
"""Seconds that a step of a peer may take."""

READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
"""Read holding register 0 of unit 1."""


def one_version(version: TlsVersion) -> dict[str, TlsVersion]:
    """Options that allow one version only."""
    return {"minimum_version": version, "maximum_version": version}


def query(options: Mapping[str, object]) -> str:
    """Options behind the ``?`` of a URL."""
    return "&".join(f"{name}={getattr(value, 'value', value)}" for name, value in options.items())


def foreign_context(
    trusts: CertificateFiles, shows: CertificateFiles | None, version: TlsVersion | None = None
) -> ssl.SSLContext:
    """A client's context of the standard library, for one version or any."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(trusts.authority)
    if version is not None:
        context.minimum_version = context.maximum_version = OF_SSL[version]
    if shows is not None:
        context.load_cert_chain(shows.certificate, shows.key)
    return context


def agreed(server: ssl.SSLContext, client: ssl.SSLContext) -> FailureKind | None:
    """What came of a handshake: None where both sides agreed, or else what the side that refused says."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = {
        True: server.wrap_bio(to_server, to_client, server_side=True),
        False: client.wrap_bio(to_client, to_server, server_hostname="localhost"),
    }
    left = set(sides)
    for _ in range(10):
        for server_side in sorted(left):
            try:
                sides[server_side].do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLError as error:
                return failure_of(error, server_side=server_side).kind
            left.discard(server_side)
    assert not left
    return None


@contextlib.contextmanager
def foreign_client(
    port: int, context: ssl.SSLContext, session: ssl.SSLSession | None = None
) -> Iterator[ssl.SSLSocket]:
    """A connected client of the standard library. Raises `OSError`, of which `ssl.SSLError` is one."""
    with (
        socket.create_connection(("127.0.0.1", port), LIMIT) as below,
        context.wrap_socket(below, server_hostname="localhost", session=session) as client,
    ):
        yield client


def ask(client: socket.socket, request: bytes = READ) -> bytes:
    """Send a request and wait for its reply; empty where the server ended."""
    client.sendall(request)
    return receive_adu(client)


def receive_adu(client: socket.socket) -> bytes:
    """The next reply; empty where the server ended."""
    head = _exactly(client, 6)
    return head + _exactly(client, int.from_bytes(head[4:6], "big")) if head else b""


def _exactly(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        more = client.recv(size - len(data))
        if not more:
            return b""
        data += more
    return data
