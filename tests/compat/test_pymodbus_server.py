"""The servers, contexts and data blocks of pymodbus on busway's servers, read by busway's own client."""

import asyncio
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from waiting import until

import busway
from busway.compat.pymodbus import server as servers
from busway.compat.pymodbus.constants import ExcCodes
from busway.compat.pymodbus.datastore import (
    ModbusBaseDeviceContext,
    ModbusDeviceContext,
    ModbusSequentialDataBlock,
    ModbusServerContext,
    ModbusSlaveContext,
    ModbusSparseDataBlock,
)
from busway.compat.pymodbus.device import ModbusDeviceIdentification
from busway.compat.pymodbus.exceptions import NoSuchIdException, ParameterException

ANY_PORT = ("127.0.0.1", 0)


@asynccontextmanager
async def serving(context: ModbusServerContext, **names: Any) -> AsyncIterator[busway.AsyncLink]:
    """A link to a server with this context."""
    server = servers.ModbusTcpServer(context, address=ANY_PORT, **names)
    await server.serve_forever(background=True)
    try:
        async with busway.open(server.endpoints[0]) as link:
            yield link
    finally:
        await server.shutdown()


async def code_of(call: Awaitable[object]) -> int:
    with pytest.raises(busway.ExceptionReply) as caught:
        await call
    return caught.value.code


# --- addresses --------------------------------------------------------------------------------------------------------


async def test_address_of_a_request_is_one_less_than_that_of_a_block_unless_zero_mode_is_set() -> None:
    for zero_mode, expected in ((False, [11, 12]), (True, [10, 11])):
        block = ModbusSequentialDataBlock(0, [10, 11, 12])
        store = ModbusDeviceContext(hr=block, zero_mode=zero_mode)
        async with serving(ModbusServerContext(devices=store, single=True)) as link:
            unit = link.unit(1)
            assert await unit.read_holding_registers(0, count=2) == expected
            assert await code_of(unit.read_holding_registers(1, count=3)) == 2
            await unit.write_single_register(0, 99)
        assert block.values[0 if zero_mode else 1] == 99


async def test_four_tables_are_read_and_written_and_those_left_out_have_all_addresses() -> None:
    store = ModbusSlaveContext(
        di=ModbusSequentialDataBlock(1, [True, False]),
        co=ModbusSparseDataBlock({5: [False, False], 9: True}),
        ir=ModbusSequentialDataBlock(1, [7, 70_000]),
    )
    async with serving(ModbusServerContext(slaves=store, single=True)) as link:
        unit = link.unit(17)
        assert await unit.read_discrete_inputs(0, count=2) == [True, False]
        await unit.write_multiple_coils(4, [True, True])
        assert await unit.read_coils(4, count=2) == [True, True]
        assert await unit.read_coils(8, count=1) == [True]
        assert await code_of(unit.read_coils(6, count=1)) == 2
        assert await unit.read_input_registers(0, count=2) == [7, 70_000 & 0xFFFF]
        await unit.write_multiple_registers(65_530, [1, 2])
        assert await unit.read_write_multiple_registers(65_530, count=2, write_address=65_531, values=[9]) == [1, 9]
        await unit.mask_write_register(65_530, and_mask=0, or_mask=5)
        assert await unit.read_holding_registers(65_530, count=1) == [5]
        assert await code_of(unit.read_fifo_queue(0)) == 1
        assert await code_of(unit.read_file_record(4, 0, count=1)) == 1


async def test_units_have_contexts_of_their_own_and_may_share_blocks() -> None:
    shared = ModbusSequentialDataBlock(1, [0] * 4)
    units = {1: ModbusDeviceContext(hr=shared), 2: ModbusDeviceContext(hr=shared), 3: ModbusDeviceContext()}
    async with serving(ModbusServerContext(devices=units, single=False)) as link:
        await link.unit(1).write_single_register(0, 42)
        assert await link.unit(2).read_holding_registers(0, count=1) == [42]
        assert await link.unit(3).read_holding_registers(0, count=1) == [0]
        assert await code_of(link.unit(9).read_holding_registers(0, count=1)) == 0x0B


async def test_without_a_context_no_unit_is_served_until_one_is_set() -> None:
    context = ModbusServerContext()
    responder = servers.ContextResponder(context, None, silent=False)
    assert 1 not in context
    assert context.device_ids() == []
    assert responder.serves(1) is None
    with pytest.raises(NoSuchIdException):
        context[1]
    context[1] = ModbusDeviceContext()
    assert responder.serves(1) is not None
    async with serving(context) as link:
        assert await link.unit(7).read_coils(0, count=1) == [False]


async def test_missing_unit_can_be_silent() -> None:
    context = ModbusServerContext(devices={1: ModbusDeviceContext()}, single=False)
    async with serving(context, ignore_missing_slaves=True) as link:
        with pytest.raises(busway.NoReply):
            await link.unit(9).read_coils(0, count=1, timeout=0.05, retries=0)


