"""Master and servers keep t3.5 before each frame, by the usual timers and with the exact ones."""

import asyncio
from itertools import pairwise

import pytest

import busway
from busway.testing.line import PacedLine

pytestmark = pytest.mark.alone

READS = 10
INACCURACY = 0.0003
"""Most seconds that the line may be wrong about when a program wrote and when one could read."""


async def read_on_a_loop(url: str) -> list[list[int]]:
    async with busway.open(url) as link:
        return [await link.unit(1).read_holding_registers(0, count=2) for _ in range(READS)]


def read_blocking(url: str) -> list[list[int]]:
    with busway.connect(url) as link:
        return [link.unit(1).read_holding_registers(0, count=2) for _ in range(READS)]


@pytest.mark.clause("S8", "S10")
@pytest.mark.parametrize("kind", ["blocking", "asyncio"])
@pytest.mark.parametrize("precise", ["off", "on"])
@pytest.mark.parametrize(("baud", "silence"), [(38_400, 0.00175), (9_600, 3.5 * 11 / 9_600)])
def test_nothing_is_sent_before_the_line_was_silent_for_t3_5(
    kind: str, precise: str, baud: int, silence: float
) -> None:
    device = busway.Device(holding_registers=[7, 8])
    with PacedLine(ports=2, baud=baud) as line:
        master, server = (f"rtu://{path}?baud={baud}&precise_timing={precise}" for path in line.paths)
        with busway.serve_in_thread(server, units={1: device}):
            values = read_blocking(master) if kind == "blocking" else asyncio.run(read_on_a_loop(master))
            spoken = line.transmissions()
    assert values == [[7, 8]] * READS
    assert [one.port for one in spoken] == [0, 1] * READS
    assert min(later.begin - earlier.end for earlier, later in pairwise(spoken)) >= silence - INACCURACY
