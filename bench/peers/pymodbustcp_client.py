"""pyModbusTCP as a lock-step client.

Run by the peers' interpreter from `bench/`: python -m peers.pymodbustcp_client PORT SECONDS REGISTERS
"""

import sys
import time

from harness.window import BURST, Window
from pyModbusTCP.client import ModbusClient


def main(port: int, seconds: float, registers: int) -> None:
    client = ModbusClient("127.0.0.1", port, unit_id=1)
    if not client.open():
        raise SystemExit("no connection")
    window = Window(seconds)
    going = True
    while going:
        for _ in range(BURST):
            began = time.perf_counter()
            values = client.read_holding_registers(0, registers)
        if values is None or len(values) != registers:
            raise SystemExit(f"wrong reply: {client.last_error_as_txt} {client.last_except_as_txt}")
        going = window.count(BURST, began)
    client.close()
    window.report()


main(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
