"""A port for a thread that waits, on real pseudo-terminals."""

import errno
import os
import struct
import time
from pathlib import Path

import pytest
from fake_port import FakeDriver, Pty, taken
from handles import settled_handles

from busway.errors import ConfigError, LinkDown
from busway.options.ports import Parity, Rs485, SerialSettings
from busway.transport.serial import blocking
from busway.transport.serial.blocking import BlockingSerialPort
from busway.transport.serial.driver_counters import TIOCGICOUNT, DriverCounters
from busway.transport.serial.end_of_sending import TIOCOUTQ
from busway.transport.serial.lock import TIOCEXCL, TIOCNXCL
from busway.transport.serial.rs485 import TIOCMBIC, TIOCMBIS

FAST = SerialSettings(baud=1_000_000)


def test_bytes_go_both_ways_whole(pty: Pty) -> None:
    every = bytes(range(256))
    with BlockingSerialPort(pty.path, FAST) as port:
        os.write(pty.near, every)
        received = b""
        while len(received) < len(every):
            data, errors = port.read(5.0)
            received += data
            assert errors == 0
        assert received == every
        port.write(every)
        assert os.read(pty.near, 1000) == every


@pytest.mark.parametrize("parity", list(Parity))
@pytest.mark.parametrize("data_bits", [7, 8])
def test_on_a_pseudo_terminal_parity_and_data_bits_only_set_the_times(pty: Pty, parity: Parity, data_bits: int) -> None:
    settings = SerialSettings(baud=115_200, parity=parity, data_bits=data_bits)
    with BlockingSerialPort(pty.path, settings) as port:
        assert port.pseudo_terminal
        before = time.monotonic()
        until = port.write(b"\xff\x00\xff")
        assert until - before >= 3 * settings.character_time
        assert os.read(pty.near, 10) == b"\xff\x00\xff"


def test_marks_are_off_where_they_are_not_wanted(pty: Pty) -> None:
    with BlockingSerialPort(pty.path, SerialSettings(mark_errors=False)) as port:
        os.write(pty.near, b"\xff\x01")
        assert port.read(5.0) == (b"\xff\x01", 0)


def test_a_read_ends_when_its_time_is_over(pty: Pty) -> None:
    with BlockingSerialPort(pty.path, FAST) as port:
        begun = time.monotonic()
        assert port.read(0.002) == (b"", 0)
        assert time.monotonic() - begun >= 0.002
        assert port.read(0) == (b"", 0)


def test_drain_waits_for_the_last_character(pty: Pty) -> None:
    settings = SerialSettings(baud=19_200)
    with BlockingSerialPort(pty.path, settings) as port:
        begun = time.monotonic()
        port.write(bytes(10))
        left = port.drain()
        assert time.monotonic() >= left >= begun + 10 * settings.character_time
        assert port.sent_at == left


def test_drain_waits_for_what_the_driver_still_holds_and_not_for_ever(pty: Pty) -> None:
    driver = FakeDriver()
    holding = [5, 2, 0]

    def give_holding(buffer: bytearray) -> None:
        struct.pack_into("i", buffer, 0, holding.pop(0) if len(holding) > 1 else holding[0])

    driver.answers = {TIOCOUTQ: give_holding}
    with BlockingSerialPort(pty.path, FAST, ioctl=driver) as port:
        begun = time.monotonic()
        port.write(b"x")
        assert port.drain() >= begun + 7 * FAST.character_time
        holding[0] = 1
        with pytest.raises(LinkDown, match="did not send within") as failure:
            port.drain(timeout=0.001)
        assert failure.value.sent


def test_rts_is_up_from_before_the_first_until_after_the_last_character(pty: Pty) -> None:
    driver = FakeDriver()
    driver.answers = {TIOCMBIS: taken, TIOCMBIC: taken}
    settings = SerialSettings(baud=115_200, rs485=Rs485.RTS, delay_before_send=0.001, delay_after_send=0.001)
    with BlockingSerialPort(pty.path, settings, ioctl=driver) as port:
        driver.asked.clear()
        begun = time.monotonic()
        until = port.write(bytes(10))
        assert until >= begun + 0.001 + 10 * settings.character_time
        assert time.monotonic() >= until + 0.001
        switched = [request for request in driver.requests() if request in (TIOCMBIS, TIOCMBIC)]
        assert switched == [TIOCMBIS, TIOCMBIC]


