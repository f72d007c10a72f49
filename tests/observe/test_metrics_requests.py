"""The tally of requests: labels, bounds and durations."""

import pytest

from busway.observe.metrics.request_tally import BUCKETS, MAX_SERIES, PeerClass, RequestTally, Unanswered


def labels(tally: RequestTally) -> dict[tuple[str, str, str, str], int]:
    """Counts by label values."""
    return {(one.peer_class, one.unit, one.function, one.exception): one.count for one in tally.all_series()}


def test_requests_are_counted_by_class_unit_function_and_exception() -> None:
    tally = RequestTally()
    tally.series(PeerClass.OTHER, 1, 3).count += 2
    tally.series(PeerClass.OTHER, 1, 3).count += 1
    tally.series(PeerClass.PRIORITY, 1, 3, 2).count += 1
    tally.series(PeerClass.LINE, 247, 16, 0x0B).count += 1
    assert labels(tally) == {
        ("other", "1", "3", "none"): 3,
        ("priority", "1", "3", "02"): 1,
        ("line", "247", "16", "0B"): 1,
    }
    assert tally.total() == 5


def test_functions_and_exceptions_outside_the_specification_are_other() -> None:
    tally = RequestTally([3, 65])
    for function in range(128):
        tally.series(PeerClass.OTHER, 1, function, 0x77).count += 1
    assert labels(tally) == {
        ("other", "1", "3", "other"): 1,
        ("other", "1", "65", "other"): 1,
        ("other", "1", "other", "other"): 126,
    }
    for function in range(128):
        tally.durations(function).add(0.0)
    assert {one.function: sum(one.counts) for one in tally.all_durations()} == {"3": 1, "65": 1, "other": 126}


def test_whatever_is_asked_the_number_of_series_stays_bounded_and_nothing_is_lost() -> None:
    tally = RequestTally()
    asked = 0
    for unit in range(256):
        for function in range(30):
            for exception in (None, 1, 2, 3, 4, 0x70):
                tally.series(PeerClass.OTHER, unit, function, exception).count += 1
                asked += 1
    other = [one for one in tally.all_series() if one.unit == "other"]
    assert len(tally.all_series()) - len(other) == MAX_SERIES
    assert len(other) <= 30 * 6
    assert tally.total() == asked


@pytest.mark.parametrize("seconds", [0.0, BUCKETS[0], BUCKETS[3] + 1e-9, BUCKETS[-1], 1e6])
def test_a_duration_falls_into_the_lowest_bucket_that_holds_it(seconds: float) -> None:
    durations = RequestTally().durations(3)
    durations.add(seconds)
    index = durations.counts.index(1)
    assert index == len(BUCKETS) or seconds <= BUCKETS[index]
    assert index == 0 or seconds > BUCKETS[index - 1]
    assert durations.total == seconds


def test_what_gets_no_answer_is_counted_by_reason() -> None:
    tally = RequestTally()
    tally.unanswered(Unanswered.GONE)
    assert tally.unanswered_counts() == {Unanswered.BROADCAST: 0, Unanswered.SILENT: 0, Unanswered.GONE: 1}
