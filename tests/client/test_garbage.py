"""Calls leave nothing behind that only the collector of garbage could find: with many links it has much to look at."""

import asyncio
import contextlib
import gc
from collections.abc import Awaitable, Callable

import pytest

import busway

REGISTERS = 20
CALLS = 20
Call = Callable[[busway.AsyncUnit], Awaitable[object]]


def fresh(*addresses: int) -> list[busway.Request]:
    """Requests that are made for one call."""
    return [busway.ReadHoldingRegisters(address, 1) for address in addresses]


async def cancelled(unit: busway.AsyncUnit) -> None:
    task = asyncio.ensure_future(unit.read_holding_registers(0, count=1))
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task])


CASES: dict[str, Call] = {
    "a read": lambda unit: unit.read_holding_registers(0, count=2),
    "a typed read": lambda unit: unit.read("4x1", "float32"),
    "a write": lambda unit: unit.write_single_register(0, 1),
    "a batch made for the call": lambda unit: unit.execute_many(fresh(1, 2, 3)),
    "a read that is refused": lambda unit: unit.read_holding_registers(REGISTERS, count=1),
    "a batch with one that is refused": lambda unit: unit.execute_many(fresh(1, REGISTERS, 2)),
    "a read that is not awaited any more": cancelled,
}


@pytest.mark.parametrize("call", CASES.values(), ids=CASES.keys())
def test_a_call_leaves_no_ring_of_references(call: Call) -> None:
    async def repeated(unit: busway.AsyncUnit) -> None:
        for _ in range(CALLS):
            with contextlib.suppress(busway.ModbusError):
                await call(unit)

    async def main() -> int:
        device = busway.Device(holding_registers=REGISTERS)
        async with (
            busway.serve("tcp://127.0.0.1:0", units={1: device}) as server,
            busway.open(server.endpoints[0], max_transactions=4, timeout=30.0) as link,
        ):
            await repeated(link.unit(1))
            gc.collect()
            gc.disable()
            try:
                await repeated(link.unit(1))
                return gc.collect()
            finally:
                gc.enable()

    assert asyncio.run(main()) < CALLS
