"""A pyModbusTCP server (one thread per connection) with 65 536 registers, register n holding n.

Run by the peers' interpreter from `bench/`: python -m peers.pymodbustcp_server [--trace-memory]
"""

import signal
import socket
import socketserver
import sys

from harness import announce
from pyModbusTCP.server import DataBank, ModbusServer


def free_port() -> int:
    """A port that was free a moment ago: the library's server does not tell which one it took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def main() -> None:
    bank = DataBank()
    bank.set_holding_registers(0, list(range(65536)))
    socketserver.TCPServer.request_queue_size = 128  # it queues 5; more dial at once here, and would wait seconds
    port = free_port()
    server = ModbusServer("127.0.0.1", port, no_block=True, data_bank=bank)
    server.start()
    announce.port(port)
    while True:
        signal.pause()


if "--trace-memory" in sys.argv:
    announce.trace_memory()
main()
