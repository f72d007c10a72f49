"""pyModbusTCP's gateway from TCP to a serial line, as its command starts it.

Run by the peers' interpreter from `bench/`: python -m peers.tcp2rtu_gateway PATH BAUD

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import os
import socket
import sys
import time
from pathlib import Path


def free_port() -> int:
    """A port that was free a moment ago: the command does not tell which one it took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


port = free_port()
command = Path(sys.executable).with_name("mbtcp-tcp2rtu")
words = [str(command), "-H", "127.0.0.1", "-p", str(port), "-b", sys.argv[2], "--parity", "N", "--stopbits", "2"]
announcer = os.fork()
if announcer == 0:  # tells the port as soon as the gateway listens; the gateway itself keeps this process's number
    for _ in range(200):
        if listens(port):
            print(f"port {port}", flush=True)
            break
        time.sleep(0.05)
    os._exit(0)
os.execv(words[0], [*words, sys.argv[1]])
