"""A loop that reads a device with pymodbus and writes a line of CSV for each value. Prints JSON.

Run by the peers' interpreter from `bench/`: python -m peers.pymodbus_csv PORT SECONDS POINTS
Points are holding registers from 0 on, register n holds n, read by as many as a request may have. Counted are lines,
and the CPU time of the process.
"""

import csv
import json
import sys
import tempfile
import time

from pymodbus.client import ModbusTcpClient

WIDEST = 125
WARM = 0.5


def main(port: int, seconds: float, points: int) -> None:
    client = ModbusTcpClient("127.0.0.1", port=port)
    if not client.connect():
        raise SystemExit("no connection")
    with tempfile.TemporaryFile("w", newline="") as file:
        lines = csv.writer(file)

        def collect_for(length: float) -> int:
            values, until = 0, time.perf_counter() + length
            while time.perf_counter() < until:
                for first in range(0, points, WIDEST):
                    count = min(WIDEST, points - first)
                    reply = client.read_holding_registers(first, count=count, device_id=1)
                    if reply.isError() or reply.registers[0] != first:
                        raise SystemExit(f"wrong reply: {reply}")
                    now = time.time()
                    lines.writerows((now, f"p{first + n}", value) for n, value in enumerate(reply.registers))
                    values += count
            return values

        collect_for(WARM)
        cpu, clock = time.process_time(), time.perf_counter()
        values = collect_for(seconds)
        file.flush()
        print(json.dumps({"values": values, "cpu": time.process_time() - cpu, "seconds": time.perf_counter() - clock}))
    client.close()


main(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
