"""What changed since a tick, as one text for all viewers."""

import json
from dataclasses import replace
from typing import Any

import pytest

from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch, StateInterval
from busway.apps.collector.store.writer import Commit
from busway.apps.web import live_values
from busway.apps.web.live_values import LiveValues

PUMP = PointGroup("pump", ("speed", "level", "gone"))
METER = PointGroup("meter", ("power",))
POINTS = [("pump", "speed"), ("pump", "level"), ("pump", "gone"), ("meter", "power")]
SECOND = 1_000_000_000


def commit(*batches: SampleBatch) -> Commit:
    return Commit(1, 0, batches, ())


def since(values: LiveValues, seen: int) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(f"{{{values.since(seen)}}}")
    return content


def replayed(messages: list[dict[str, Any]]) -> tuple[dict[int, Any], dict[int, int]]:
    """Values and times as a viewer has them after some messages."""
    values, times = dict[int, Any](), dict[int, int]()
    for message in messages:
        for first, found, _ in message["changed"]:
            values |= {first + at: value for at, value in enumerate(found)}
        read = message["read"]
        for first, count, at in zip(read[::3], read[1::3], read[2::3], strict=True):
            times |= dict.fromkeys(range(first, first + count), at)
    return values, times


def test_neighbours_that_were_read_together_are_told_in_one_run() -> None:
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(PUMP, SECOND, 0, (1.5, 7, None), (0, 0, Reason.TIMEOUT))))
    assert values.advance()
    assert since(values, 0) == {
        "read": [0, 3, 1000],
        "changed": [[0, [1.5, 7, None], [0, 0, Reason.TIMEOUT]]],
        "reasons": {"0": ["good", ""], str(int(Reason.TIMEOUT)): ["bad", "timeout"]},
    }


def test_a_value_that_stays_is_read_again_but_has_not_changed() -> None:
    values = LiveValues(POINTS)
    for at, level in ((SECOND, 7), (2 * SECOND, 8)):
        values.update(commit(SampleBatch(PUMP, at, 0, (1.5, level, 2))))
        values.advance()
    assert since(values, 1) == {"read": [0, 3, 2000], "changed": [[1, [8], 0]], "reasons": {"0": ["good", ""]}}


