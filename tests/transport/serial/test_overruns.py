"""Characters that a port has lost, seen by its counters: a fake driver counts."""

import struct

import pytest
from fake_port import FakeDriver, Pty

from busway.errors import LinkDown
from busway.options.ports import SerialSettings
from busway.transport.serial.blocking import BlockingSerialPort
from busway.transport.serial.driver_counters import TIOCGICOUNT, DriverCounters
from busway.transport.serial.overruns import Overruns


def counting(counters: list[DriverCounters | LinkDown | None]) -> Overruns:
    """What a driver says, one after the other."""

    def read() -> DriverCounters | None:
        said = counters.pop(0)
        if isinstance(said, LinkDown):
            raise said
        return said

    return Overruns(read)


@pytest.mark.clause("S16")
def test_a_loss_in_the_port_or_in_the_buffer_is_seen_once() -> None:
    overruns = counting(
        [
            DriverCounters(overruns=7),
            DriverCounters(overruns=7, received=100),
            DriverCounters(overruns=8),
            DriverCounters(overruns=8),
            DriverCounters(overruns=8, buffer_overruns=1),
        ]
    )
    assert [overruns.more() for _ in range(4)] == [False, True, False, True]


def test_a_port_that_counts_nothing_is_asked_once() -> None:
    overruns = counting([None])
    assert not overruns.more()
    assert not overruns.more()


def test_a_port_that_has_gone_has_lost_nothing_here() -> None:
    overruns = counting([DriverCounters(overruns=1), LinkDown("gone"), DriverCounters(overruns=2)])
    assert not overruns.more()
    assert overruns.more()
    assert not counting([LinkDown("gone")]).more()


@pytest.mark.clause("S16")
def test_the_counters_of_a_driver_are_what_is_looked_at(pty: Pty) -> None:
    driver, lost = FakeDriver(), [0]
    driver.answers[TIOCGICOUNT] = lambda buffer: struct.pack_into("11i", buffer, 0, *[0] * 7, lost[0], 0, 0, 0)
    with BlockingSerialPort(pty.path, SerialSettings(), ioctl=driver) as port:
        overruns = Overruns(port.counters)
        assert not overruns.more()
        lost[0] = 3
        assert overruns.more()
        assert not overruns.more()
