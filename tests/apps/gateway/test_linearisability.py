"""Sharing and remembering reads must not be seen: a client that has seen a value never gets an older one."""

import asyncio
import random
from dataclasses import dataclass, field

import pytest
from handlers import ScriptedHandler, registers

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.pdu.functions import AnyRequest
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"


@dataclass
class SlowRegister:
    """A device with one register, which executes each request at some moment between its arrival and its answer."""

    chance: random.Random
    value: int = 0
    asked: int = 0

    def decide(self, context: busway.RequestContext, request: AnyRequest) -> object:
        self.asked += 1
        return self._execute(request)

    async def _execute(self, request: AnyRequest) -> busway.Message:
        await self._some_turns()
        if isinstance(request, busway.WriteSingleRegister):
            self.value = request.value
            reply: busway.Message = request
        else:
            assert isinstance(request, busway.ReadHoldingRegisters)
            reply = registers(*[self.value] * request.count)
        await self._some_turns()
        return reply

    async def _some_turns(self) -> None:
        for _ in range(self.chance.randrange(12)):
            await asyncio.sleep(0)


@dataclass
class History:
    """What was seen when, in steps of a common count."""

    step: int = 0
    written: list[tuple[int, int, int]] = field(default_factory=list)  # begun, ended, value
    read: list[tuple[int, int, int]] = field(default_factory=list)

    def tick(self) -> int:
        self.step += 1
        return self.step

    def check(self) -> None:
        """A read sees at least the last write that ended before it began, and nothing older than an earlier read."""
        for begun, ended, value in self.read:
            at_least = max((one[2] for one in self.written if one[1] < begun), default=0)
            at_most = max((one[2] for one in self.written if one[0] < ended), default=0)
            seen = max((one[2] for one in self.read if one[1] < begun), default=0)
            assert max(at_least, seen) <= value <= at_most


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("cache", [None, 60.0])
async def test_reads_never_go_back_behind_a_write_or_another_read(seed: int, cache: float | None) -> None:
    chance = random.Random(seed)
    device = SlowRegister(chance)
    history = History()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(device.decide)) as server:  # type: ignore[arg-type]
        plan = GatewayPlan(
            listeners=(GatewayListener("office", Listener(ANY_PORT)),),
            upstreams=(
                UpstreamSettings.of(
                    "line", server.endpoints[0], max_transactions=16, queue=1000, connections=3, timeout=20
                ),
            ),
            table=RoutingTable((Route(upstream="line", cache=cache),)),
        )
        async with Gateway(plan) as gateway:

            async def writer() -> None:
                async with busway.open(gateway.endpoints[0], shared=False, timeout=20) as link:
                    for value in range(1, 60):
                        begun = history.tick()
                        await link.unit(1).write_single_register(5, value)
                        history.written.append((begun, history.tick(), value))
                        for _ in range(chance.randrange(30)):
                            await asyncio.sleep(0)

            async def reader(stop: asyncio.Event) -> None:
                async with busway.open(gateway.endpoints[0], shared=False, timeout=20) as link:
                    while not stop.is_set():
                        first = chance.choice((3, 4, 5))
                        begun = history.tick()
                        found = await link.unit(1).read_holding_registers(first, count=4)
                        history.read.append((begun, history.tick(), found[5 - first]))

            stop = asyncio.Event()
            readers = [asyncio.create_task(reader(stop)) for _ in range(6)]
            await writer()
            stop.set()
            await asyncio.gather(*readers)
            counters = gateway.status().upstreams[0].counters
    history.check()
    assert len(history.read) > 60
    assert (counters.recalled if cache else counters.shared) > 0  # or nothing was tried
