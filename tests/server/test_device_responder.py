"""Which unit answers, and which functions: over real sockets, through `busway.serve`."""

import asyncio
from collections.abc import Mapping
from urllib.parse import urlsplit

import pytest

import busway
from busway.server.hooks import Change
from busway.testing import golden_adu

ANY_PORT = "tcp://127.0.0.1:0"


def _device(value: int) -> busway.Device:
    return busway.Device(holding_registers=[value] * 10, coils=8)


async def _ask(server: busway.Server, unit: int) -> int | None:
    """The value that a unit gives, or minus its exception code; None for silence."""
    reader, writer = await asyncio.open_connection("127.0.0.1", urlsplit(server.endpoints[0]).port)
    # The second request ends in an exception of function 0 whatever the unit: silence before it can be heard.
    writer.write(golden_adu(b"\x03\x00\x00\x00\x01", transaction=1, unit=unit) + golden_adu(b"\x00", transaction=2))
    head = await reader.readexactly(9)
    writer.close()
    await writer.wait_closed()
    if head[1] == 2:
        return None
    assert head[6] == unit
    return -head[8] if head[7] & 0x80 else await _rest(reader)


async def _rest(reader: asyncio.StreamReader) -> int:
    return int.from_bytes(await reader.readexactly(2), "big")


ONE, TWO = _device(11), _device(22)


@pytest.mark.clause("T24")
@pytest.mark.parametrize(
    ("units", "options", "answers"),
    [
        ({1: ONE}, {}, {1: 11, 0: 11, 255: 11, 2: -11, 247: -11, 254: -11}),
        ({1: ONE, 7: ONE}, {}, {1: 11, 7: 11, 0: 11, 255: 11, 2: -11}),
        ({1: ONE, 2: TWO}, {}, {1: 11, 2: 22, 0: -11, 255: -11, 3: -11}),
        ({1: ONE, 255: TWO}, {}, {1: 11, 255: 22, 0: -11}),
        ({0: ONE}, {}, {0: 11, 255: 11, 1: -11}),
        ({1: ONE}, {"unlisted": "silence"}, {1: 11, 0: 11, 255: 11, 2: None}),
        ({1: ONE, 2: TWO}, {"unlisted": "silence"}, {2: 22, 0: None, 255: None}),
        ({1: ONE}, {"unit_policy": "any"}, {0: 11, 1: 11, 2: 11, 128: 11, 255: 11}),
        (ONE, {}, {0: 11, 1: 11, 2: 11, 128: 11, 255: 11}),
    ],
)
async def test_units_answer_as_listed_or_any(
    units: Mapping[int, busway.Device] | busway.Device, options: dict[str, str], answers: dict[int, int | None]
) -> None:
    async with busway.serve(ANY_PORT, units=units, **options) as server:
        assert {unit: await _ask(server, unit) for unit in answers} == answers


@pytest.mark.parametrize(
    ("units", "options", "key"),
    [
        ({}, {}, "units"),
        ({256: ONE}, {}, "units"),
        ({-1: ONE}, {}, "units"),
        ({"1": ONE}, {}, "units"),
        ({1: ONE, 2: TWO}, {"unit_policy": "any"}, "unit_policy"),
        ({1: ONE}, {"unit_policy": "all"}, "unit_policy"),
        ({1: ONE}, {"unlisted": "shout"}, "unlisted"),
    ],
)
def test_impossible_units_are_refused_and_named(
    units: Mapping[int, busway.Device], options: dict[str, str], key: str
) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.serve(ANY_PORT, units=units, **options)
    assert caught.value.key == key


@pytest.mark.clause("A2")
async def test_each_device_offers_its_own_functions_and_the_list_can_change_while_it_is_served() -> None:
    reader = busway.Device(holding_registers=10, functions={3})
    everything = busway.Device(holding_registers=10)
    async with (
        busway.serve(ANY_PORT, units={1: reader, 2: everything}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        await link.unit(2).write_single_register(0, 5)
        assert await link.unit(1).read_holding_registers(0, count=1) == [0]
        with pytest.raises(busway.ExceptionReply) as caught:
            await link.unit(1).write_single_register(0, 5)
        assert caught.value.code == 1
        reader.functions = {6}
        await link.unit(1).write_single_register(0, 5)
        with pytest.raises(busway.ExceptionReply) as caught:
            await link.unit(1).read_holding_registers(0, count=1)
        assert caught.value.code == 1
        reader.functions = None
        assert await link.unit(1).read_holding_registers(0, count=1) == [5]


async def test_hook_that_comes_or_goes_later_counts_on_connections_that_stand_already() -> None:
    device = busway.Device(holding_registers=10)
    changes: list[int] = []

    def written(change: Change) -> None:
        changes.append(change.new[0])

    async with busway.serve(ANY_PORT, units=device) as server, busway.open(server.endpoints[0]) as link:
        unit = link.unit(1)
        await unit.write_single_register(0, 1)  # by the compiled answer, which the connection remembers
        device.on_write("holding_registers", written)
        await unit.write_single_register(0, 2)
        assert changes == [2]
        device.remove_hook(written)
        await unit.write_single_register(0, 3)
        assert changes == [2]
        assert device.holding_registers[0] == 3


async def test_hook_learns_peer_unit_function_address_old_and_new() -> None:
    device = busway.Device(holding_registers=[7] * 10)
    seen: list[Change] = []
    device.on_write("holding_registers", seen.append)
    async with (
        busway.serve(ANY_PORT, units={1: device, 3: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        await link.unit(3).write_multiple_registers(2, [8, 9])
        peer = server.status().connections[0].peer
    (change,) = seen
    assert (change.peer, change.unit, change.function) == (peer, 3, 16)
    assert (change.address, change.count, change.old, change.new) == (2, 2, [7, 7], [8, 9])
