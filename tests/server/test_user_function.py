"""A function of the user's own, 0x41, from declaration to use on both sides."""

import pytest

import busway
from busway.pdu.device_interface import Context, DataModel
from busway.pdu.fields import u16
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister


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


class KeptRegister(WriteSingleRegister):
    """66: writes a register like function 06, but only from 10 on."""

    code = 0x42

    def apply(self, model: DataModel, context: Context) -> busway.Message:
        if self.address < 10:
            raise busway.Refusal(2)
        return super().apply(model, context)


class EvenRegister(WriteSingleRegister):
    """67: writes a register like function 06, but only even numbers."""

    code = 0x43

    def validate(self) -> str | None:
        return "the value is odd" if self.value % 2 else None


class FarRegisters(ReadHoldingRegisters):
    """68: reads registers like function 03, ten addresses further on."""

    code = 0x44

    def apply(self, model: DataModel, context: Context) -> busway.Message:
        return self.Reply(model.read(busway.Table.HOLDING_REGISTERS, self.address + 10, self.count, context))


class FurtherRegisters(FarRegisters):
    """69: the same with another code."""

    code = 0x45


class MoreRegisters(ReadHoldingRegisters):
    """70: reads registers like function 03."""

    code = 0x46


DERIVED = busway.STANDARD.with_functions(KeptRegister, EvenRegister, FarRegisters, FurtherRegisters, MoreRegisters)


@pytest.mark.parametrize("policy", [None, busway.Policy.allow_all()])
async def test_a_function_derived_from_a_standard_one_does_what_it_overrides(policy: busway.Policy | None) -> None:
    device = busway.Device(holding_registers=list(range(20)))
    async with (
        busway.serve(ANY_PORT, units=device, functions=DERIVED, policy=policy) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        for refused, code in ((KeptRegister(9, 7), 2), (busway.OpaqueRequest(0x43, bytes.fromhex("0003 0007")), 3)):
            with pytest.raises(busway.ExceptionReply) as caught:
                await unit.execute(refused)
            assert caught.value.code == code
        assert list(device.holding_registers) == list(range(20))
        await unit.execute(KeptRegister(10, 7))
        await unit.execute(EvenRegister(3, 8))
        assert [device.holding_registers[address] for address in (10, 3)] == [7, 8]
        for _ in range(2):
            assert (await unit.execute(FarRegisters(1, 2))).registers == [11, 12]
            assert (await unit.execute(FurtherRegisters(1, 2))).registers == [11, 12]
            assert (await unit.execute(MoreRegisters(1, 2))).registers == [1, 2]
