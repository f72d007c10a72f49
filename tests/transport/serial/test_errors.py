"""What goes wrong with ports, in our words."""

import errno

import pytest
from serialx import UnsupportedSetting

from busway.errors import ConfigError, LinkDown
from busway.transport.serial.errors import opening_failed, port_lost


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENOENT, LinkDown, "is not there"),
        (errno.ENXIO, LinkDown, "is not there"),
        (errno.EACCES, LinkDown, "dialout"),
        (errno.EBUSY, LinkDown, "held by another program"),
        (errno.EMFILE, LinkDown, "no file handles"),
        (errno.ENOTTY, ConfigError, "is not a serial port"),
        (errno.EINVAL, ConfigError, "cannot be set to 19200 8E1"),
    ],
)
def test_an_error_of_the_system_while_opening_is_ours(number: int, kind: type[Exception], words: str) -> None:
    foreign = OSError(number, "system")
    ours = opening_failed(foreign, port="/dev/no-such-port", settings="19200 8E1")
    assert type(ours) is kind
    assert words in str(ours)
    assert "/dev/no-such-port" in str(ours)
    assert ours.__cause__ is foreign


def test_a_setting_that_the_platform_does_not_have_is_a_configuration_error() -> None:
    ours = opening_failed(UnsupportedSetting("Unsupported baudrate 31250"), port="/dev/ttyS0", settings="31250 8E1")
    assert isinstance(ours, ConfigError)
    assert "31250" in str(ours)


def test_a_port_that_vanished_says_so_and_whether_bytes_may_have_left() -> None:
    foreign = OSError(errno.EIO, "Input/output error")
    ours = port_lost(foreign, port="/dev/ttyUSB0", sent=True)
    assert ours.sent
    assert ours.__cause__ is foreign
    assert str(ours) == "/dev/ttyUSB0 is lost: the device was unplugged or its other end closed"
    assert str(port_lost(None, port="/dev/ttyUSB0")) == str(ours)
