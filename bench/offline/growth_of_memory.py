"""Counts the bytes of a unit of `busway serve`, by how many units there are.

Part of `offline.growth`. Bytes of Python objects as `tracemalloc` counts them, from the text of a file to a server that
listens, above one that was opened before. A unit has 100 holding registers. A server has 256 units at most, so 1000 are
those of four services in this process.
"""

import asyncio
import gc
import tracemalloc

from busway.apps.service.configuration import parse_configuration
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service

UNITS = (10, 50, 250, 1000)
OF_A_SERVER = 250
FILE = 'listen = ["tcp://127.0.0.1:0"]\n'


def service(units: int) -> Service:
    text = FILE + "".join(f"[[unit]]\nunit = {unit}\nholding_registers = 100\n" for unit in range(1, units + 1))
    return Service(lambda: parse_configuration(text, "plant.toml"), Overrides(control="off"))


async def bytes_of_a_unit(units: int) -> float:
    counts = [OF_A_SERVER] * (units // OF_A_SERVER) or [units]
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    services = [service(count) for count in counts]
    for each in services:
        await each.__aenter__()
    gc.collect()
    used = tracemalloc.get_traced_memory()[0] - before
    for each in services:
        await each.__aexit__(None, None, None)
    return used / units


async def _measured() -> dict[int, float]:
    tracemalloc.start()
    await bytes_of_a_unit(1)
    found = {units: await bytes_of_a_unit(units) for units in UNITS}
    tracemalloc.stop()
    return found


def measured() -> dict[str, dict[int, float]]:
    """Bytes by setting and size."""
    return {"units of busway serve, bytes of one": asyncio.run(_measured())}