def test_a_viewer_that_missed_ticks_has_the_same_as_one_that_saw_each() -> None:
    values, each = LiveValues(POINTS), []
    for turn in range(1, 20):
        batches = [SampleBatch(METER, turn * SECOND, 0, (turn // 3,))]
        if turn % 2:
            batches.append(SampleBatch(PUMP, turn * SECOND, 0, (turn, 7, turn % 5), Reason.CLOCK if turn == 9 else 0))
        values.update(commit(*batches))
        before = values.tick
        values.advance()
        each.append(since(values, before))
    assert replayed([since(values, 0)]) == replayed(each)
    late = [each[0], since(values, 1)]
    assert replayed(late) == replayed(each)


def test_all_values_are_bad_while_the_store_cannot_be_written_and_good_again_afterwards() -> None:
    behind = [False]
    values = LiveValues(POINTS, is_behind=lambda: behind[0])
    values.update(commit(SampleBatch(PUMP, SECOND, 0, (1.5, 7, None), (0, 0, Reason.TIMEOUT))))
    assert values.columns()[1] == [0, 0, Reason.TIMEOUT, 0]
    behind[0] = True
    assert values.advance()
    assert not values.advance()
    assert values.columns()[1] == [Reason.LOST, Reason.LOST, Reason.TIMEOUT, 0], "the meter was never read"
    assert since(values, 1)["changed"] == [[0, [1.5, 7, None], [Reason.LOST, Reason.LOST, Reason.TIMEOUT]]]
    behind[0] = False
    values.update(commit(SampleBatch(PUMP, 9 * SECOND, 0, (1.5, 7, None), (0, 0, Reason.TIMEOUT))))
    assert values.columns() == ([1.5, 7, None, None], [0, 0, Reason.TIMEOUT, 0], [9000, 9000, 9000, 0])
    assert since(values, 2)["changed"] == [[0, [1.5, 7, None], [0, 0, Reason.TIMEOUT]]]


def test_a_good_value_that_is_not_read_again_when_due_is_held_until_it_is() -> None:
    moment = [0.0]
    values = LiveValues(POINTS, limits=dict.fromkeys(POINTS[:3], 3.0), moment=lambda: moment[0])
    values.update(commit(SampleBatch(PUMP, SECOND, 0, (1.5, 7, None), (0, Reason.OUT_OF_RANGE, Reason.TIMEOUT))))
    values.update(commit(SampleBatch(METER, SECOND, 0, (1,))))
    moment[0] = 3.0
    assert values.columns()[1] == [0, Reason.OUT_OF_RANGE, Reason.TIMEOUT, 0]
    moment[0] = 5.0
    assert values.advance()
    assert values.columns()[1] == [Reason.HELD, Reason.OUT_OF_RANGE, Reason.TIMEOUT, 0], "the meter has no limit"
    assert since(values, 1)["changed"][0][0] == 0
    assert since(values, 1)["reasons"][str(int(Reason.HELD))] == ["uncertain", "held"]
    assert not values.advance()
    values.update(replace(commit(SampleBatch(PUMP, 2 * SECOND, 0, (1.5, 7, 2), 0)), moment=5.0))
    assert values.columns()[1] == [0, 0, 0, 0]
    values.set_limits({})
    moment[0] = 99.0
    assert not values.advance()


def test_a_value_is_held_at_once_when_its_limit_is_over_and_counts_from_its_read() -> None:
    moment = [0.0]
    values = LiveValues(POINTS, limits=dict.fromkeys(POINTS, 3.0), moment=lambda: moment[0])
    values.update(commit(SampleBatch(METER, SECOND, 0, (1,))))
    values.update(Commit(2, 3 * SECOND, [SampleBatch(PUMP, SECOND, 0, (1.5, 7, 2))], ()))
    shown = {}
    for tenth in range(60):
        moment[0] = tenth / 10
        reasons = values.columns()[1]
        shown[tenth] = (reasons[0], reasons[3])
    assert [tenth for tenth, (pump, _) in shown.items() if pump == 0] == list(range(11)), "committed 2 s after the read"
    assert [tenth for tenth, (_, meter) in shown.items() if meter == 0] == list(range(31))


@pytest.mark.parametrize("shift", [-3600 * SECOND, 3600 * SECOND])
def test_values_of_before_the_clock_was_set_move_and_are_replaced_by_later_ones(shift: int) -> None:
    begin = 10_000 * SECOND
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(PUMP, begin, 0, (1.5, 7, None), (Reason.CLOCK, Reason.CLOCK, Reason.TIMEOUT))))
    values.update(Commit(1, 0, [], [StateInterval("meter", begin, begin + SECOND, Reason.SUSPENDED)]))
    values.advance()
    right = begin + shift
    correction = ClockCorrection(shift, begin, begin + 5 * SECOND)
    more = [SampleBatch(METER, right + 2 * SECOND, 0, (4,))]
    values.update(Commit(2, 0, more, (), correction=correction))
    assert values.columns() == (
        [1.5, 7, None, 4],
        [0, 0, Reason.TIMEOUT, 0],
        [right // 1_000_000] * 3 + [right // 1_000_000 + 2000],
    )
    values.update(commit(SampleBatch(PUMP, right + 3 * SECOND, 0, (2.5, 8, 3))))
    assert values.columns()[0] == [2.5, 8, 3, 4]
    assert replayed([since(values, 1)]) == replayed([since(values, -1)])


def test_a_correction_of_times_is_told_also_if_nothing_else_has_come() -> None:
    begin, shift = 10_000 * SECOND, 3600 * SECOND
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(PUMP, begin, 0, (1.5, 7, None), (Reason.CLOCK, 0, Reason.TIMEOUT))))
    values.advance()
    values.update(Commit(2, 0, [], (), correction=ClockCorrection(shift, begin, begin + SECOND)))
    assert values.advance()
    assert since(values, 1) == {
        "read": [0, 3, (begin + shift) // 1_000_000],
        "changed": [[0, [1.5], 0]],
        "reasons": {"0": ["good", ""]},
    }
    assert not values.advance()


def test_one_that_begins_has_what_was_read_before() -> None:
    values = LiveValues(POINTS, limits={POINTS[3]: 3.0}, moment=lambda: 9.0)
    reads = [(SampleBatch(PUMP, SECOND, 0, (1.5, 7, 2)), 8.0), (SampleBatch(METER, SECOND, 0, (1,)), 5.0)]
    values.begin(reads, {})
    assert values.columns() == ([1.5, 7, 2, 1], [0, 0, 0, Reason.HELD], [1000] * 4)


@pytest.mark.parametrize("ticks", [False, True])
def test_what_was_stored_while_one_begins_is_newer_than_what_was_read_before(ticks: bool) -> None:
    values = LiveValues(POINTS)
    values.update(
        Commit(
            1, 0, [SampleBatch(METER, 2 * SECOND, 0, (2,))], [StateInterval("pump", SECOND, 2 * SECOND, Reason.LOST)]
        )
    )
    if ticks:
        values.advance()
    reads = [(SampleBatch(METER, SECOND, 0, (1,)), 0.0), (SampleBatch(PUMP, 3 * SECOND, 0, (1.5, 7, 2)), 0.0)]
    values.begin(reads, {"pump": StateInterval("pump", SECOND, None, Reason.MAINTENANCE)})
    assert values.columns() == ([1.5, 7, 2, 2], [0, 0, 0, 0], [3000] * 3 + [2000])


def test_one_that_begins_is_told_of_points_that_were_not_read_too() -> None:
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(METER, SECOND, 0, (1,))))
    values.advance()
    assert replayed([since(values, -1)]) == ({0: None, 1: None, 2: None, 3: 1}, {0: 0, 1: 0, 2: 0, 3: 1000})


