"""How a port that is not there is waited for."""

from typing import Any

import pytest

from busway.errors import ConfigError, LinkDown
from busway.options.ports import OpeningParameters
from busway.transport.serial.reopen import ReopenPolicy, open_when_there

POLICY = ReopenPolicy(first=0.1, most=1.0)


class Opener:
    """Fails so many times, then gives a port."""

    def __init__(self, failures: int, error: Exception | None = None) -> None:
        self.left = failures
        self.error = error or LinkDown("it is not there")

    def __call__(self) -> str:
        if self.left:
            self.left -= 1
            raise self.error
        return "port"

    async def open(self) -> str:
        return self()


def test_pauses_double_up_to_the_most() -> None:
    assert [POLICY.pause(failures) for failures in (1, 2, 3, 4, 5, 10_000)] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_policy_may_give_up() -> None:
    policy = ReopenPolicy(attempts=3)
    assert policy.pause(2) is not None
    assert policy.pause(3) is None


@pytest.mark.parametrize("values", [{"first": 0.0}, {"first": 2.0, "most": 1.0}, {"most": 1e9}, {"attempts": 0}])
def test_an_impossible_policy_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        ReopenPolicy(**values)  # type: ignore[arg-type]


async def test_a_port_is_waited_for_and_each_failure_told() -> None:
    slept: list[float] = []
    told: list[tuple[str, float]] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    port = await open_when_there(
        Opener(3).open, POLICY, waiting=lambda error, pause: told.append((error.message, pause)), sleep=sleep
    )
    assert port == "port"
    assert slept == [0.1, 0.2, 0.4]
    assert told == [("it is not there", 0.1), ("it is not there", 0.2), ("it is not there", 0.4)]


async def test_what_waiting_does_not_change_is_raised_at_once() -> None:
    refusal = ConfigError("it is no serial port")
    with pytest.raises(ConfigError):
        await open_when_there(Opener(1, refusal).open, POLICY)


async def test_the_last_failure_is_raised_when_it_is_enough() -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    with pytest.raises(LinkDown):
        await open_when_there(Opener(9).open, ReopenPolicy(attempts=3), sleep=sleep)
    assert len(slept) == 2


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"port_wait": -1.0}, "port_wait"),
        ({"reopen_first": 0.0}, "reopen_first"),
        ({"reopen_first": 3.0, "reopen_most": 2.0}, "reopen_most"),
    ],
)
def test_impossible_settings_are_refused_under_their_own_names(options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        OpeningParameters(**options)
    assert caught.value.key == key


def test_pauses_of_the_options_double_up_to_the_longest() -> None:
    policy = ReopenPolicy.of(OpeningParameters(reopen_first=0.1, reopen_most=0.3))
    assert [policy.pause(failures) for failures in (1, 2, 3, 50)] == pytest.approx([0.1, 0.2, 0.3, 0.3])
