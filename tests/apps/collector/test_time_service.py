"""What the kernel says of the clock, and what follows: a container, a virtual machine, a plant without time service."""

import ctypes
from types import SimpleNamespace
from typing import Any

import pytest

from busway.apps.collector import time_service
from busway.apps.collector.time_service import (
    SETTLES,
    ClockJudge,
    ClockTrust,
    Synchronisation,
    kernel_synchronisation,
    seconds_since_boot,
    trust_of,
)
from busway.errors import ConfigError

YES, NO, UNKNOWN = Synchronisation.YES, Synchronisation.NO, Synchronisation.UNKNOWN
DAY = 86_400.0


def judged(trust: ClockTrust, *said: tuple[Synchronisation, float]) -> list[bool]:
    judge = ClockJudge(trust)
    return [judge.is_known(says, now) for says, now in said]


def test_after_a_start_of_the_machine_the_clock_is_right_once_the_kernel_says_so() -> None:
    assert judged("auto", (NO, 20.0), (NO, 25.0), (YES, 30.0), (YES, DAY)) == [False, False, True, True]


def test_a_plant_without_time_service_is_not_uncertain_for_ever() -> None:
    assert judged("auto", (NO, 20.0), (NO, SETTLES - 1), (NO, SETTLES), (NO, DAY)) == [False, False, True, True]


def test_a_container_or_a_machine_that_has_run_for_long_is_believed_whatever_the_kernel_says() -> None:
    assert judged("auto", (NO, DAY), (NO, 2 * DAY)) == [True, True]


def test_a_time_service_that_is_lost_counts_after_a_while_and_its_restart_does_not() -> None:
    restarted = ((YES, 0.0), (NO, DAY), (NO, DAY + SETTLES - 1), (YES, DAY + SETTLES))
    assert judged("auto", *restarted) == [True] * 4
    lost = ((YES, 0.0), (NO, DAY), (NO, DAY + SETTLES), (NO, 2 * DAY), (YES, 3 * DAY), (NO, 3 * DAY + 5))
    assert judged("auto", *lost) == [True, True, False, False, True, True]


def test_where_the_kernel_cannot_be_asked_the_clock_is_believed() -> None:
    assert judged("auto", (UNKNOWN, 5.0), (UNKNOWN, DAY)) == [True, True]


def test_an_option_believes_always_or_only_what_the_kernel_confirms() -> None:
    said = ((NO, 5.0), (UNKNOWN, DAY), (NO, 2 * DAY), (YES, 3 * DAY))
    assert judged("trusted", *said) == [True] * 4
    assert judged("synchronised", *said) == [False, False, False, True]


def test_the_environment_says_how_far_the_clock_is_trusted_where_the_file_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("BUSWAY_CLOCK")
    assert (trust_of(None), trust_of("trusted")) == ("auto", "trusted")
    monkeypatch.setenv("BUSWAY_CLOCK", "synchronised")
    assert (trust_of(None), trust_of("auto")) == ("synchronised", "auto")
    monkeypatch.setenv("BUSWAY_CLOCK", "yes")
    with pytest.raises(ConfigError, match="BUSWAY_CLOCK: must be auto, synchronised, trusted, not 'yes'"):
        trust_of(None)


def test_the_kernel_of_this_machine_can_be_asked() -> None:
    assert kernel_synchronisation() in set(Synchronisation)
    assert seconds_since_boot() > 0


@pytest.mark.parametrize(
    ("code", "status", "said"),
    [(0, 0x2001, YES), (5, 0x0040, NO), (5, 0x2041, NO), (5, 0x1001, YES), (-1, 0x0000, UNKNOWN)],
)
def test_the_status_bit_decides_and_not_what_else_the_kernel_complains_of(
    monkeypatch: pytest.MonkeyPatch, code: int, status: int, said: Synchronisation
) -> None:
    def adjtimex(found: Any) -> int:
        found._obj.status = status
        assert found._obj.modes == 0, "nothing is set"
        return code

    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(adjtimex=adjtimex))
    assert kernel_synchronisation() is said


def test_another_system_has_no_such_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_service.ctypes, "CDLL", lambda name: SimpleNamespace())
    assert kernel_synchronisation() is UNKNOWN
