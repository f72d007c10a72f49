import pytest

from busway.apps.fleet.lease_times import Epoch, LeaseTimes
from busway.errors import ConfigError


def test_a_holder_ends_a_guard_before_and_another_begins_a_guard_after() -> None:
    times = LeaseTimes(ttl=15, renew=3, guard=1)
    assert times.deadline(100.0) == 114.0
    assert times.free_at(100.0) == 116.0


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"ttl": 2}, "3…300 s, not 2"),
        ({"ttl": 9, "renew": 3.1}, "at least three times"),
        ({"guard": 0.1}, "the guard is 0.15…3.75 s"),
        ({"answer": 6}, "up to 5 s"),
    ],
)
def test_times_that_cannot_keep_two_owners_apart_are_refused(wrong: dict[str, float], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        LeaseTimes(**wrong)


def test_a_generation_outweighs_every_revision() -> None:
    assert Epoch(2, 1) > Epoch(1, 10_000)
    assert str(Epoch(2, 17)) == "2.17"
