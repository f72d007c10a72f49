"""Reads that are shared or remembered are judged for each client by itself; and a device may have several units."""

import asyncio
from typing import Any

import pytest
from handlers import ScriptedHandler
from waiting import until

import busway
from busway.access.rules import Action, Policy, Rule
from busway.apps.gateway.configuration import parse_gateway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.overview import gateway_rows
from busway.apps.gateway.routes import Route, RoutingTable
from busway.errors import ConfigError
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"
FILE = """
listen = ["tcp://127.0.0.1:5020"]
[[link]]
name = "hall"
url = "rtu:///dev/not-there"
same_device = {groups}
"""


class Slow:
    """Answers reads with the number of the request, when it is told to."""

    def __init__(self) -> None:
        self.asked = 0
        self.allowed = asyncio.Semaphore(0)

    def decide(self, context: busway.RequestContext, request: Any) -> Any:
        self.asked += 1
        return self._answer(request, self.asked)

    async def _answer(self, request: Any, number: int) -> busway.Message:
        await self.allowed.acquire()
        if isinstance(request, busway.WriteSingleRegister):
            return request
        return request.Reply(number.to_bytes(2, "big") * request.count)  # type: ignore[no-any-return]


def plan(line: str, *, listeners: int = 2, **route: Any) -> GatewayPlan:
    return GatewayPlan(
        tuple(GatewayListener(f"listener {n}", Listener(ANY_PORT)) for n in range(listeners)),
        (UpstreamSettings.of("line", line, same_device=(frozenset({1, 2}),)),),
        RoutingTable((Route(upstream="line", **route),)),
    )


@pytest.mark.clause("M6")
@pytest.mark.parametrize("cache", [None, 60.0])  # by the road of batches, and by the other
async def test_who_may_not_read_a_range_gets_no_shared_and_no_remembered_read_of_it(cache: float | None) -> None:
    slow = Slow()
    units = frozenset(range(1, 248))
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        Gateway(plan(server.endpoints[0], units=units, cache=cache), policy=Policy((), default=Action.ALLOW)) as made,
    ):
        permitted, denied = made.endpoints
        rule = Rule.of(name="not these", action="deny", listeners=[denied], addresses="4x1-4x10")
        made.replace_policy(Policy((rule,), default=Action.ALLOW))
        async with (
            busway.open(permitted, shared=False) as first,
            busway.open(permitted, shared=False) as second,
            busway.open(denied, shared=False, max_transactions=4) as third,
        ):
            reading = [asyncio.create_task(link.unit(1).read_holding_registers(0, count=5)) for link in (first, second)]
            counters = made.status().upstreams[0].counters
            await until(lambda: counters.shared == 1 and slow.asked == 1)
            for address, count in ((0, 5), (2, 1), (9, 3)):  # in flight, a part of it, and one that straddles the rule
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await third.unit(1).read_holding_registers(address, count=count)
            slow.allowed.release()
            assert await asyncio.gather(*reading) == [[1] * 5] * 2
            for address, count in ((0, 5), (2, 1)):  # remembered, if it is
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await third.unit(1).read_holding_registers(address, count=count)
            slow.allowed.release()
            assert await third.unit(1).read_holding_registers(10, count=1) == [2]
            assert (slow.asked, counters.shared, counters.recalled) == (2, 1, 0)
            if cache is not None:  # there was something to be had from memory
                assert await first.unit(1).read_holding_registers(2, count=1) == [1]
                assert counters.recalled == 1


async def test_a_write_to_one_unit_of_a_device_is_seen_by_a_remembered_read_of_another() -> None:
    device = busway.Device(holding_registers=[5])
    async with (
        busway.serve(ANY_PORT, units={1: device, 2: device, 3: device}) as server,
        Gateway(plan(server.endpoints[0], listeners=1, units=frozenset({1, 2, 3}), cache=60.0)) as made,
        busway.open(made.endpoints[0], shared=False) as link,
    ):
        for unit in (1, 2, 3):
            assert await link.unit(unit).read_holding_registers(0, count=1) == [5]
        await link.unit(2).write_single_register(0, 6)
        seen = [await link.unit(unit).read_holding_registers(0, count=1) for unit in (1, 2, 3)]
        assert seen == [[6], [6], [5]]  # 3 was not said to be the same


def test_a_file_says_which_units_are_the_same_device_and_the_check_repeats_it() -> None:
    configuration = parse_gateway(FILE.format(groups="[[1, 2], [5, 6]]"), "x.toml")
    assert configuration.plan.upstreams[0].same_device == (frozenset({1, 2}), frozenset({5, 6}))
    rows = {(kind, name): said for kind, name, said in gateway_rows(configuration)}
    assert "units 1-2 are the same device; units 5-6 are the same device" in rows["link", "hall"]


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ("[[1]]", "a group is two units or more"),
        ("[[1, 2], [2, 3]]", "unit 2 is in two groups"),
        ("[[1, 248]]", "a unit of this line is 1…247, not 248"),
        ("[[1, 1]]", "a group is two units or more"),
    ],
)
def test_groups_that_cannot_be_are_refused_by_key(groups: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        parse_gateway(FILE.format(groups=groups), "x.toml")
    assert "link[0].same_device" in str(error.value)
