"""The observer that counts the requests of a server."""

import pytest

from busway.framing.mbap import encode_mbap
from busway.observe.metrics.observer import MetricsObserver
from busway.session.responder import ClientIdentity


@pytest.mark.parametrize(
    ("replies", "expected"),
    [
        ([(1, b"\3\2\0\7")] * 3, {("1", "3", "none"): 3}),
        (
            [(1, b"\3\2\0\7"), (2, b"\3\2\0\7"), (1, b"\4\2\0\7")],
            dict.fromkeys([("1", "3", "none"), ("2", "3", "none"), ("1", "4", "none")], 1),
        ),
        ([(1, b"\x83\2"), (1, b"\x83\x0b"), (1, b"\x83\2")], {("1", "3", "02"): 2, ("1", "3", "0B"): 1}),
        ([], {}),
    ],
)
def test_replies_that_came_together_are_counted_each_by_unit_function_and_exception(
    replies: list[tuple[int, bytes]], expected: dict[tuple[str, str, str], int]
) -> None:
    observer = MetricsObserver()
    for _ in range(2):  # the second time the series are known
        adus = [encode_mbap(number, unit, pdu) for number, (unit, pdu) in enumerate(replies)]
        observer.answered(ClientIdentity("10.0.0.1:1", "tcp://10.0.0.2:502"), adus, 0.5 * len(adus))
    series = {(one.unit, one.function, one.exception): one.count for one in observer.tally.all_series()}
    assert series == {key: 2 * count for key, count in expected.items()}
    assert sum(one.total for one in observer.tally.all_durations()) == pytest.approx(2 * 0.5 * len(replies))
    assert sum(sum(one.counts) for one in observer.tally.all_durations()) == 2 * len(replies)