# --- what programs change and override --------------------------------------------------------------------------------


async def test_values_that_the_program_changes_while_it_serves_are_read() -> None:
    block = ModbusSequentialDataBlock(1, [1, 2])
    context = ModbusServerContext(devices=ModbusDeviceContext(hr=block))
    async with serving(context) as link:
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=2) == [1, 2]
        block.setValues(1, [5])
        context[0].setValues(3, 1, [6])
        assert await unit.read_holding_registers(0, count=2) == [5, 6]
        assert context[1].getValues(3, 0, count=2) == [5, 6]


async def test_overridden_methods_of_blocks_are_called_and_may_refuse() -> None:
    written: list[tuple[int, list[int]]] = []

    class Watched(ModbusSequentialDataBlock):
        def getValues(self, address: int, count: int = 1) -> Any:  # noqa: N802
            return [address * 10 + one for one in range(count)] if address < 5 else ExcCodes.DEVICE_BUSY

        def setValues(self, address: int, values: Any) -> Any:  # noqa: N802
            if address == 9:
                raise RuntimeError("the motor is off")
            written.append((address, values))
            return ExcCodes.ILLEGAL_VALUE if values == [13] else None

    async with serving(ModbusServerContext(devices=ModbusDeviceContext(hr=Watched(1, [0] * 10)))) as link:
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=2) == [10, 11]
        assert await code_of(unit.read_holding_registers(6, count=1)) == 6
        await unit.write_single_register(2, 7)
        assert await code_of(unit.write_single_register(2, 13)) == 3
        assert await code_of(unit.write_single_register(8, 1)) == 4
    assert written == [(3, [7]), (3, [13])]


async def test_context_of_the_program_itself_gets_function_address_and_count() -> None:
    asked: list[tuple[int, int, int]] = []

    class Own(ModbusBaseDeviceContext):
        def getValues(self, fc_as_hex: int, address: int, count: int = 1) -> Any:  # noqa: N802
            asked.append((fc_as_hex, address, count))
            return [address] * count

        def setValues(self, fc_as_hex: int, address: int, values: Any) -> Any:  # noqa: N802
            asked.append((fc_as_hex, address, len(values)))

    async with serving(ModbusServerContext(devices=Own())) as link:
        assert await link.unit(1).read_input_registers(7, count=2) == [7, 7]
        await link.unit(1).write_multiple_registers(3, [1, 2])
        await link.unit(1).write_single_coil(4, True)
    assert asked == [(4, 7, 2), (16, 3, 2), (5, 4, 1)]


async def test_identification_is_read_by_number_and_by_name() -> None:
    identity = ModbusDeviceIdentification(info_name={"VendorName": "Acme", "ProductCode": "PX"})
    identity.MajorMinorRevision = "2.5"
    identity[0x80] = b"\x01\x02"
    assert identity.summary()["VendorName"] == identity.VendorName == "Acme"
    context = ModbusServerContext(devices=ModbusDeviceContext())
    async with serving(context, identity=identity) as link:
        found = await link.unit(1).read_device_identification("extended")
        assert found == {0: b"Acme", 1: b"PX", 2: b"2.5", 0x80: b"\x01\x02"}
        assert (await link.unit(1).report_server_id()).startswith(b"Acme-PX-2.5")


# --- blocks and contexts by themselves --------------------------------------------------------------------------------


def test_blocks_know_their_addresses_and_go_back_to_their_defaults() -> None:
    block = ModbusSequentialDataBlock(10, [1, 2, 3])
    assert (block.validate(10, 3), block.validate(9, 1), block.validate(12, 2)) == (True, False, False)
    assert list(block) == [(10, 1), (11, 2), (12, 3)]
    block.reset()
    assert block.values == [0, 0, 0]
    sparse = ModbusSparseDataBlock({3: [7, 8], 9: 1}, mutable=False)
    assert (sparse.validate(3, 2), sparse.validate(4, 2)) == (True, False)
    sparse.setValues(3, [5])
    with pytest.raises(ParameterException, match="20"):
        sparse.setValues(20, [1])
    with pytest.raises(ParameterException):
        sparse.setValues(9, [5, 6])
    assert sparse.getValues(9, 1) == [1]  # where pymodbus has written the first one
    sparse.reset()
    assert sparse.getValues(3, 2) == [7, 8]
    with pytest.raises(ParameterException):
        ModbusSparseDataBlock(3)


