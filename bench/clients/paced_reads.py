"""Single reads at a steady rate, spread over connections and units: what pollers of a plant ask, not a stress test.

Run from `bench/`: python -m clients.paced_reads SECONDS PER_SECOND CONNECTIONS UNITS PORT…; prints JSON: transactions,
rate, p50, p99 (µs), late (requests that left more than 5 ms after their time: then the generator was the bottleneck).
It speaks MBAP by itself: FC04 for 10 registers, each request in a segment of its own.
"""

import asyncio
import json
import struct
import sys
import time

REGISTERS = 10
REPLY = 9 + 2 * REGISTERS
LATE = 0.005


class Connection(asyncio.Protocol):
    """One connection with at most a few requests in flight."""

    def __init__(self, latencies: list[float]) -> None:
        self._latencies = latencies
        self._sent: dict[int, float] = {}
        self._received = bytearray()
        self._next = 0
        self.transport: asyncio.WriteTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        self.transport = transport

    def ask(self, unit: int) -> None:
        assert self.transport is not None
        self._next = self._next + 1 & 0xFFFF
        self._sent[self._next] = time.perf_counter()
        self.transport.write(struct.pack(">HHHBBHH", self._next, 0, 6, unit, 4, 0, REGISTERS))

    def data_received(self, data: bytes) -> None:
        now = time.perf_counter()
        self._received += data
        while len(self._received) >= REPLY:
            identifier, _, length, _, function, _ = struct.unpack_from(">HHHBBB", self._received)
            if function != 4 or length != REPLY - 6:
                raise SystemExit(f"a wrong reply: {self._received[:REPLY].hex(' ')}")
            self._latencies.append(now - self._sent.pop(identifier))
            del self._received[:REPLY]


async def main(seconds: float, rate: int, connections: int, units: int, ports: list[int]) -> None:
    loop = asyncio.get_running_loop()
    latencies: list[float] = []
    opened = [
        (await loop.create_connection(lambda: Connection(latencies), "127.0.0.1", ports[index % len(ports)]))[1]
        for index in range(connections)
    ]
    asked = late = 0
    began = time.perf_counter()
    while (now := time.perf_counter()) < began + seconds:
        due = int((now - began) * rate)
        while asked < due:
            late += now - (began + asked / rate) > LATE
            opened[asked % connections].ask(1 + asked % units)
            asked += 1
        await asyncio.sleep(1 / rate)
    took = time.perf_counter() - began
    await asyncio.sleep(0.1)
    latencies.sort()
    print(
        json.dumps(
            {
                "transactions": len(latencies),
                "rate": len(latencies) / took,
                "p50": 1e6 * latencies[len(latencies) // 2],
                "p99": 1e6 * latencies[len(latencies) * 99 // 100],
                "late": late / max(asked, 1),
            }
        )
    )


main_seconds, *numbers = sys.argv[1:]
asyncio.run(main(float(main_seconds), *map(int, numbers[:3]), list(map(int, numbers[3:]))))
