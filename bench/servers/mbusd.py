"""mbusd before a serial line, as its command starts it.

Run from `bench/`: python -m servers.mbusd COMMAND PATH BAUD

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import os
import socket
import sys
import time


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


command, path, baud = sys.argv[1:4]
port = free_port()
if os.fork() == 0:  # tells the port as soon as the gateway listens; the gateway itself keeps this process's number
    for _ in range(200):
        if listens(port):
            print(f"port {port}", flush=True)
            break
        time.sleep(0.05)
    os._exit(0)
os.execv(command, [command, "-d", "-L-", "-p", path, "-s", baud, "-m", "8n2", "-A", "127.0.0.1", "-P", str(port)])
