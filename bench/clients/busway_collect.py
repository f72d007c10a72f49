"""A whole collector against a server: reads, samples with time and quality, a store that is committed. Prints JSON.

Run from `bench/`: python -m clients.busway_collect PORT SECONDS POINTS
Points are holding registers from 0 on, register n holds n; rounds are due all the time. Counted are samples that are
in the store, and the CPU time of the process, all threads together.
"""

import asyncio
import json
import sys
import tempfile
import time
from pathlib import Path

import busway

FILE = """
[collector]
page = "off"
[poll_class]
all.period = 0.002
[[link]]
name = "server"
url = "tcp://127.0.0.1:{port}"
[[device]]
name = "d"
link = "server"
unit = 1
profile = "points.toml"
"""
WARM = 0.5


def write_files(folder: str, port: int, points: int) -> str:
    """The files of the collector; the name of the one that it is given."""
    lines = [f'    {{ name = "p{number}", address = "4x{number + 1}" }},' for number in range(points)]
    Path(folder, "points.toml").write_text("[[unit]]\npoint = [\n" + "\n".join(lines) + "\n]\n")
    file = Path(folder, "plant.toml")
    file.write_text(FILE.format(port=port))
    return str(file)


async def main(port: int, seconds: float, points: int) -> None:
    with tempfile.TemporaryDirectory(prefix="busway-bench-") as folder:
        async with busway.collect(write_files(folder, port, points)) as collector:
            await asyncio.sleep(WARM)
            began, cpu = collector.store_status().samples, time.process_time()
            clock = time.perf_counter()
            await asyncio.sleep(seconds)
            values, used = collector.store_status().samples - began, time.process_time() - cpu
            took = time.perf_counter() - clock
        table = busway.Store(str(Path(folder, "data"))).read(f"d/p{points - 1}")
        if {value for value in table.value if value is not None} != {points - 1}:  # None: the end of the collector
            raise SystemExit(f"wrong values: {sorted(set(map(str, table.value)))[:5]}")
    print(json.dumps({"values": values, "cpu": used, "seconds": took}))


asyncio.run(main(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))
