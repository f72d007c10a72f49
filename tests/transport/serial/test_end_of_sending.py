"""When the last character has left."""

import struct

import pytest
from fake_port import FakeDriver, giving

from busway.transport.serial.end_of_sending import TIOCOUTQ, TIOCSERGETLSR, EndOfSending, characters_held


def test_characters_leave_one_after_the_other() -> None:
    end_of_sending = EndOfSending(0.001)
    assert end_of_sending.written(8, now=100.0) == pytest.approx(100.008)
    assert end_of_sending.written(2, now=100.001) == pytest.approx(100.010)  # behind the first eight
    assert end_of_sending.written(1, now=200.0) == pytest.approx(200.001)  # the line was idle


def test_what_the_system_still_holds_makes_it_later_and_never_earlier() -> None:
    end_of_sending = EndOfSending(0.001)
    end_of_sending.written(8, now=100.0)
    assert end_of_sending.still_held(3, now=100.008) == pytest.approx(100.011)
    assert end_of_sending.still_held(1, now=100.001) == pytest.approx(100.011)
    assert end_of_sending.still_held(0, now=100.1) == pytest.approx(100.011)


@pytest.mark.parametrize(
    ("waiting", "state", "held"),
    [
        (5, 0, 5),
        (0, 0, 1),  # the last character is still being sent
        (0, 1, 0),
    ],
)
def test_the_character_in_the_transmitter_counts(waiting: int, state: int, held: int) -> None:
    driver = FakeDriver()
    driver.answers = {TIOCOUTQ: giving(struct.pack("i", waiting)), TIOCSERGETLSR: giving(struct.pack("i", state))}
    assert characters_held(3, driver) == held


def test_a_driver_that_tells_nothing_holds_nothing() -> None:
    assert characters_held(3, FakeDriver()) == 0
