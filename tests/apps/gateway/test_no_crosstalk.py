"""Fifty clients, ten units, one line, and always one that goes away: no client ever gets another's answer."""

import asyncio
import contextlib
import random

import pytest
from handles import open_handles
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan

pytestmark = pytest.mark.real_time

ANY_PORT = "tcp://127.0.0.1:0"
BAUD = 115_200
CLIENTS = 50
UNITS = range(1, 11)
SECONDS = 8.0


def value(unit: int, address: int) -> int:
    """What a register holds."""
    return unit * 1000 + address


def device(unit: int) -> busway.Device:
    return busway.Device(holding_registers=[value(unit, address) for address in range(500)])


class Tally:
    """What the clients saw."""

    def __init__(self) -> None:
        self.right = self.refused = self.unanswered = self.killed = 0


async def client(endpoint: str, chance: random.Random, tally: Tally, until: float) -> None:
    """Asks at random, and closes its connection in the middle of it now and then."""
    loop = asyncio.get_running_loop()
    while loop.time() < until:
        async with busway.open(
            endpoint, shared=False, timeout=3.0, retries=0, max_transactions=4, max_connections=100
        ) as link:
            for _ in range(chance.randrange(1, 12)):
                asked = [(chance.choice(UNITS), chance.randrange(490), chance.randrange(1, 10)) for _ in range(3)]
                reads = [
                    asyncio.create_task(link.unit(unit).read_holding_registers(address, count=count))
                    for unit, address, count in asked
                ]
                if chance.random() < 0.1:
                    await asyncio.sleep(chance.random() * 0.05)
                    await link.close()
                    tally.killed += 1
                for (unit, address, count), found in zip(
                    asked, await asyncio.gather(*reads, return_exceptions=True), strict=True
                ):
                    if isinstance(found, list):
                        assert found == [value(unit, address + n) for n in range(count)], "another's answer"
                        tally.right += 1
                    elif isinstance(found, busway.ExceptionReply):
                        assert found.code in (6, 0x0A, 0x0B)
                        tally.refused += 1
                    else:
                        assert isinstance(found, busway.NoReply | busway.LinkDown), found
                        tally.unanswered += 1
                if not link.is_connected or loop.time() >= until:
                    break


async def units_that_come_and_go(url: str, chance: random.Random, until: float) -> None:
    """The servers on the line, which are switched off for a moment now and then."""
    loop = asyncio.get_running_loop()
    while loop.time() < until:
        gone = frozenset(chance.sample(UNITS, 2))
        async with busway.serve(url, units={unit: device(unit) for unit in UNITS if unit not in gone}):
            await asyncio.sleep(0.5 + chance.random())


@pytest.mark.clause("T32")
@pytest.mark.clause("T30")
@pytest.mark.parametrize("seed", [1, 2])
async def test_every_answer_goes_to_the_client_that_asked_whatever_goes_away(seed: int) -> None:
    chance = random.Random(seed)
    before = open_handles()
    tally = Tally()
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        plan = simple_plan([ANY_PORT], urls[0], timeout=0.1, retries=0, queue=400, quiet_window=0.01)
        async with Gateway(plan) as gateway:
            until = asyncio.get_running_loop().time() + SECONDS / 2
            servers = asyncio.create_task(units_that_come_and_go(urls[1], chance, until))
            await asyncio.gather(
                *(client(gateway.endpoints[0], random.Random(seed * 100 + n), tally, until) for n in range(CLIENTS))
            )
            servers.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await servers
            async with asyncio.timeout(60):
                while gateway.open_requests or gateway.status().gateway_listeners[0].server.connections:  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
    assert tally.right > 30
    assert tally.killed > 5
    assert tally.refused > 0
    assert open_handles() == before
