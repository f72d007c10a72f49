"""umodbus as a lock-step client.

Run by the peers' interpreter from `bench/`: python -m peers.umodbus_client PORT SECONDS REGISTERS
"""

import socket
import sys
import time

from harness.window import BURST, Window
from umodbus.client import tcp


def main(port: int, seconds: float, registers: int) -> None:
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    window = Window(seconds)
    going = True
    while going:
        for _ in range(BURST):
            began = time.perf_counter()
            values = tcp.send_message(tcp.read_holding_registers(1, 0, registers), connection)
        if values != list(range(registers)):
            raise SystemExit(f"wrong values: {values}")
        going = window.count(BURST, began)
    connection.close()
    window.report()


main(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
