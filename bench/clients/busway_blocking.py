"""busway's blocking client, lock-step: one request on its way at a time.

Run from `bench/`: python -m clients.busway_blocking PORT SECONDS REGISTERS
"""

import sys
import time

from harness.window import BURST, Window

import busway


def main(port: int, seconds: float, registers: int) -> None:
    with busway.connect(f"tcp://127.0.0.1:{port}") as link:
        unit = link.unit(1)
        window = Window(seconds)
        going = True
        while going:
            for _ in range(BURST):
                began = time.perf_counter()
                values = unit.read_holding_registers(0, count=registers)
            if values != list(range(registers)):
                raise SystemExit(f"wrong values: {values}")
            going = window.count(BURST, began)
    window.report()


main(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
