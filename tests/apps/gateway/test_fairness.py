"""One client's flood is another's wait of one transaction at most."""

import asyncio

import pytest
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan

pytestmark = pytest.mark.real_time

ANY_PORT = "tcp://127.0.0.1:0"
BAUD = 115_200


@pytest.mark.clause("T32")
async def test_a_flooding_client_costs_another_at_most_one_transaction_of_waiting() -> None:
    order: list[int] = []
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        device = busway.Device(holding_registers=list(range(1000)))
        device.on_read("holding_registers", lambda access: order.append(access.address))
        async with (
            busway.serve(urls[1], units={1: device}),
            Gateway(simple_plan([ANY_PORT], urls[0], queue=200, timeout=10)) as gateway,
            busway.open(gateway.endpoints[0], shared=False, max_transactions=16, queue=100, timeout=10) as flooding,
            busway.open(gateway.endpoints[0], shared=False, timeout=10) as polite,
        ):
            await flooding.unit(1).read_holding_registers(0, count=1)
            await polite.unit(1).read_holding_registers(0, count=1)
            flood = [asyncio.create_task(flooding.unit(1).read_holding_registers(n, count=10)) for n in range(100, 160)]
            await until(lambda: len(order) >= 5)  # the flood is on the wire
            waits = []
            for n in range(500, 510):
                before = len(order)
                await polite.unit(1).read_holding_registers(n, count=10)
                waits.append(order.index(n) - before)
            assert not all(task.done() for task in flood)  # or it was no flood
            await asyncio.gather(*flood)
    assert max(waits) <= 2, waits  # the one on the wire, and at most one that was before it in the round
