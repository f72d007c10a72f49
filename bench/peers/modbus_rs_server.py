"""A modbus-rs server with 65 536 registers for unit 1, register n holding n; its handler is Python.

Run by the peers' interpreter from `bench/`: python -m peers.modbus_rs_server
"""

import socket
import threading
import time

import modbus_rs
from harness import announce

TABLE = list(range(65536))


class Device(modbus_rs.ModbusApp):
    def handle_read_holding_registers(self, address: int, count: int) -> list[int]:
        return TABLE[address : address + count]


def free_port() -> int:
    """A port that was free a moment ago: the library does not tell which one it took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_until_it_listens(port: int) -> None:
    end = time.monotonic() + 5
    while time.monotonic() < end:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            time.sleep(0.02)
    raise SystemExit("it does not listen")


port = free_port()
server = modbus_rs.TcpServer("127.0.0.1", Device(), port, 1)
threading.Thread(target=server.serve_forever, daemon=True).start()
wait_until_it_listens(port)
announce.port(port)
while True:  # in pieces: a signal is answered between them
    time.sleep(3600)
