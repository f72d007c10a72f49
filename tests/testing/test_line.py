"""The paced line, in real time over pseudo-terminals, with short frames."""

import asyncio
import os
import threading
import time

import pytest

from busway.errors import LinkDown
from busway.options.ports import SerialSettings
from busway.testing.line import NOISE, PacedLine
from busway.transport.serial import BlockingSerialPort, SerialConnection

pytestmark = pytest.mark.alone

REQUEST = bytes.fromhex("01 03 00 00 00 0A C5 CD")  # read 10 holding registers of unit 1
REPLY = bytes([1, 3, 20]) + bytes(22)

LATE = 0.005
"""Seconds that a shared machine may let a program wait for the processor."""

EARLY = 0.0002
"""Seconds that a handing over may be too early by: the line allows for a pty's own time, which varies."""


def read_exactly(port: BlockingSerialPort, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part, _ = port.read(5.0)
        assert part, f"only {data.hex(' ')} came"
        data += part
    return data


def opened(line: PacedLine, port: int) -> BlockingSerialPort:
    return BlockingSerialPort(line.paths[port], line.settings)


@pytest.mark.parametrize("baud", [9600, 19_200, 115_200])
def test_a_request_and_its_reply_take_the_time_of_their_characters(baud: int) -> None:
    rounds = 5
    with PacedLine(ports=2, baud=baud) as line, opened(line, 0) as master, opened(line, 1) as server:

        def serve() -> None:
            for _ in range(rounds):
                read_exactly(server, len(REQUEST))
                server.write(REPLY)

        thread = threading.Thread(target=serve)
        thread.start()
        taken = []
        for _ in range(rounds):
            begun = time.monotonic()
            master.write(REQUEST)
            assert read_exactly(master, len(REPLY)) == REPLY
            taken.append(time.monotonic() - begun)
        thread.join()
        theory = (len(REQUEST) + len(REPLY)) * line.character_time
        assert min(taken) >= theory - 2 * EARLY
        assert min(taken) <= theory + LATE
        assert line.collisions == line.overruns == 0


def test_the_tap_tells_who_said_what_and_when() -> None:
    with PacedLine(ports=3, baud=19_200) as line, opened(line, 0) as master, opened(line, 2) as listener:
        begun = time.monotonic()
        master.write(REQUEST)
        assert read_exactly(listener, len(REQUEST)) == REQUEST
        heard = time.monotonic()
        line.wait_quiet()
        (transmission,) = line.transmissions()
        assert (transmission.port, transmission.data, transmission.damaged) == (0, REQUEST, 0)
        assert transmission.end - transmission.begin == pytest.approx(8 * line.character_time)
        assert begun - EARLY <= transmission.begin <= heard - 8 * line.character_time + LATE
        assert {byte.heard_by for byte in line.tap} == {(1, 2)}
        line.forget()
        assert line.tap == []


def test_a_long_transmission_arrives_as_it_passes() -> None:
    with PacedLine(ports=2, baud=9600) as line, opened(line, 0) as one, opened(line, 1) as other:
        one.write(bytes(30))
        part, _ = other.read(5.0)
        assert len(part) < 30  # the last one passes 33 ms after the first
        read_exactly(other, 30 - len(part))


def test_a_port_with_an_echo_hears_itself() -> None:
    with PacedLine(ports=2, baud=115_200, echo={0}) as line, opened(line, 0) as one, opened(line, 1) as other:
        one.write(b"echo")
        assert read_exactly(one, 4) == read_exactly(other, 4) == b"echo"
        other.write(b"none")
        assert read_exactly(one, 4) == b"none"
        line.wait_quiet()
        assert other.read(0) == (b"", 0)


def test_two_talkers_at_once_are_counted() -> None:
    with PacedLine(ports=3, baud=9600) as line, opened(line, 0) as one, opened(line, 1) as other:
        one.write(bytes(8))
        other.write(bytes(8))
        line.wait_quiet()
        assert line.collisions >= 8
        assert any(part.damaged for part in line.transmissions())


def test_noise_damages_and_injected_characters_come_from_no_port() -> None:
    with PacedLine(ports=2, baud=115_200, noise=1.0, seed=7) as line, opened(line, 0) as one, opened(line, 1) as other:
        one.write(bytes(4))
        assert 0 not in read_exactly(other, 4)
        line.noise = 0.0
        assert line.noise == 0.0
        line.inject(b"\x55")
        assert read_exactly(other, 1) == b"\x55"
        line.wait_quiet()
        assert line.tap[-1].port == NOISE


def test_a_cut_wire_carries_nothing_until_it_is_mended() -> None:
    with PacedLine(ports=2, baud=115_200) as line, opened(line, 0) as one, opened(line, 1) as other:
        line.cut()
        one.write(b"lost")
        line.wait_quiet()
        assert other.read(0) == (b"", 0)
        line.mend()
        one.write(b"good")
        assert read_exactly(other, 4) == b"good"


@pytest.mark.parametrize("name", [None, "elsewhere"])
def test_a_port_can_be_unplugged_and_comes_back(name: str | None) -> None:
    with PacedLine(ports=2, baud=115_200) as line, opened(line, 0) as one:
        path = line.paths[1]
        port = opened(line, 1)
        line.unplug(1)
        with pytest.raises(LinkDown):
            port.read(5.0)
        port.close()
        assert not os.path.lexists(path)
        with pytest.raises(ValueError, match="already"):
            line.unplug(1)
        one.write(b"unheard")
        back_at = line.replug(1, name)
        assert (back_at == path) is (name is None)
        assert line.paths[1] == back_at
        line.wait_quiet()
        with opened(line, 1) as port:
            one.write(b"heard")
            assert read_exactly(port, 5) == b"heard"
        with pytest.raises(ValueError, match="plugged in"):
            line.replug(1)


def test_a_port_that_is_not_read_overruns_and_the_line_goes_on() -> None:
    with PacedLine(ports=3, baud=12_000_000) as line, opened(line, 0) as one, opened(line, 1) as other:
        for _ in range(100):
            one.write(bytes(1000))
            read_exactly(other, 1000)
        line.wait_quiet()
        assert line.overruns > 0


async def test_two_asyncio_ports_talk_over_it() -> None:
    heard = asyncio.Event()
    data = bytearray()

    def received(part: bytes, _errors: int) -> None:
        data.extend(part)
        if len(data) == len(REQUEST):
            heard.set()

    with PacedLine(ports=2, baud=115_200) as line:
        one = await SerialConnection.open(line.paths[0], line.settings, received=received, lost=pytest.fail)
        other = await SerialConnection.open(line.paths[1], line.settings, received=received, lost=pytest.fail)
        until = one.write(REQUEST)
        await heard.wait()
        assert bytes(data) == REQUEST
        assert time.monotonic() >= until - EARLY
        for port in (one, other):
            port.close()
            await port.wait_closed()


def test_waiting_for_quiet_ends_when_it_does_not_come() -> None:
    with PacedLine(ports=2, baud=9600) as line, opened(line, 0) as one:
        one.write(bytes(100))
        with pytest.raises(TimeoutError, match="was not quiet"):
            line.wait_quiet(timeout=0.005)


def test_a_line_leaves_no_thread_no_handle_and_no_path_behind() -> None:
    handles, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    for _ in range(5):
        line = PacedLine(ports=3)
        path = line.paths[0]
        line.close()
        line.close()
    assert not os.path.lexists(path)
    assert len(os.listdir("/proc/self/fd")) == handles
    assert threading.active_count() == threads
    with pytest.raises(ValueError, match="closed"):
        line.cut()


def test_a_line_takes_its_parity_from_its_arguments_not_from_its_users() -> None:
    with PacedLine(ports=2, baud=9600, parity="none", stop_bits=1) as line:
        assert line.character_time == 10 / 9600
        foreign = SerialSettings(baud=115_200)
        with BlockingSerialPort(line.paths[0], foreign) as one, BlockingSerialPort(line.paths[1], foreign) as other:
            begun = time.monotonic()
            one.write(bytes(5))
            read_exactly(other, 5)
            assert time.monotonic() - begun >= 5 * line.character_time - EARLY
