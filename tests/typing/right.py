"""Right uses of the public interface: a type checker must accept every line. Read by ``test_typing.py``, never run."""

from collections.abc import Iterable
from typing import Any, assert_type

import busway


def blocking(unit: busway.BlockingUnit, numbers: Iterable[int], name: str) -> None:
    assert_type(unit.execute(busway.ReadCoils(0, 1)), busway.ReadCoils.Reply)
    assert_type(unit.execute(busway.ReadHoldingRegisters(0, 2)).registers, list[int])
    assert_type(unit.execute(busway.WriteSingleRegister(0, 2)).value, int)
    assert_type(unit.execute(busway.WriteSingleCoil.of(0, True)).address, int)
    assert_type(unit.execute(busway.MaskWriteRegister(0, 1, 2)).or_mask, int)
    assert_type(unit.execute(busway.ReturnQueryData(b"ab")).data, bytes)
    assert_type(unit.execute(busway.GetCommEventCounter()), busway.GetCommEventCounter.Reply)
    request: busway.Request = busway.ReadCoils(0, 1)
    reply: busway.Message = unit.execute(request)
    reply.encode()

    assert_type(unit.read("4x1", "float32"), float)
    assert_type(unit.read("4x1", "float32", count=2), list[float])
    assert_type(unit.read("4x1", "u16"), int)
    assert_type(unit.read("4x1", "bcd32", count=2, order="CDAB"), list[int])
    assert_type(unit.read("4x1", busway.FLOAT64), float)
    assert_type(unit.read("4x1", busway.INT32, count=3, split=True), list[int])
    assert_type(unit.read("4x1", busway.BITS), tuple[bool, ...])
    assert_type(unit.read("4x1", busway.string(16)), str)
    assert_type(unit.read("4x1", busway.string(16, "utf-8", "space"), count=2), list[str])
    text: str = unit.read("4x1", "string:16")
    on: bool = unit.read("0x1")
    number: int = unit.read(busway.parse_address("4x1"), name, timeout=1.0, retries=0, deadline=3.0)
    print(text, on, number)

    unit.write("4x1", 21.5, "float32", order="word-swapped")
    unit.write("4x1", 3)
    unit.write("0x1", True)
    unit.write("0x1", [True, False])
    unit.write("4x1", range(3), function="multiple", idempotent=True)
    unit.write("4x1", [1, 2.5], "float64")
    unit.write("4x1", "abc", busway.string(4))
    unit.write("4x1", "abc", "string:4")
    unit.write("4x1", 1.5, busway.FLOAT32)
    unit.write_multiple_registers(0, (number for number in numbers))
    unit.write_multiple_coils(0, [True, False])
    assert_type(unit.read_device_identification("regular"), dict[int, bytes])
    assert_type(unit.read_coils(0, count=3), list[bool])


async def asynchronous(unit: busway.AsyncUnit) -> None:
    assert_type(await unit.execute(busway.ReadInputRegisters(0, 1)), busway.ReadInputRegisters.Reply)
    assert_type(await unit.read("4x1", "float32"), float)
    assert_type(await unit.read("4x1", "int16", count=2), list[int])
    assert_type(await unit.read("4x1", busway.string(8)), str)
    await unit.write("4x1", [1.5, 2], "float32")
    await unit.write("4x1", 7)


class Multiply(busway.Request):
    """A function of a user's own."""

    code = 0x41
    left: int = busway.u16()
    right: int = busway.u16()

    class Reply(busway.ReplyMessage):
        """Its reply."""

        product: int = busway.u16()


def own_function(unit: busway.BlockingUnit) -> int:
    return unit.execute(Multiply(2, 3)).product


def links(**options: "busway.LinkOptions") -> None:
    busway.connect("tcp://10.0.0.5", timeout=2, retries=0, hold="request", user_timeout=None)
    busway.connect("rtu:///dev/ttyUSB0", baud=9600, parity="none", stop_bits=1, echo="automatic")
    busway.connect("rtu:///dev/ttyUSB0", baudrate=9600, bytesize=8, parity="N", stopbits=1)
    busway.open("tls://10.0.0.5", authority="ca.pem", server_name="plc", preset="strict", shared=False)
    busway.connect("tcp://10.0.0.5", select="oldest")


def servers(device: busway.Device) -> None:
    busway.serve("tcp://127.0.0.1:5020", units={1: device}, max_connections=3, unlisted="silence", preset="strict")
    busway.serve(units=device, unit_policy="any", idle_timeout=None, policy=busway.Policy.read_only())
    with busway.serve_in_thread("tcp://127.0.0.1:0", units=device, keepalive=False) as server:
        assert_type(server.endpoints, list[str])
    busway.serve_forever(units={1: device}, started=lambda server: print(server.endpoints), request_rate=5.0)


def devices(device: busway.Device) -> None:
    device.on_write("coils", print, when="after", address=3)
    device.write("4x1", 1.5, "float32", order="CDAB")
    busway.SingleBlock(8, tables=["coils", "holding_registers"])

    @device.on_read("input_registers")
    def read(access: busway.Access) -> None:
        print(access.values)

    assert_type(device.read("4x1", order="little"), Any)
    print(read)


def caught(unit: busway.BlockingUnit) -> None:
    try:
        unit.read("4x1")
    except busway.NoAnswer as error:
        assert_type(error.unit, int | None)
    except busway.MissingExtra as error:
        assert_type(error.extra, str)
