"""Samples, their quality, and the columns of one read."""

import sys

import pytest

from busway.apps.collector.samples import (
    Gap,
    PointGroup,
    Quality,
    Reason,
    Sample,
    SampleBatch,
    StateInterval,
    exception_code_of,
    exception_reason,
    failed_batch,
    quality_of,
    reason_text,
)
from busway.errors import InvalidRequest

METER = PointGroup("meter-7", ("voltage", "current"))


def test_quality_follows_from_the_reason() -> None:
    assert quality_of(0) is Quality.GOOD
    uncertain = {reason for reason in Reason if quality_of(reason) is Quality.UNCERTAIN}
    assert uncertain == {Reason.HELD, Reason.OUT_OF_RANGE, Reason.CLOCK}
    assert quality_of(exception_reason(0)) is Quality.BAD


def test_an_exception_code_is_kept_as_it_came() -> None:
    for code in (0, 2, 4, 0x0B, 255):
        assert exception_code_of(exception_reason(code)) == code
    assert reason_text(exception_reason(2)).startswith("exception 02, ")
    assert exception_code_of(Reason.TIMEOUT) is None
    with pytest.raises(InvalidRequest, match=r"0…255, not 256"):
        exception_reason(256)


def test_every_reason_has_words() -> None:
    texts = [reason_text(reason) for reason in Reason]
    assert len(set(texts)) == len(texts)
    assert [reason for reason in Reason if not reason_text(reason)] == [Reason.NONE]


def test_a_batch_gives_a_sample_for_each_point() -> None:
    batch = SampleBatch(METER, 1_000, 50, (230.1, None), (0, Reason.NO_VALUE))
    assert list(batch) == [
        Sample("meter-7", "voltage", 1_000, 50, 230.1),
        Sample("meter-7", "current", 1_000, 50, None, Reason.NO_VALUE),
    ]
    assert [sample.quality for sample in batch] == [Quality.GOOD, Quality.BAD]


def test_a_failed_read_gives_each_point_a_bad_sample() -> None:
    batch = failed_batch(METER, 1_000, 50, exception_reason(4))
    assert {(sample.value, sample.reason) for sample in batch} == {(None, 256 + 4)}
    with pytest.raises(InvalidRequest, match="no reason for which a read fails"):
        failed_batch(METER, 1_000, 50, Reason.HELD)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: SampleBatch(METER, 0, 0, (1.0,)), "2 points of meter-7 need as many values, not 1"),
        (lambda: SampleBatch(METER, 0, 0, (1.0, 2.0), (0,)), "as many reasons, not 1"),
        (lambda: PointGroup("m", ("a", "a")), "twice"),
        (lambda: PointGroup("m", ()), "empty"),
        (lambda: Sample("m", "a", 0, 0, None), "needs a reason"),
        (lambda: StateInterval("m", 5, 4, Reason.SKIPPED), "before it begins"),
        (lambda: Gap(5, 6, Reason.CLOCK), "no reason for time without samples"),
    ],
)
def test_what_cannot_be_is_refused(make, says: str) -> None:
    with pytest.raises(InvalidRequest, match=says):
        make()


def test_a_batch_of_a_full_read_stays_below_300_bytes_a_point() -> None:
    group = PointGroup("m", tuple(f"point {number}" for number in range(62)))
    batch = SampleBatch(group, 1, 1, [number + 0.5 for number in range(62)])
    size = sys.getsizeof(batch) + sys.getsizeof(batch.values) + sum(map(sys.getsizeof, batch.values))
    size += sys.getsizeof(group) + sys.getsizeof(group.points) + sum(map(sys.getsizeof, group.points))
    assert size / 62 < 300
