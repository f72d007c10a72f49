"""The driver's counters, out of the structure that it fills."""

import errno
import struct

import pytest
from fake_port import FakeDriver, giving

from busway.transport.serial.driver_counters import TIOCGICOUNT, DriverCounters, read_counters


def test_each_counter_comes_from_its_place() -> None:
    driver = FakeDriver()
    # cts dsr rng dcd rx tx frame overrun parity brk buf_overrun
    driver.answers[TIOCGICOUNT] = giving(struct.pack("11i", 1, 2, 3, 4, 500, 600, 7, 8, 9, 10, 11))
    assert read_counters(3, driver) == DriverCounters(
        received=500, sent=600, framing_errors=7, parity_errors=9, overruns=8, buffer_overruns=11, breaks=10
    )
    assert len(driver.asked[0][1]) == 80


def test_a_driver_that_keeps_none_has_none() -> None:
    assert read_counters(3, FakeDriver()) is None


def test_a_port_that_is_gone_is_not_one_without_counters() -> None:
    with pytest.raises(OSError, match="not offered"):
        read_counters(3, FakeDriver(errno.EIO))


def test_the_difference_of_two_readings_is_what_happened_between() -> None:
    earlier = DriverCounters(received=10, parity_errors=1)
    later = DriverCounters(received=25, sent=8, parity_errors=3, breaks=1)
    assert later.since(earlier) == DriverCounters(received=15, sent=8, parity_errors=2, breaks=1)
