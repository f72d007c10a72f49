"""A port under asyncio, on real pseudo-terminals."""

import errno
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fake_port import FakeDriver, Pty
from handles import settled_handles
from heard_connection import FAST, Ears, closed, connected

from busway.errors import ConfigError, LinkDown
from busway.options.ports import Rs485, SerialSettings
from busway.transport.serial.connection import SerialConnection
from busway.transport.serial.driver_counters import TIOCGICOUNT, DriverCounters
from busway.transport.serial.end_of_sending import TIOCOUTQ


async def test_bytes_go_both_ways_whole(pty: Pty) -> None:
    every = bytes(range(256))
    connection, ears = await connected(pty)
    os.write(pty.near, every)
    assert await ears.heard(256) == every
    assert ears.errors == 0
    connection.write(every)
    await connection.drain()
    assert os.read(pty.near, 1000) == every
    await closed(connection)
    assert ears.reasons == []


async def test_a_write_tells_when_its_last_character_has_left(pty: Pty) -> None:
    settings = SerialSettings(baud=19_200)
    connection, _ = await connected(pty, settings)
    begun = time.monotonic()
    first = connection.write(bytes(8))
    second = connection.write(bytes(2))
    assert first >= begun + 8 * settings.character_time
    assert second == pytest.approx(first + 2 * settings.character_time)
    assert connection.sent_at == second
    assert await connection.drain() == second
    assert time.monotonic() >= second
    await closed(connection)


async def test_drain_waits_for_what_the_driver_still_holds(pty: Pty) -> None:
    driver = FakeDriver()
    holding = [5, 2, 0]
    driver.answers[TIOCOUTQ] = lambda buffer: struct.pack_into("i", buffer, 0, holding.pop(0))
    connection, _ = await connected(pty, ioctl=driver)
    begun = time.monotonic()
    connection.write(b"x")
    assert await connection.drain() >= begun + 7 * FAST.character_time
    assert holding == []
    await closed(connection)


async def test_the_counters_come_from_the_driver(pty: Pty) -> None:
    driver = FakeDriver()
    driver.answers[TIOCGICOUNT] = lambda buffer: struct.pack_into("11i", buffer, 0, *range(11))
    connection, _ = await connected(pty, ioctl=driver)
    assert connection.counters() == DriverCounters(4, 5, 6, 8, 7, 10, 9)
    driver.refusal = errno.EIO
    del driver.answers[TIOCGICOUNT]
    with pytest.raises(LinkDown):
        connection.counters()
    await closed(connection)


async def test_a_port_that_is_taken_names_who_has_it(pty: Pty) -> None:
    connection, _ = await connected(pty)
    with pytest.raises(LinkDown, match="held by this program itself"):
        await connected(pty)
    await closed(connection)
    connection, _ = await connected(pty)
    await closed(connection)


async def test_what_cannot_be_opened_is_ours_to_tell(tmp_path: object) -> None:
    ears = Ears()
    with pytest.raises(LinkDown, match="is not there"):
        await SerialConnection.open(f"{tmp_path}/port", FAST, received=ears.received, lost=ears.lost)
    with pytest.raises(ConfigError, match="/dev/null is not a serial port"):
        await SerialConnection.open("/dev/null", FAST, received=ears.received, lost=ears.lost)
    assert ears.reasons == []


async def test_a_mode_that_the_port_does_not_have_is_refused_and_the_port_given_back(pty: Pty) -> None:
    ears = Ears()
    with pytest.raises(ConfigError, match="no RS-485 mode"):
        await SerialConnection.open(
            pty.path, SerialSettings(rs485=Rs485.KERNEL), received=ears.received, lost=ears.lost
        )
    assert ears.reasons == []
    connection, _ = await connected(pty)
    await closed(connection)


async def test_a_port_that_vanishes_is_told_once(pty: Pty) -> None:
    connection, ears = await connected(pty)
    pty.vanish()
    assert "is lost" in str(await ears.end())
    await connection.wait_closed()
    assert not connection.is_open
    assert len(ears.reasons) == 1
    with pytest.raises(LinkDown, match="is closed"):
        connection.write(b"x")
    connection.close()  # does no harm


async def test_a_closed_connection_says_so(pty: Pty) -> None:
    connection, ears = await connected(pty)
    await closed(connection)
    connection.close()
    for use in (lambda: connection.write(b"x"), connection.held, connection.counters):
        with pytest.raises(LinkDown, match="is closed"):
            use()
    with pytest.raises(LinkDown, match="is closed"):
        await connection.drain()
    assert connection.sent_at == 0.0
    assert ears.reasons == []


async def test_handles_stay_as_many_over_200_openings_and_losses(pty: Pty, tmp_path: Path) -> None:
    connection, _ = await connected(pty)  # what is made once is made
    await closed(connection)
    shared = SerialSettings(baud=1_000_000, exclusive=False)
    before = settled_handles()
    for cycle in range(200):
        other = Pty(tmp_path / "ttyUSB0")
        connection, ears = await connected(other, shared)
        if cycle % 2:
            other.vanish()
            await ears.end()
            await connection.wait_closed()
        else:
            await closed(connection)
        other.close()
        with pytest.raises(LinkDown):
            await connected(other, shared)
    assert settled_handles() < before + 50  # one that is lost at each opening, or at each loss, would make 100


def test_serialx_is_imported_only_when_a_port_is_opened() -> None:
    program = "import sys, busway.transport.serial; sys.exit('serialx' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
