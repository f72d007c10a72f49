"""busway's asyncio client with typed values: 100 mixed points of a device, by `read_many` or one request for each.

Run from `bench/`: python -m clients.busway_typed PORT SECONDS together|apart CONNECTIONS

The points: 30 float32, 40 int16, 20 bits of registers, 10 strings of 8 bytes, scattered over 142 registers. Counted are
values, not transactions; both ways give the same ones, and compare them with each other before the time runs.
"""

import asyncio
import sys
import time
from contextlib import AsyncExitStack

from harness.window import Window

import busway
from busway.values import value_type

KINDS = ("float32", "int16", "int16", "bit", "float32", "int16", "string:8", "float32", "int16", "bit")


def points() -> dict[str, tuple[str, str]]:
    """Names with address and type: ten groups of ten, next to each other; two bits of a group share a register."""
    found, at = {}, 1
    for group in range(10):
        shared, at = at, at + 1
        for number, kind in enumerate(KINDS):
            name = f"{group}.{number} {kind}"
            if kind == "bit":
                found[name] = (f"4x{shared}", f"bit:{(group + number) % 16}")
            else:
                found[name] = (f"4x{at}", kind)
                at += value_type(kind).registers
    return found


async def main(port: int, seconds: float, way: str, connections: int) -> None:
    wanted = points()
    places = [(int(address[2:]) - 1, value_type(kind)) for address, kind in wanted.values()]
    requests = [busway.ReadHoldingRegisters(offset, form.registers) for offset, form in places]

    async def together(unit: busway.AsyncUnit) -> list[object]:
        return list((await unit.read_many(wanted)).values())

    async def apart(unit: busway.AsyncUnit) -> list[object]:
        replies = await unit.execute_many(requests)
        return [form.decode(reply.data)[0] for (_, form), reply in zip(places, replies, strict=True)]

    async with AsyncExitStack() as opened:
        links = [
            await opened.enter_async_context(
                busway.open(f"tcp://127.0.0.1:{port}", max_transactions=16, shared=False, max_connections=connections)
            )
            for _ in range(connections)
        ]
        units = [link.unit(1) for link in links]
        if repr(await together(units[0])) != repr(await apart(units[0])):
            raise SystemExit("the two ways give different values")
        read = together if way == "together" else apart
        window = Window(seconds)

        async def caller(unit: busway.AsyncUnit) -> None:
            going = True
            while going:
                began = time.perf_counter()
                going = window.count(len(await read(unit)), began)

        await asyncio.gather(*map(caller, units))
    window.report()


asyncio.run(main(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3], int(sys.argv[4])))