def test_nothing_new_makes_no_tick() -> None:
    values = LiveValues(POINTS)
    assert not values.advance()
    values.update(commit(SampleBatch(METER, SECOND, 0, (1,))))
    assert values.advance()
    assert not values.advance()
    assert values.tick == 1


def test_a_text_is_made_once_for_all_that_saw_the_same_tick() -> None:
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(METER, SECOND, 0, (1,))))
    values.advance()
    assert values.since(0) == values.since(0)
    assert len(values._texts) == 1


def test_an_older_sample_does_not_hide_a_newer_one() -> None:
    values = LiveValues(POINTS)
    both = PointGroup("pump", ("speed",))
    values.update(commit(SampleBatch(both, 5 * SECOND, 0, (5,)), SampleBatch(PUMP, 4 * SECOND, 0, (4, 4, 4))))
    values.advance()
    values.update(commit(SampleBatch(PUMP, 3 * SECOND, 0, (3, 3, 3))))
    values.advance()
    assert values.columns()[0] == [5, 4, 4, None]


def test_points_that_are_not_collected_any_more_are_left_out() -> None:
    values = LiveValues([("pump", "level")])
    values.update(commit(SampleBatch(PUMP, SECOND, 0, (1, 2, 3)), SampleBatch(METER, SECOND, 0, (1,))))
    values.advance()
    assert values.columns()[0] == [2]


def test_numbers_that_json_does_not_have_are_texts() -> None:
    values = LiveValues(POINTS)
    values.update(commit(SampleBatch(PUMP, SECOND, 0, (float("inf"), 2**63, "text"))))
    values.advance()
    assert since(values, 0)["changed"] == [[0, ["Infinity", str(2**63), "text"], 0]]


def test_reads_do_not_gather_without_end_while_no_page_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_values, "MOST_WAITING", 10)
    values = LiveValues(POINTS)
    for turn in range(100):
        values.update(commit(SampleBatch(PointGroup("meter", ("power",)), turn * SECOND, 0, (turn,))))
        assert len(values._waiting) <= 10
    assert values.columns()[0][3] == 99