def test_server_context_is_a_collection_of_units() -> None:
    first, second = ModbusDeviceContext(), ModbusDeviceContext()
    context = ModbusServerContext(devices={1: first}, single=False)
    context[2] = second
    assert (context[1], context[2], context.slaves(), 3 in context) == (first, second, [1, 2], False)
    del context[2]
    with pytest.raises(NoSuchIdException, match="2"):
        context[2]
    with pytest.raises(NoSuchIdException):
        context[300] = first
    assert dict(ModbusServerContext(slaves=first)) == {0: first}


# --- starting and stopping --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [servers.StartAsyncTcpServer, servers.StartAsyncUdpServer])
async def test_server_serves_until_it_is_stopped(start: Callable[..., Any]) -> None:
    context = ModbusServerContext(devices=ModbusDeviceContext())
    task = asyncio.create_task(start(context=context, address=ANY_PORT))
    await until(lambda: (server := servers.ModbusBaseServer.active_server) and server.endpoints)
    server = servers.ModbusBaseServer.active_server
    assert server is not None
    async with busway.open(server.endpoints[0]) as link:
        assert await link.unit(1).read_coils(0, count=1) == [False]
    await servers.ServerAsyncStop()
    await task
    with pytest.raises(RuntimeError, match="not running"):
        await servers.ServerAsyncStop()


@pytest.mark.parametrize("background", [False, True])
async def test_server_that_was_shut_down_serves_again(background: bool) -> None:
    server = servers.ModbusTcpServer(ModbusServerContext(devices=ModbusDeviceContext()), address=ANY_PORT)
    tasks = []
    for turn in range(3):
        if background and turn < 2:
            await server.serve_forever(background=True)
        else:
            tasks.append(asyncio.create_task(server.serve_forever()))
            await until(lambda: server.endpoints or tasks[-1].done())
        async with busway.open(server.endpoints[0]) as link:
            assert await link.unit(1).read_coils(0, count=1) == [False]
        await server.shutdown()
        assert server.endpoints == []
    for task in tasks:
        await task


async def test_end_of_an_earlier_serve_forever_leaves_the_next_one_alone() -> None:
    server = servers.ModbusTcpServer(ModbusServerContext(devices=ModbusDeviceContext()), address=ANY_PORT)
    earlier = asyncio.create_task(server.serve_forever())
    await until(lambda: server.endpoints)
    await server.shutdown()
    assert not earlier.done()  # it returns in the next turn, when the server serves again
    await server.serve_forever(background=True)
    await earlier
    async with busway.open(server.endpoints[0]) as link:
        assert await link.unit(1).read_coils(0, count=1) == [False]
    await server.shutdown()


def test_blocking_server_is_stopped_from_another_thread() -> None:
    context = ModbusServerContext(devices=ModbusDeviceContext())
    thread = threading.Thread(target=lambda: servers.StartTcpServer(context=context, address=ANY_PORT), daemon=True)
    thread.start()
    pause = threading.Event()
    while (server := servers.ModbusBaseServer.active_server) is None or not server.endpoints:
        pause.wait(0.001)
    with busway.connect(server.endpoints[0]) as link:
        assert link.unit(1).read_coils(0, count=1) == [False]
    servers.ServerStop()
    thread.join(60)
    assert not thread.is_alive()
    with pytest.raises(RuntimeError, match="not running"):
        servers.ServerStop()


def test_a_server_that_takes_long_to_stop_has_stopped_when_the_other_thread_goes_on() -> None:
    context = ModbusServerContext(devices=ModbusDeviceContext())
    thread = threading.Thread(target=lambda: servers.StartTcpServer(context=context, address=ANY_PORT), daemon=True)
    thread.start()
    pause = threading.Event()
    while (server := servers.ModbusBaseServer.active_server) is None or not server.endpoints:
        pause.wait(0.001)
    stop, stops = server._server.stop, 0

    async def stop_slowly() -> None:
        nonlocal stops
        stops += 1
        if stops == 1:
            await asyncio.sleep(0.05)
        await stop()

    server._server.stop = stop_slowly  # type: ignore[method-assign]
    servers.ServerStop()
    assert not server._server.is_running
    thread.join(60)
    assert not thread.is_alive()


async def test_arguments_are_those_of_pymodbus_and_others_are_refused() -> None:
    context = ModbusServerContext(devices=ModbusDeviceContext())
    servers.ModbusTcpServer(context, address=ANY_PORT, broadcast_enable=True, custom_functions=[], defer_start=True)
    with pytest.raises(TypeError, match="'adress'"):
        servers.ModbusTcpServer(context, adress=ANY_PORT)
    with pytest.raises(TypeError, match="'port'"):
        servers.ModbusSerialServer(context)
    with pytest.raises(ParameterException, match="custom_pdu"):
        servers.ModbusTcpServer(context, custom_pdu=[object])
    with pytest.raises(ParameterException, match="generate_ssl"):
        servers.ModbusTlsServer(context, sslctx=object())
    servers.ModbusBaseServer.active_server = None
