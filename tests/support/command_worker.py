"""A collector that writes to a device until it is killed: by itself at a step, or by the test that started it.

    python command_worker.py PLANT POINT FIRST COUNT [STEP]

Writes the values ``kFIRST`` to ``k(FIRST+COUNT-1)`` with keys of the same names, and prints a line of JSON for each
result; ``ready`` and the process id before.
"""

import asyncio
import json
import os
import signal
import sys

import busway


async def main() -> None:
    file, point, first, count = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    end_at = sys.argv[5] if len(sys.argv) > 5 else ""

    def step(name: str) -> None:
        if name == end_at:
            os.kill(os.getpid(), signal.SIGKILL)

    async with busway.collect(file) as collector:
        collector.commands._step = step
        async for _ in collector.samples():
            break
        print(f"ready {os.getpid()}", flush=True)
        for number in range(first, first + count):
            result = await collector.write("boiler", point, f"k{number}", by="worker", key=f"k{number}")
            print(json.dumps({"key": result.command.key, "state": result.state, "reason": result.reason}), flush=True)


if __name__ == "__main__":
    asyncio.run(main())
