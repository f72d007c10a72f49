"""Directories for control sockets, whose paths must be short; and raw HTTP over sockets."""

import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def short_directory() -> Iterator[Path]:
    """A directory of mode 0700 with a path short enough for a Unix domain socket."""
    path = Path(tempfile.mkdtemp(prefix="bw"))
    try:
        yield path
    finally:
        shutil.rmtree(path)


def connected(address: str) -> socket.socket:
    """A socket connected to a path, or to ``http://host:port…``."""
    if address.startswith("http://"):
        host, _, port = address.removeprefix("http://").partition("/")[0].rpartition(":")
        return socket.create_connection((host.strip("[]"), int(port)), 10)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(10)
    connection.connect(address)
    return connection


def exchange(address: str, request: bytes) -> bytes:
    """All that comes back for these bytes, until the other side closes."""
    with connected(address) as connection:
        connection.sendall(request)
        return received(connection)


def received(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    data = b""
    try:
        while part := connection.recv(65_536):
            data += part
    except ConnectionResetError:
        pass
    return data