def test_rts_is_down_again_where_the_port_takes_no_more_bytes(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocking, "STUCK_AFTER", 0.001)
    driver = FakeDriver()
    driver.answers = {TIOCMBIS: taken, TIOCMBIC: taken}
    with BlockingSerialPort(pty.path, SerialSettings(rs485=Rs485.RTS), ioctl=driver) as port:
        driver.asked.clear()
        with pytest.raises(LinkDown, match="has taken no bytes"):
            port.write(bytes(1_000_000))  # more than a pseudo-terminal holds while its other end is not read
        assert driver.requests() == [TIOCMBIS, TIOCMBIC]


def test_the_counters_come_from_the_driver(pty: Pty) -> None:
    driver = FakeDriver()
    driver.answers[TIOCGICOUNT] = lambda buffer: struct.pack_into("11i", buffer, 0, *range(11))
    with BlockingSerialPort(pty.path, FAST, ioctl=driver) as port:
        assert port.counters() == DriverCounters(4, 5, 6, 8, 7, 10, 9)
    with BlockingSerialPort(pty.path, FAST) as port:
        assert port.counters() is None


def test_others_are_refused_while_it_is_open(pty: Pty) -> None:
    driver = FakeDriver()
    driver.answers = {TIOCEXCL: taken, TIOCNXCL: taken}
    BlockingSerialPort(pty.path, FAST, ioctl=driver).close()
    assert [request for request in driver.requests() if request in (TIOCEXCL, TIOCNXCL)] == [TIOCEXCL, TIOCNXCL]


def test_a_port_that_is_taken_names_who_has_it(pty: Pty) -> None:
    held = rf"held by this program itself \(process {os.getpid()}\)"
    with BlockingSerialPort(pty.path, FAST), pytest.raises(LinkDown, match=held):
        BlockingSerialPort(pty.path, FAST)
    with BlockingSerialPort(pty.path, FAST):
        pass  # it is free again


def test_a_shared_port_may_be_opened_twice(pty: Pty) -> None:
    shared = SerialSettings(exclusive=False)
    with BlockingSerialPort(pty.path, shared), BlockingSerialPort(pty.path, shared):
        pass


def test_a_port_that_is_not_there_is_down(tmp_path: object) -> None:
    with pytest.raises(LinkDown, match="is not there"):
        BlockingSerialPort(f"{tmp_path}/port", FAST)


def test_a_file_that_is_no_port_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="/dev/null is not a serial port"):
        BlockingSerialPort("/dev/null", FAST)


def test_a_mode_that_the_port_does_not_have_is_refused_and_the_port_given_back(pty: Pty) -> None:
    with pytest.raises(ConfigError, match="no RS-485 mode"):
        BlockingSerialPort(pty.path, SerialSettings(rs485=Rs485.KERNEL))
    BlockingSerialPort(pty.path, FAST).close()


def test_a_port_that_vanishes_ends_reads_and_writes(pty: Pty) -> None:
    with BlockingSerialPort(pty.path, FAST) as port:
        pty.vanish()
        with pytest.raises(LinkDown, match="is lost"):
            port.read(5.0)
        with pytest.raises(LinkDown, match="is lost") as failure:
            port.write(b"x")
        assert failure.value.sent


def test_a_port_that_vanishes_for_the_driver_alone_is_lost_too(pty: Pty) -> None:
    driver = FakeDriver()
    with BlockingSerialPort(pty.path, FAST, ioctl=driver) as port:
        driver.refusal = errno.EIO
        with pytest.raises(LinkDown):
            port.counters()
        with pytest.raises(LinkDown):
            port.drain()


def test_a_closed_port_says_so(pty: Pty) -> None:
    port = BlockingSerialPort(pty.path, FAST)
    port.close()
    port.close()
    assert not port.is_open
    for use in (lambda: port.read(0), lambda: port.write(b"x"), port.drain, port.counters):
        with pytest.raises(LinkDown, match="is closed"):
            use()


def test_handles_stay_as_many_over_200_openings_and_losses(pty: Pty, tmp_path: Path) -> None:
    BlockingSerialPort(pty.path, FAST).close()  # what is made once is made
    shared = SerialSettings(baud=1_000_000, exclusive=False)
    before = settled_handles()
    for cycle in range(200):
        other = Pty(tmp_path / "ttyUSB0")
        port = BlockingSerialPort(other.path, shared)
        if cycle % 2:
            other.vanish()
            with pytest.raises(LinkDown):
                port.read(5.0)
        port.close()
        other.close()
        with pytest.raises(LinkDown):
            BlockingSerialPort(other.path, shared)
    assert settled_handles() < before + 50  # one that is lost at each opening, or at each loss, would make 100
