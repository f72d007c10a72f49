"""Clients that ask as fast as a server takes it, in a process of their own. Knows no Modbus but the bytes it is given.

Use: python flood.py PORT CLIENTS REQUEST READS FILES, where REQUEST is a request in hexadecimal, READS is ``deaf`` for
clients that never take an answer, and FILES are authority, certificate and key with commas between, or nothing.
It says ``ready`` when all are connected, and ends with its input.
"""

import select
import selectors
import socket
import ssl
import sys
from contextlib import suppress

CHUNK = 65_536
"""Bytes that a client has ready at any time."""


def connected(port: int, certificates: str) -> socket.socket:
    """One client, which does not block."""
    link = socket.create_connection(("127.0.0.1", port), timeout=60)
    if certificates:
        authority, certificate, key = certificates.split(",")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.load_verify_locations(authority)
        context.load_cert_chain(certificate, key)
        link = context.wrap_socket(link)
    link.setblocking(False)
    return link


def main(port: int, clients: int, request: bytes, is_deaf: bool, certificates: str) -> None:
    """Flood until the input ends."""
    questions = memoryview(request * (CHUNK // len(request)))
    selector = selectors.DefaultSelector()
    rest: dict[socket.socket, memoryview] = {}
    for _ in range(clients):
        link = connected(port, certificates)
        rest[link] = questions
        selector.register(link, selectors.EVENT_READ | selectors.EVENT_WRITE)
    print("ready", flush=True)
    busy = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)
    while not select.select([sys.stdin], [], [], 0)[0]:
        for key, events in selector.select(0.1):
            link = key.fileobj
            assert isinstance(link, socket.socket)
            try:
                if events & selectors.EVENT_READ and not is_deaf:
                    with suppress(*busy):
                        if not link.recv(CHUNK):
                            raise ConnectionError
                with suppress(*busy):
                    sent = link.send(rest[link])
                    rest[link] = rest[link][sent:] or questions
            except OSError:  # the server has ended it
                selector.unregister(link)
        if is_deaf:
            select.select([sys.stdin], [], [], 0.01)


main(int(sys.argv[1]), int(sys.argv[2]), bytes.fromhex(sys.argv[3]), sys.argv[4] == "deaf", sys.argv[5])
