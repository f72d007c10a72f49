"""RTS of an RS-485 port under asyncio: when it goes to sending and back, on real pseudo-terminals."""

import asyncio
import errno
import os
import time

import pytest
from fake_port import FakeDriver, Pty
from heard_connection import closed, connected

from busway.options.ports import Rs485, SerialSettings
from busway.transport.serial.rs485 import TIOCMBIC, TIOCMBIS


class SwitchedDriver(FakeDriver):
    """Notes when RTS went up and down."""

    def __init__(self) -> None:
        super().__init__()
        self.switched: list[tuple[str, float]] = []
        self.down_again = asyncio.Event()
        self.answers = {TIOCMBIS: self.up, TIOCMBIC: self.down}

    def up(self, _buffer: bytearray) -> None:
        self.switched.append(("up", time.monotonic()))

    def down(self, _buffer: bytearray) -> None:
        self.switched.append(("down", time.monotonic()))
        self.down_again.set()


@pytest.mark.parametrize("delay", [0.0, 0.002])
async def test_rts_is_up_from_before_the_first_until_after_the_last_character(pty: Pty, delay: float) -> None:
    driver = SwitchedDriver()
    settings = SerialSettings(baud=115_200, rs485=Rs485.RTS, delay_before_send=delay, delay_after_send=delay)
    connection, _ = await connected(pty, settings, ioctl=driver)
    driver.switched.clear()
    driver.down_again.clear()
    begun = time.monotonic()
    connection.write(bytes(10))
    until = connection.write(bytes(10))  # a second write does not switch again
    assert until >= begun + delay + 20 * settings.character_time
    await driver.down_again.wait()
    assert [word for word, _ in driver.switched] == ["up", "down"]
    assert driver.switched[1][1] >= until + delay
    assert len(os.read(pty.near, 100)) == 20
    await closed(connection)


async def test_a_close_while_rts_is_up_takes_it_down_and_leaves_no_timer_behind(pty: Pty) -> None:
    driver = SwitchedDriver()
    settings = SerialSettings(rs485=Rs485.RTS, delay_before_send=0.01)
    connection, _ = await connected(pty, settings, ioctl=driver)
    connection.write(b"x")
    assert connection.held() >= 1
    await closed(connection)
    assert [word for word, _ in driver.switched] == ["down", "up", "down"]


async def test_a_driver_that_is_gone_while_rts_is_up_is_a_lost_port(pty: Pty) -> None:
    driver = SwitchedDriver()
    connection, ears = await connected(pty, SerialSettings(baud=1_000_000, rs485=Rs485.RTS), ioctl=driver)
    connection.write(b"x")
    driver.refusal = errno.EIO
    assert (await ears.end()).sent
    await connection.wait_closed()
    assert len(ears.reasons) == 1
