"""Direction control, against a fake driver that holds what the kernel's structure says."""

import errno
import struct

import pytest
from fake_port import FakeDriver, taken

from busway.errors import ConfigError
from busway.options.ports import Echo, Rs485, SerialSettings
from busway.transport.serial.rs485 import (
    TIOCGRS485,
    TIOCMBIC,
    TIOCMBIS,
    TIOCSRS485,
    DriverDirection,
    set_rts,
    settle_direction,
)


def kernel_driver(*, longest_delay_ms: int = 100, flags_kept: int = 0xFFFF) -> FakeDriver:
    """A driver with the RS-485 mode, which takes what it can and gives back what it took."""
    driver = FakeDriver()
    held = bytearray(32)

    def take(buffer: bytearray) -> None:
        flags, before, after = struct.unpack_from("III", buffer)
        struct.pack_into(
            "III", held, 0, flags & flags_kept, min(before, longest_delay_ms), min(after, longest_delay_ms)
        )

    def give(buffer: bytearray) -> None:
        buffer[:] = held

    driver.answers = {TIOCSRS485: take, TIOCGRS485: give}
    return driver


def test_nothing_is_asked_where_this_program_does_not_switch() -> None:
    driver = FakeDriver()
    assert settle_direction(3, SerialSettings(), driver) is DriverDirection.NONE
    assert driver.asked == []


def test_the_kernel_mode_gets_levels_and_delays_in_whole_milliseconds() -> None:
    driver = kernel_driver()
    settings = SerialSettings(rs485=Rs485.KERNEL, delay_before_send=0.0011, delay_after_send=0.02)
    assert settle_direction(3, settings, driver) is DriverDirection.KERNEL
    request, structure = driver.asked[0]
    assert request == TIOCSRS485
    assert len(structure) == 32
    # enabled, RTS high on send; 2 ms and 20 ms
    assert structure == struct.pack("III20x", 0b00011, 2, 20)


def test_inverted_levels_and_an_echo_reach_the_kernel() -> None:
    driver = kernel_driver()
    settings = SerialSettings(rs485=Rs485.KERNEL, rts_on_send=False, rts_after_send=True, echo=Echo.ON)
    settle_direction(3, settings, driver)
    # enabled, RTS high after send, receive while sending
    assert struct.unpack_from("I", driver.asked[0][1])[0] == 0b10101


@pytest.mark.parametrize("refusal", [errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_driver_without_the_mode_is_switched_by_rts_where_that_is_left_open(refusal: int) -> None:
    driver = FakeDriver(refusal)
    driver.answers[TIOCMBIC] = taken
    assert settle_direction(3, SerialSettings(rs485=Rs485.AUTOMATIC), driver) is DriverDirection.RTS
    assert driver.requests() == [TIOCSRS485, TIOCMBIC]


def test_a_driver_that_only_pretends_to_take_the_mode_is_switched_by_rts() -> None:
    driver = kernel_driver(flags_kept=0)
    driver.answers[TIOCMBIC] = taken
    assert settle_direction(3, SerialSettings(rs485=Rs485.AUTOMATIC), driver) is DriverDirection.RTS


def test_a_driver_without_the_mode_is_an_error_where_the_mode_is_asked_for() -> None:
    with pytest.raises(ConfigError, match="no RS-485 mode") as refusal:
        settle_direction(3, SerialSettings(rs485=Rs485.KERNEL), FakeDriver())
    assert refusal.value.key == "rs485"


def test_a_delay_that_the_driver_shortens_is_an_error_that_says_what_it_takes() -> None:
    with pytest.raises(ConfigError, match=r"0\.1 seconds at most") as refusal:
        settle_direction(3, SerialSettings(rs485=Rs485.KERNEL, delay_after_send=0.5), kernel_driver())
    assert refusal.value.key == "delay_after_send"


def test_levels_that_the_driver_turns_round_are_an_error() -> None:
    with pytest.raises(ConfigError, match="levels"):
        settle_direction(3, SerialSettings(rs485=Rs485.KERNEL), kernel_driver(flags_kept=0b00001))


def test_a_port_that_vanishes_meanwhile_is_no_missing_mode() -> None:
    with pytest.raises(OSError, match="not offered"):
        settle_direction(3, SerialSettings(rs485=Rs485.AUTOMATIC), FakeDriver(errno.EIO))


def test_rts_is_raised_and_lowered_alone() -> None:
    driver = FakeDriver()
    driver.answers = {TIOCMBIS: taken, TIOCMBIC: taken}
    assert set_rts(3, True, driver)
    assert set_rts(3, False, driver)
    assert driver.asked == [(TIOCMBIS, struct.pack("i", 4)), (TIOCMBIC, struct.pack("i", 4))]


def test_a_port_without_an_rts_wire_says_so() -> None:
    assert not set_rts(3, True, FakeDriver())
