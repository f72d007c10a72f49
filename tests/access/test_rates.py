"""A token bucket for each host, by times that the test hands in."""

import pytest

from busway.access.rates import Rates


def test_a_host_within_its_rate_never_waits() -> None:
    rates = Rates(10.0)
    assert all(rates.charge("a", 1, n / 10) == 0.0 for n in range(1000))


def test_what_is_over_the_rate_is_paid_by_waiting_so_that_the_rate_holds() -> None:
    rates = Rates(10.0)
    now = asked = 0.0
    while now < 100.0:
        asked += 25
        now += rates.charge("a", 25, now)
    assert asked / now == pytest.approx(10.0, rel=0.02)


def test_hosts_have_buckets_of_their_own() -> None:
    rates = Rates(1.0)
    assert rates.charge("a", 5, 0.0) == 4.0
    assert rates.charge("b", 1, 0.0) == 0.0


def test_a_pause_fills_the_bucket_to_the_requests_of_one_second_and_no_more() -> None:
    rates = Rates(10.0)
    rates.charge("a", 10, 0.0)
    assert rates.charge("a", 10, 1000.0) == 0.0
    assert rates.charge("a", 1, 1000.0) == pytest.approx(0.1)


def test_who_can_be_refused_is_refused_without_going_into_debt() -> None:
    rates = Rates(2.0)
    assert [rates.allows("a", 0.0) for _ in range(4)] == [True, True, False, False]
    assert rates.allows("a", 0.5)
    assert not rates.allows("a", 0.5)


def test_a_rate_below_one_a_second_lets_one_through_now_and_then() -> None:
    rates = Rates(0.1)
    assert [rates.allows("a", now) for now in (0.0, 5.0, 10.0, 15.0)] == [True, False, True, False]


def test_buckets_are_bounded_however_many_hosts_there_are() -> None:
    rates = Rates(1.0)
    for number in range(10_000):
        rates.charge(str(number), 1, 0.0)
    assert len(rates) == 4096
    assert rates.charge("9999", 1, 0.0) == 1.0
