"""Instruments of minimalmodbus on busway's links: values, arguments, settings and errors.

What a port would do is tried in ``tests/interop/serial``; here a link over TCP stands for it.
"""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

import busway
from busway.compat import minimalmodbus
from busway.compat.minimalmodbus import Instrument, InstrumentPort


class TcpPort(InstrumentPort):
    """A port whose link leads to a server over TCP."""

    def __init__(self, url: str) -> None:
        super().__init__("/dev/none", timeout=60)
        self.opened = busway.connect(url, retries=0)

    def link(self, mode: str, local_echo: bool) -> busway.BlockingLink:
        """The link over TCP."""
        return self.opened


@pytest.fixture
def device() -> busway.Device:
    return busway.Device(holding_registers=200, input_registers=[7, 8], coils=20, discrete_inputs=[1, 0, 1])


@pytest.fixture
def instrument(device: busway.Device) -> Iterator[Instrument]:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        made = Instrument("/dev/none", 1)
        made.serial = port = TcpPort(server.endpoints[0])
        yield made
        port.opened.close()


def test_bits_are_zeros_and_ones(instrument: Instrument, device: busway.Device) -> None:
    assert instrument.read_bits(0, 3) == [1, 0, 1]
    assert instrument.read_bit(2) == 1
    instrument.write_bit(5, 1)
    instrument.write_bit(6, 1, functioncode=15)
    instrument.write_bits(7, [1, 0, 1])
    assert instrument.read_bits(5, 5, functioncode=1) == [1, 1, 1, 0, 1]
    assert list(device.coils[5:10]) == [True, True, True, False, True]


def test_nothing_can_be_read_from_all_units_at_once() -> None:
    everyone = Instrument("/dev/none", 0)
    reads: list[Callable[[], Any]] = [
        lambda: everyone.read_bits(0, 3),
        lambda: everyone.read_bit(0, functioncode=1),
        lambda: everyone.read_register(0),
        lambda: everyone.read_string(0),
    ]
    for read in reads:
        with pytest.raises(ValueError, match="cannot be broadcast"):
            read()
    everyone.serial.close()


def test_registers_have_decimals_and_signs(instrument: Instrument, device: busway.Device) -> None:
    assert instrument.read_registers(0, 2, functioncode=4) == [7, 8]
    instrument.write_registers(10, [1, 65_535])
    assert instrument.read_register(11, signed=True) == -1
    instrument.write_register(12, 77.0, 1)
    assert device.holding_registers[12] == 770
    value = instrument.read_register(12, 1)
    assert (value, type(value)) == (77, int)
    assert instrument.read_register(12, 3) == 0.77
    instrument.write_register(13, -5, functioncode=6, signed=True)
    assert device.holding_registers[13] == 65_531


ORDERS = [
    (minimalmodbus.BYTEORDER_BIG, [0x0102, 0x0304], [0x0102, 0x0304, 0x0506, 0x0708]),
    (minimalmodbus.BYTEORDER_LITTLE, [0x0403, 0x0201], [0x0807, 0x0605, 0x0403, 0x0201]),
    (minimalmodbus.BYTEORDER_BIG_SWAP, [0x0201, 0x0403], [0x0201, 0x0403, 0x0605, 0x0807]),
    (minimalmodbus.BYTEORDER_LITTLE_SWAP, [0x0304, 0x0102], [0x0708, 0x0506, 0x0304, 0x0102]),
]


@pytest.mark.parametrize(("order", "two", "four"), ORDERS)
def test_longs_have_the_byte_orders_of_minimalmodbus(
    instrument: Instrument, device: busway.Device, order: int, two: list[int], four: list[int]
) -> None:
    instrument.write_long(20, 0x01020304, byteorder=order)
    instrument.write_long(30, 0x0102030405060708, byteorder=order, number_of_registers=4)
    assert list(device.holding_registers[20:22]) == two
    assert list(device.holding_registers[30:34]) == four
    assert instrument.read_long(20, byteorder=order) == 0x01020304
    assert instrument.read_long(30, byteorder=order, number_of_registers=4) == 0x0102030405060708
    instrument.write_float(40, -1.5, byteorder=order)
    instrument.write_float(44, 0.1, number_of_registers=4, byteorder=order)
    assert instrument.read_float(40, byteorder=order) == -1.5
    assert instrument.read_float(44, number_of_registers=4, byteorder=order) == 0.1


def test_long_may_have_a_sign_and_a_text_is_filled_with_spaces(instrument: Instrument, device: busway.Device) -> None:
    instrument.write_long(50, -2, signed=True)
    assert instrument.read_long(50, signed=True) == -2
    instrument.write_string(60, "ABC", 3)
    assert list(device.holding_registers[60:63]) == [0x4142, 0x4320, 0x2020]
    assert instrument.read_string(60, 3) == "ABC   "


