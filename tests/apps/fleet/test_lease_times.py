import pytest

from busway.apps.fleet.lease_times import LeaseTimes
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


@pytest.mark.parametrize(
    ("ttl", "expected"),
    [
        (15.0, LeaseTimes()),
        (60.0, LeaseTimes(ttl=60.0, renew=12.0, guard=4.0, answer=10.0)),
        (3.0, LeaseTimes(ttl=3.0, renew=0.6, guard=0.2, answer=0.5)),
        (300.0, LeaseTimes(ttl=300.0, renew=60.0, guard=20.0, answer=50.0)),
    ],
)
def test_leases_that_hold_longer_have_all_times_in_proportion(ttl: float, expected: LeaseTimes) -> None:
    assert LeaseTimes.lasting(ttl) == expected
    assert LeaseTimes.lasting(ttl, 0.5 * expected.guard).guard == 0.5 * expected.guard


def test_two_renewals_may_fail_before_the_longest_transaction_may_not_begin() -> None:
    times = LeaseTimes()
    assert times.longest_transaction == 8.0
    assert times.deadline(100.0) - times.longest_transaction == 100.0 + 2 * times.renew
