"""The implementation classes of a serial line, row by row (Serial Line V1.02 chapter 5), for master and servers.

Basic: addresses, broadcast, 9600 and 19 200 bit/s, even parity, RTU. Regular: all of it configurable, and ASCII. What a
line is set to where nothing is said is the column of defaults. Electrical interface and connector are the port's.
"""

from collections.abc import Iterator

import pytest
from whole_frames import line_of_whole_frames

import busway
from busway.client.settings import link_settings
from busway.errors import ConfigError, InvalidRequest, NoReply
from busway.options.endpoints import parse_endpoint
from busway.options.ports import SerialSettings
from busway.options.server import ListenerParameters
from busway.server.listener import Listener
from busway.server.listener_settings import listener_settings
from busway.testing.line import PacedLine

pytestmark = pytest.mark.clause("S18")

PORT = "/dev/ttyUSB0"


def of_master(url: str) -> SerialSettings:
    """What the port of a link is set to."""
    line = link_settings(url, {}).line
    assert line is not None
    assert line.port is not None
    return line.port


def of_servers(url: str) -> SerialSettings:
    """What the port of a listener is set to."""
    port = listener_settings(Listener(url), limits=ListenerParameters()).port
    assert port is not None
    return port


ROLES = pytest.mark.parametrize("settings_of", [of_master, of_servers], ids=["master", "servers"])


@pytest.fixture
def line() -> Iterator[PacedLine]:
    with line_of_whole_frames(ports=2, baud=19_200) as made:
        yield made


# Addressing and broadcast: both classes.


@pytest.mark.parametrize("unit", [1, 2, 127, 246, 247])
@pytest.mark.real_time
def test_a_server_has_any_address_of_1_to_247_and_the_master_reaches_it(line: PacedLine, unit: int) -> None:
    device = busway.Device(holding_registers=[unit])
    with (
        busway.serve_in_thread(f"rtu://{line.paths[1]}", units={unit: device}),
        busway.connect(f"rtu://{line.paths[0]}") as link,
    ):
        assert link.unit(unit).read_holding_registers(0, count=1) == [unit]


@pytest.mark.real_time
def test_every_address_of_1_to_247_can_be_one_servers_of_a_line(line: PacedLine) -> None:
    devices = {unit: busway.Device(holding_registers=[unit]) for unit in range(1, 248)}
    with (
        busway.serve_in_thread(f"rtu://{line.paths[1]}", units=devices),
        busway.connect(f"rtu://{line.paths[0]}") as link,
    ):
        for unit in (1, 100, 247):
            assert link.unit(unit).read_holding_registers(0, count=1) == [unit]


@pytest.mark.parametrize("unit", [248, 255])
@pytest.mark.real_time
def test_the_reserved_addresses_belong_to_no_unit_and_are_not_asked(line: PacedLine, unit: int) -> None:
    with busway.connect(f"rtu://{line.paths[0]}") as link, pytest.raises(InvalidRequest):
        link.unit(unit).read_holding_registers(0, count=1)
    assert line.tap == []
    with pytest.raises(ConfigError):
        busway.serve(f"rtu://{PORT}", units={unit: busway.Device(coils=1)})


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.real_time
def test_a_broadcast_reaches_every_server_and_none_answers(framing: str) -> None:
    devices = {1: busway.Device(holding_registers=2), 247: busway.Device(holding_registers=2)}
    with line_of_whole_frames(ports=2, baud=19_200, data_bits=8 if framing == "rtu" else 7) as line:
        with (
            busway.serve_in_thread(f"{framing}://{line.paths[1]}", units=devices),
            busway.connect(f"{framing}://{line.paths[0]}") as link,
        ):
            link.unit(0).write_single_register(1, 77)
            assert link.unit(247).read_holding_registers(1, count=1) == [77]
            assert link.unit(1).read_holding_registers(1, count=1) == [77]
        senders = [sent.port for sent in line.transmissions()]
    assert senders == [0, 0, 1, 0, 1]


# Rates.


@pytest.mark.parametrize("baud", [9600, 19_200])
@pytest.mark.real_time
def test_9600_and_19200_are_there_in_both_classes(baud: int) -> None:
    with (
        line_of_whole_frames(ports=2, baud=baud) as line,
        busway.serve_in_thread(f"rtu://{line.paths[1]}?baud={baud}", units={1: busway.Device(holding_registers=[5])}),
        busway.connect(f"rtu://{line.paths[0]}?baud={baud}") as link,
    ):
        assert link.unit(1).read_holding_registers(0, count=1) == [5]


@ROLES
@pytest.mark.parametrize("baud", [1200, 2400, 4800, 38_400, 57_600, 115_200])
def test_other_rates_can_be_configured_in_the_regular_class(settings_of: object, baud: int) -> None:
    assert callable(settings_of)
    assert settings_of(f"rtu://{PORT}?baud={baud}").baud == baud
    assert settings_of(f"ascii://{PORT}?baud={baud}").baud == baud


# Parity.


@ROLES
@pytest.mark.parametrize(
    ("parity", "rtu", "ascii"), [("even", "8E1", "7E1"), ("odd", "8O1", "7O1"), ("none", "8N2", "7N2")]
)
def test_even_parity_is_there_in_both_classes_and_odd_and_none_in_the_regular_one(
    settings_of: object, parity: str, rtu: str, ascii: str
) -> None:
    assert callable(settings_of)
    assert str(settings_of(f"rtu://{PORT}?parity={parity}")) == f"19200 {rtu}"
    assert str(settings_of(f"ascii://{PORT}?parity={parity}")) == f"19200 {ascii}"


# Mode.


@pytest.mark.parametrize(("framing", "data_bits"), [("rtu", 8), ("ascii", 7)])
@pytest.mark.real_time
def test_rtu_is_there_in_both_classes_and_ascii_in_the_regular_one(framing: str, data_bits: int) -> None:
    with (
        line_of_whole_frames(ports=2, baud=19_200, data_bits=data_bits) as line,
        busway.serve_in_thread(f"{framing}://{line.paths[1]}", units={9: busway.Device(holding_registers=[6])}),
        busway.connect(f"{framing}://{line.paths[0]}") as link,
    ):
        assert link.unit(9).read_holding_registers(0, count=1) == [6]
        with pytest.raises(NoReply):
            link.unit(8).read_holding_registers(0, count=1, timeout=0.1, retries=0)


def test_the_mode_of_a_line_is_always_said() -> None:
    """So that no user gets another one than was meant; RTU, the document's default, is what its scheme names."""
    assert parse_endpoint(f"rtu://{PORT}").framing == "rtu"
    with pytest.raises(ConfigError, match="unknown scheme"):
        parse_endpoint(f"serial://{PORT}")
    with pytest.raises(ConfigError, match="no endpoint"):
        parse_endpoint(PORT)


# Defaults.


@ROLES
def test_19200_even_one_stop_bit_is_what_a_line_has_if_nothing_is_said(settings_of: object) -> None:
    assert callable(settings_of)
    assert str(settings_of(f"rtu://{PORT}")) == "19200 8E1"
    assert str(settings_of(f"ascii://{PORT}")) == "19200 7E1"


# Electrical interface: what of it a program can set.


@ROLES
@pytest.mark.parametrize("rs485", ["off", "kernel", "rts", "automatic"])
def test_two_wire_four_wire_and_rs232_lines_are_served_by_switching_the_direction(
    settings_of: object, rs485: str
) -> None:
    assert callable(settings_of)
    assert settings_of(f"rtu://{PORT}?rs485={rs485}").rs485.value == rs485