@pytest.mark.parametrize(
    ("call", "kind"),
    [
        (lambda one: one.read_bit(0, functioncode=3), ValueError),
        (lambda one: one.read_register(0, functioncode=1), ValueError),
        (lambda one: one.read_register("0"), TypeError),
        (lambda one: one.read_register(0, -1), ValueError),
        (lambda one: one.read_register(0, signed=1), TypeError),
        (lambda one: one.read_registers(0, 126), ValueError),
        (lambda one: one.read_bits(0, 0), ValueError),
        (lambda one: one.write_bit(0, 2), ValueError),
        (lambda one: one.write_bits(0, []), ValueError),
        (lambda one: one.write_registers(0, 5), TypeError),
        (lambda one: one.write_registers(0, [65_536]), ValueError),
        (lambda one: one.write_register(0, 65_536), ValueError),
        (lambda one: one.write_register(0, -1), ValueError),
        (lambda one: one.write_register(0, "1"), TypeError),
        (lambda one: one.write_long(0, 2**32), ValueError),
        (lambda one: one.write_long(0, 1, number_of_registers=3), ValueError),
        (lambda one: one.read_float(0, byteorder=4), ValueError),
        (lambda one: one.write_string(0, "ABC", 1), ValueError),
        (lambda one: one.write_string(0, ""), ValueError),
        (lambda one: one.write_string(0, b"A", 1), TypeError),
        (lambda one: one.read_register(65_536), ValueError),
    ],
)
def test_wrong_argument_is_refused_and_nothing_is_sent(
    instrument: Instrument, call: Callable[[Instrument], Any], kind: type[Exception]
) -> None:
    with pytest.raises(kind):
        call(instrument)
    instrument.address = 300
    with pytest.raises(ValueError, match="slaveaddress"):
        instrument.read_register(0)


def test_exception_of_the_device_and_what_went_wrong_on_the_line_are_exceptions_of_minimalmodbus(
    instrument: Instrument,
) -> None:
    with pytest.raises(minimalmodbus.IllegalRequestError, match="illegal data address") as caught:
        instrument.read_register(500)
    assert isinstance(caught.value, minimalmodbus.SlaveReportedException)
    assert isinstance(caught.value, minimalmodbus.ModbusException)
    assert isinstance(caught.value, OSError)
    assert instrument.roundtrip_time is not None


def of_write(cause: busway.ModbusError) -> busway.ModbusError:
    error = busway.WriteOutcomeUnknown("a write")
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (busway.ExceptionReply(1), minimalmodbus.IllegalRequestError),
        (busway.ExceptionReply(6), minimalmodbus.SlaveDeviceBusyError),
        (busway.ExceptionReply(7), minimalmodbus.NegativeAcknowledgeError),
        (busway.ExceptionReply(4), minimalmodbus.SlaveReportedException),
        (busway.NoReply("silence"), minimalmodbus.NoResponseError),
        (busway.NoReply("half", kind="partial"), minimalmodbus.InvalidResponseError),
        (busway.BadReply("length"), minimalmodbus.InvalidResponseError),
        (busway.LinkDown("no port"), minimalmodbus.MasterReportedException),
        (of_write(busway.NoReply("silence")), minimalmodbus.NoResponseError),
        (of_write(busway.BadReply("echo")), minimalmodbus.InvalidResponseError),
    ],
)
def test_each_error_has_its_exception(error: busway.ModbusError, kind: type[Exception]) -> None:
    assert type(minimalmodbus.exception_for(error)) is kind


class Opened:
    """What `connect` was asked for."""

    def __init__(self, endpoint: busway.Endpoint, **options: Any) -> None:
        self.url, self.options, self.is_closed = endpoint.url, options, False

    def close(self) -> None:
        """Keep that it was closed."""
        self.is_closed = True


def test_settings_count_at_the_next_call_and_a_changed_one_opens_the_port_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(minimalmodbus, "connect", Opened)
    first, second = Instrument("/dev/tty7", 1), Instrument("/dev/tty7", 2)
    assert first.serial is second.serial
    first.serial.baudrate, first.serial.parity = 9600, "E"
    link: Any = second.serial.link("rtu", False)
    assert (link.url, link.options["baud"], link.options["parity"]) == ("rtu:///dev/tty7", 9600, "E")
    assert (link.options["retries"], link.options["data_bits"], link.options["echo"]) == (0, 8, "off")
    assert second.serial.link("rtu", False) is link
    first.serial.timeout = 1.0  # of each call, not of the port
    assert second.serial.link("rtu", False) is link
    ascii_link: Any = second.serial.link("ascii", True)
    assert link.is_closed
    assert (ascii_link.url, ascii_link.options["echo"]) == ("ascii:///dev/tty7", "on")
    second.serial.close()
    assert ascii_link.is_closed


def test_port_of_pyserial_gives_its_settings_and_is_closed() -> None:
    closed: list[bool] = []
    port = SimpleNamespace(
        port="/dev/tty8",
        baudrate=57_600,
        parity="O",
        bytesize=8,
        stopbits=2,
        timeout=0.5,
        write_timeout=1,
        close=lambda: closed.append(True),
    )
    one = Instrument(port, 3, mode=minimalmodbus.MODE_ASCII)
    assert (one.serial.port, one.serial.baudrate, one.serial.parity, one.serial.stopbits) == (
        "/dev/tty8",
        57_600,
        "O",
        2,
    )
    assert closed == [True]
    assert not one.serial.is_open
    assert "address=3, mode=ascii" in repr(one)
    with pytest.raises(minimalmodbus.MasterReportedException):
        Instrument(None, 1)
    with pytest.raises(ValueError, match="mode"):
        Instrument("/dev/tty8", 1, mode="tcp")


def test_port_that_cannot_be_opened_is_an_exception_of_the_master() -> None:
    one = Instrument("/dev/busway-none", 1, close_port_after_each_call=True)
    with pytest.raises(minimalmodbus.MasterReportedException):
        one.read_register(0)
