"""Which port a name means."""

import os

import pytest
from fake_port import Pty

from busway.errors import ConfigError, LinkDown
from busway.transport.serial.ports import FoundPort, is_pseudo_terminal, list_ports, resolve_port

FTDI = FoundPort("/dev/serial/by-id/usb-FTDI_A1", "/dev/ttyUSB0", 0x0403, 0x6001, "A1", "FTDI FT232R")
SECOND_FTDI = FoundPort("/dev/serial/by-id/usb-FTDI_B2", "/dev/ttyUSB1", 0x0403, 0x6001, "B2")
ON_BOARD = FoundPort("/dev/ttyS0", "/dev/ttyS0")


@pytest.mark.parametrize("name", ["/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_A1-if00-port0", "/dev/pts/3"])
def test_a_path_means_itself(name: str) -> None:
    assert resolve_port(name, lambda: pytest.fail("nothing needs to be listed")) == name


@pytest.mark.parametrize("name", ["usb:0403:6001:A1", "/usb:0403:6001:A1", "0403:6001:A1"])
def test_a_usb_identity_means_the_device_wherever_it_is_plugged_in(name: str) -> None:
    assert resolve_port(name, lambda: [ON_BOARD, SECOND_FTDI, FTDI]) == "/dev/serial/by-id/usb-FTDI_A1"


def test_the_serial_number_may_be_left_out_where_one_device_fits() -> None:
    assert resolve_port("usb:0403:6001", lambda: [FTDI, ON_BOARD]) == FTDI.path


def test_an_identity_that_several_devices_have_is_refused_with_the_choices() -> None:
    with pytest.raises(ConfigError, match="usb-FTDI_A1, /dev/serial/by-id/usb-FTDI_B2"):
        resolve_port("usb:0403:6001", lambda: [FTDI, SECOND_FTDI])


def test_a_device_that_is_not_plugged_in_may_come_back() -> None:
    with pytest.raises(LinkDown, match="0403:6001:ZZ"):
        resolve_port("usb:0403:6001:ZZ", lambda: [FTDI])


def test_a_windows_name_may_carry_the_slash_of_a_url() -> None:
    assert resolve_port("/com3") == "COM3"


def test_an_empty_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="missing"):
        resolve_port("")


def test_a_found_port_tells_the_identity_that_opens_it() -> None:
    assert FTDI.identity == "usb:0403:6001:A1"
    assert resolve_port(FTDI.identity, lambda: [FTDI]) == FTDI.path
    assert ON_BOARD.identity is None


def test_the_ports_of_this_machine_are_listed_sorted() -> None:
    paths = [port.path for port in list_ports()]
    assert paths == sorted(paths)


def test_a_pseudo_terminal_is_known_also_through_a_link(pty: Pty, tmp_path: object) -> None:
    link = f"{tmp_path}/port"
    os.symlink(pty.path, link)
    assert is_pseudo_terminal(pty.path)
    assert is_pseudo_terminal(link)


@pytest.mark.parametrize("path", ["/dev/null", "/dev/no-such-port"])
def test_what_is_no_pseudo_terminal_is_known_too(path: str) -> None:
    assert not is_pseudo_terminal(path)
