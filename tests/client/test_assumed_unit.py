"""The unit that is asked where none is named: an error in which another one may help says so."""

import pytest
from handlers import ScriptedHandler

import busway
from busway.pdu.general import ExceptionResponse

ANY_PORT = "tcp://127.0.0.1:0"
WORDS = "unit 255 was assumed because none was named"


def refusing(code: int) -> ScriptedHandler:
    return ScriptedHandler(lambda context, request: ExceptionResponse(context.function, code))


@pytest.mark.parametrize(("code", "is_told"), [(0x01, True), (0x02, False), (0x06, False), (0x0A, True), (0x0B, True)])
async def test_a_gateways_exception_says_that_the_unit_was_assumed(code: int, is_told: bool) -> None:
    async with (
        busway.serve(ANY_PORT, responder=refusing(code)) as server,
        busway.open(server.endpoints[0], shared=False) as link,
    ):
        for unit, is_assumed in ((link.unit(), True), (link.unit(255), False)):
            with pytest.raises(busway.ExceptionReply) as error:
                await unit.read_holding_registers(0, count=1)
            assert (WORDS in str(error.value)) == (is_told and is_assumed)
            assert error.value.code == code


async def test_it_is_said_once_by_each_way_of_asking() -> None:
    async with (
        busway.serve(ANY_PORT, responder=refusing(0x0B)) as server,
        busway.open(server.endpoints[0], shared=False) as link,
    ):
        unit = link.unit()
        with pytest.raises(busway.ExceptionReply) as read:
            await unit.read("4x1")
        errors = await unit.execute_many([busway.ReadHoldingRegisters(0, 1)] * 2, return_errors=True)
        with pytest.raises(busway.WriteOutcomeUnknown) as write:
            await unit.write_single_register(0, 1)
        assert [str(one).count(WORDS) for one in (read.value, *errors, write.value)] == [1, 1, 1, 1]


def test_no_reply_says_so_too_and_the_blocking_link_as_well() -> None:
    with busway.serve_in_thread(ANY_PORT, units={1: busway.Device(), 2: busway.Device()}, unlisted="silence") as server:
        url = server.endpoints[0]
        with busway.connect(url, shared=False, timeout=0.05, retries=0) as link:
            with pytest.raises(busway.NoReply, match=WORDS):
                link.unit().read_holding_registers(0, count=1)
            with pytest.raises(busway.NoReply, match=WORDS):
                link.unit().execute(busway.ReadHoldingRegisters(0, 1))
            with pytest.raises(busway.NoReply) as error:
                link.unit(255).read_holding_registers(0, count=1)
            assert WORDS not in str(error.value)
