"""What is assumed where it is not given, unit, rate and parity: an error in which naming it may help says so."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from handlers import ScriptedHandler

import busway
from busway.framing.rtu import encode_rtu
from busway.pdu.exception_response import ExceptionResponse

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


@contextmanager
def serial_port(reply: bytes = b"") -> Iterator[str]:
    """A port whose device answers what it hears with these bytes; with none it is silent."""
    near, far = os.openpty()

    def answer() -> None:
        try:
            while os.read(near, 256):
                os.write(near, reply)
        except OSError:  # the port was closed
            pass

    thread = threading.Thread(target=answer)
    if reply:
        thread.start()
    try:
        yield os.ttyname(far)
    finally:
        os.close(far)
        if reply:
            thread.join()
        os.close(near)


@pytest.mark.parametrize(
    ("units", "given", "told"),  # a unit that owes a reply is not asked at once, also by the next test
    [
        ((11, 12), "", "; assumed, because not given: 19200 baud and parity even"),
        ((13, 14), "baud=9600", "; assumed, because not given: parity even"),
        ((15, 16), "parity=none&data_bits=8", "; assumed, because not given: 19200 baud"),
        ((17, 18), "baudrate=9600&parity=E", ""),
    ],
)
def test_no_reply_on_a_port_says_which_of_its_settings_were_assumed(
    units: tuple[int, int], given: str, told: str
) -> None:
    with serial_port() as path, busway.connect(f"rtu://{path}?{given}", timeout=0.05, retries=0) as link:
        with pytest.raises(busway.NoReply) as read:
            link.unit(units[0]).read_holding_registers(0, count=1)
        with pytest.raises(busway.WriteOutcomeUnknown) as write:
            link.unit(units[1]).write_single_register(0, 1)
    for error in (read, write):
        assert str(error.value).count("assumed") == bool(told)
        assert told in str(error.value)


async def test_an_asyncio_link_says_so_too() -> None:
    with serial_port() as path:
        async with busway.open(f"rtu://{path}", timeout=0.05, retries=0) as link:
            with pytest.raises(busway.NoReply, match="19200 baud and parity even"):
                await link.unit(19).read_holding_registers(0, count=1)
            (error,) = await link.unit(20).execute_many([busway.ReadHoldingRegisters(0, 1)], return_errors=True)
    assert "19200 baud and parity even" in str(error)


def test_where_a_unit_has_answered_the_settings_are_right_and_nothing_is_told() -> None:
    reply = encode_rtu(21, b"\x03\x02\x00\x07")
    with serial_port(reply) as path, busway.connect(f"rtu://{path}", timeout=5, retries=0) as link:
        assert link.unit(21).read_holding_registers(0, count=1) == [7]
        with pytest.raises(busway.NoReply) as error:  # the answer is another unit's
            link.unit(22).execute(busway.ReadHoldingRegisters(0, 1), timeout=0.05)
    assert "assumed" not in str(error.value)
