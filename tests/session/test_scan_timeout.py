"""How long a scan waits for units that may not be there."""

import pytest

from busway.framing.character_times import SerialTiming
from busway.session.scan_timeout import FACTOR, ScanTimeout, floor_for


def test_the_longest_time_holds_until_a_unit_has_answered() -> None:
    timeout = ScanTimeout(1.0, 0.1)
    assert timeout.timeout == 1.0
    timeout.answered(0.05)
    assert timeout.timeout == pytest.approx(FACTOR * 0.05)


def test_the_slowest_answer_counts() -> None:
    timeout = ScanTimeout(1.0, 0.1)
    for seconds in (0.05, 0.2, 0.03):
        timeout.answered(seconds)
    assert timeout.slowest == 0.2
    assert timeout.timeout == pytest.approx(0.8)


def test_it_stays_between_floor_and_longest() -> None:
    timeout = ScanTimeout(1.0, 0.1)
    timeout.answered(0.001)
    assert timeout.timeout == 0.1
    timeout.answered(0.9)
    assert timeout.timeout == 1.0


def test_a_floor_above_the_longest_time_gives_way() -> None:
    timeout = ScanTimeout(0.05, 0.1)
    timeout.answered(0.001)
    assert timeout.timeout == 0.05


def test_a_late_reply_ends_the_shortening_for_good() -> None:
    timeout = ScanTimeout(1.0, 0.1)
    timeout.answered(0.01)
    timeout.late()
    timeout.answered(0.02)
    assert timeout.timeout == 1.0


def test_shortening_can_be_switched_off() -> None:
    timeout = ScanTimeout(1.0, 0.1, learns=False)
    timeout.answered(0.01)
    assert timeout.timeout == 1.0


def test_slow_lines_have_a_higher_floor() -> None:
    assert floor_for(0.0) == pytest.approx(0.1)
    assert floor_for(SerialTiming.of_line(1200).character) == pytest.approx(0.1 + 32 * 11 / 1200)
