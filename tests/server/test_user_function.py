"""A function of the user's own, 0x41, from declaration to use on both sides."""

import pytest

import busway
from busway.pdu.device_interface import Context, DataModel
from busway.pdu.fields import u16


class AddRegisters(busway.Request):
    """65: adds a number to a holding register and gives the sum."""

    code = 0x41
    writes = busway.Touch(busway.Table.HOLDING_REGISTERS, count=None)
    address: int = u16()
    addend: int = u16(1, 1000)

    class Reply(busway.ReplyMessage):
        """The sum."""

        total: int = u16()

    def apply(self, model: DataModel, context: Context) -> busway.Message:
        model.check(busway.Table.HOLDING_REGISTERS, self.address, 1, True)
        old = int.from_bytes(model.read(busway.Table.HOLDING_REGISTERS, self.address, 1, context), "big")
        total = old + self.addend & 0xFFFF
        model.write(busway.Table.HOLDING_REGISTERS, self.address, 1, total.to_bytes(2, "big"), context)
        return self.Reply(total)


FUNCTIONS = busway.STANDARD.with_functions(AddRegisters)
ANY_PORT = "tcp://127.0.0.1:0"


@pytest.mark.clause("A8")
async def test_user_function_works_between_server_and_asyncio_client_alone_and_in_bulk() -> None:
    device = busway.Device(holding_registers=[100] * 4)
    async with (
        busway.serve(ANY_PORT, units=device, functions=FUNCTIONS) as server,
        busway.open(server.endpoints[0], max_transactions=4) as link,
    ):
        unit = link.unit(1)
        reply = await unit.execute(AddRegisters(1, 5))
        assert isinstance(reply, AddRegisters.Reply)
        assert reply.total == device.holding_registers[1] == 105
        replies = await unit.execute_many([AddRegisters(2, 1) for _ in range(10)])
        assert [one.total for one in replies] == list(range(101, 111))
        assert await unit.read_holding_registers(0, count=4) == [100, 105, 110, 100]


@pytest.mark.clause("A8")
def test_user_function_works_between_server_and_blocking_client_alone_and_in_bulk() -> None:
    device = busway.Device(holding_registers=[100] * 4)
    with (
        busway.serve_in_thread(ANY_PORT, units=device, functions=FUNCTIONS) as server,
        busway.connect(server.endpoints[0], max_transactions=4) as link,
    ):
        reply = link.unit(1).execute(AddRegisters(1, 5))
        assert isinstance(reply, AddRegisters.Reply)
        assert reply.total == 105
        replies = link.unit(1).execute_many([AddRegisters(2, 1) for _ in range(10)])
        assert [one.total for one in replies] == list(range(101, 111))


@pytest.mark.clause("A8")
async def test_user_function_obeys_the_rules_of_every_function() -> None:
    device = busway.Device(holding_registers=[100] * 4)
    async with (
        busway.serve(ANY_PORT, units=device, functions=FUNCTIONS) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.execute(AddRegisters(4, 1))
        assert caught.value.code == 2
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.execute(busway.OpaqueRequest(0x41, b"\x00\x01"))
        assert caught.value.code == 3
        with pytest.raises(busway.InvalidRequest):
            AddRegisters(0, 0)
        device.functions = {3}
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.execute(AddRegisters(0, 1))
        assert caught.value.code == 1
    assert list(device.holding_registers) == [100] * 4


@pytest.mark.clause("A8")
async def test_server_without_the_function_answers_01() -> None:
    async with (
        busway.serve(ANY_PORT, units=busway.Device(holding_registers=4)) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        with pytest.raises(busway.ExceptionReply) as caught:
            await link.unit(1).execute(AddRegisters(0, 1))
        assert (caught.value.code, caught.value.function) == (1, 0x41)
