"""Wrong uses of the public interface: a type checker must refuse each line marked so. Never run."""

import busway


def blocking(unit: busway.BlockingUnit, device: busway.Device, link: busway.BlockingLink) -> None:
    unit.execute(busway.ReadCoils(0, 1)).registers  # wrong: bits have no registers
    unit.execute(busway.ReadHoldingRegisters(0, 1)).bits(1)  # wrong: registers have no bits
    unit.execute(busway.ReadHoldingRegisters)  # wrong: the class and not a request
    unit.execute("read")  # wrong: a text
    unit.execute(busway.ReadCoils("0", 1))  # wrong: an address that is a text
    unit.execute(busway.ReadCoils(0, 1), timout=1)  # wrong: a slip in an option
    unit.execute(busway.WriteSingleRegister(0, 1)).registers  # wrong: an echo has none
    coils: list[bool] = unit.execute(busway.ReadCoils(0, 1))  # wrong: a reply is no list
    text: str = unit.read("4x1", "float32")  # wrong: a float
    number: float = unit.read("4x1", "float32", count=2)  # wrong: a list
    numbers: list[int] = unit.read("4x1", "uint16")  # wrong: one number
    whole: int = unit.read("4x1", busway.FLOAT32)  # wrong: a float
    words: list[int] = unit.read("4x1", busway.string(8), count=2)  # wrong: texts
    unit.read("4x1", 32)  # wrong: no type
    unit.read(4.5)  # wrong: no address
    unit.read("4x1", "float32", "CDAB")  # wrong: the order is named
    unit.read("4x1", "float32", order="ABDC")  # wrong: no such order
    unit.read("4x1", order=1)  # wrong: no order
    unit.read("4x1", count="2")  # wrong: a text
    unit.read("4x1", unit=3)  # wrong: no such option
    unit.read("4x1", retries=1.5)  # wrong: half an attempt
    unit.write("4x1", "abc", busway.UINT16)  # wrong: a text as a number
    unit.write("4x1", 1.5, busway.INT32)  # wrong: a fraction as a whole number
    unit.write("4x1", "1.5", busway.FLOAT32)  # wrong: a text as a float
    unit.write("4x1", None)  # wrong: no value
    unit.write("4x1", 5, busway.string(8))  # wrong: a number as a text
    unit.write("4x1", 1, function="both")  # wrong: no such function
    unit.write_single_coil(0, "on")  # wrong: a text as a state
    unit.write_multiple_registers(0, 5)  # wrong: one value
    unit.write_multiple_registers(0, ["1"])  # wrong: texts
    unit.read_holding_registers(0, 10)  # wrong: the count is named
    unit.read_coils(0)  # wrong: no count
    unit.read_device_identification("full")  # wrong: no such level
    link.unit("1")  # wrong: a text as a unit
    link.read("4x1")  # wrong: a link reads nothing by itself
    link.is_connected()  # wrong: a property
    print(coils, text, number, numbers, whole, words)


async def asynchronous(link: busway.AsyncLink, unit: busway.AsyncUnit) -> None:
    value: float = unit.read("4x1", "float32")  # wrong: it is not awaited
    text: str = await unit.read("4x1", "float32")  # wrong: a float
    with link:  # wrong: async with
        pass
    (await unit.execute(busway.ReadCoils(0, 1))).registers  # wrong: bits have no registers
    print(value, text)


def options(device: busway.Device) -> None:
    busway.connect("tcp://h", timout=1)  # wrong: a slip in an option
    busway.connect("tcp://h", timeout="1")  # wrong: a text
    busway.connect("rtu:///dev/ttyUSB0", parity="mark")  # wrong: no such parity
    busway.connect("rtu:///dev/ttyUSB0", baud="9600")  # wrong: a text
    busway.connect("tcp://h", select="newest")  # wrong: no such rule
    busway.connect("tcp://h", True)  # wrong: options are named
    busway.open("tcp://h", preset="lax")  # wrong: no such preset
    busway.open(502)  # wrong: no endpoint
    busway.serve(units={1: "x"})  # wrong: no device
    busway.serve(units={"1": device})  # wrong: a text as a unit
    busway.serve(units=device, unlisted="ignore")  # wrong: no such answer
    busway.serve(units=device, max_conections=3)  # wrong: a slip in an option
    busway.serve_in_thread(units=device, unit_policy="all")  # wrong: no such policy
    busway.serve_forever(units=device, idle_timeout="5")  # wrong: a text
    busway.string("16")  # wrong: a text
    busway.string(16, "utf8")  # wrong: the encoding is written utf-8


def devices(device: busway.Device) -> None:
    device.on_write("holding", print)  # wrong: no such table
    device.on_write("input_registers", print)  # wrong: no function writes them
    device.on_read("coils", print, when="during")  # wrong: no such moment
    device.read("4x1", "float32", order="ABDC")  # wrong: no such order
    device.write("4x1", 1.5, "float32", order="CDBA")  # wrong: no such order
    busway.SingleBlock(8, tables=["holding"])  # wrong: no such table
