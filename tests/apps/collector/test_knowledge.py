"""What was learnt: kept as text, dropped with the firmware, pinned, forgotten, offered to devices of the same kind."""

from dataclasses import replace

import pytest

from busway.apps.collector.knowledge import (
    DeviceKnowledge,
    Knowledge,
    LearntHole,
    LearntLimit,
    read_knowledge,
)
from busway.codes import Table
from busway.errors import ConfigError

HOLE = LearntHole(Table.HOLDING_REGISTERS, 37, 38, 2)
OTHER = LearntHole(Table.INPUT_REGISTERS, 5, 9, 0)
BORDER = LearntHole(Table.HOLDING_REGISTERS, 50, 50, 3)
LIMIT = LearntLimit(False, 64, 65)


def meter(*holes: LearntHole, limits: tuple[LearntLimit, ...] = ()) -> DeviceKnowledge:
    return DeviceKnowledge("sdm630", "1.2", 0.03, holes, limits)


def test_it_survives_as_text() -> None:
    knowledge = Knowledge({"a": meter(HOLE, OTHER, BORDER, limits=(LIMIT,)), "b": DeviceKnowledge()})
    knowledge.set("c", DeviceKnowledge(base=0.05, per_register=0.0023))
    knowledge.pin("a")
    assert list(read_knowledge(knowledge.text(), "learnt.json")) == list(knowledge)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"version": 1, "devices": {"a": {}}}', '{"version": 1, "devices": 3}']
)
def test_a_text_that_is_something_else_is_refused_by_name(text: str) -> None:
    with pytest.raises(ConfigError, match="learnt"):
        read_knowledge(text, "learnt.json")


def test_another_version_is_refused() -> None:
    with pytest.raises(ConfigError, match="version 7"):
        read_knowledge('{"version": 7}', "learnt.json")


def test_knowledge_of_a_device_holds_for_its_profile_and_firmware_alone() -> None:
    knowledge = Knowledge({"a": meter(HOLE)})
    assert knowledge.of("a", "sdm630", "1.2").holes == (HOLE,)
    assert knowledge.of("a", "sdm630", "1.3") == DeviceKnowledge("sdm630", "1.3")
    assert knowledge.of("z", "sdm630", "1.2") == DeviceKnowledge("sdm630", "1.2")


def test_what_is_pinned_outlives_a_new_firmware_and_forgetting() -> None:
    knowledge = Knowledge({"a": meter(HOLE, limits=(LIMIT,))})
    assert knowledge.pin("a")
    assert len(knowledge.of("a", "sdm630", "2.0").holes) == 1
    assert knowledge.forget("a")
    assert len(knowledge.of("a", "sdm630", "1.2").limits) == 1
    assert knowledge.forget("a", pinned=True)
    assert knowledge.of("a", "sdm630", "1.2") == DeviceKnowledge("sdm630", "1.2")
    assert not knowledge.forget("missing")


def test_a_pinned_limit_is_not_changed_by_learning() -> None:
    known = meter(limits=(LIMIT,)).pinned()
    assert known.with_limit(LearntLimit(False, 10, 11)) is known


def test_what_two_devices_of_a_kind_agree_on_is_offered_to_a_third() -> None:
    knowledge = Knowledge({"a": meter(HOLE, OTHER, limits=(LIMIT,))})
    assert knowledge.offered("sdm630", "1.2") == DeviceKnowledge("sdm630", "1.2")
    assert knowledge.kinds() == []
    knowledge.set("b", meter(HOLE, limits=(LearntLimit(False, 60, 61),)))
    offered = knowledge.of("c", "sdm630", "1.2")
    assert offered.holes == (HOLE,)
    assert offered.limits == (LearntLimit(False, 60, 61),)  # the narrower of both
    assert offered.base is None
    assert knowledge.kinds() == [("sdm630", "1.2")]


@pytest.mark.parametrize(
    ("first", "second", "offered"),
    [
        ((10, 20), (12, 15), [(12, 15)]),  # a part of the other's
        ((10, 20), (19, 30), []),  # they overlap by one item alone
        ((10, 20), (20, 30), []),
        ((10, 20), (15, 15), []),  # a border within a hole
        ((15, 15), (15, 15), [(15, 15)]),
    ],
)
def test_only_holes_and_borders_that_two_devices_have_learnt_alike_are_offered(
    first: tuple[int, int], second: tuple[int, int], offered: list[tuple[int, int]]
) -> None:
    holes = [LearntHole(Table.HOLDING_REGISTERS, *each, code) for each, code in ((first, 2), (second, 3))]
    found = Knowledge({"a": meter(holes[0]), "b": meter(holes[1])}).offered("sdm630", "1.2").holes
    assert [(each.start, each.end) for each in found] == offered


def test_nothing_is_offered_where_profile_or_firmware_is_not_known() -> None:
    same = DeviceKnowledge("", "", None, (HOLE,))
    assert Knowledge({"a": same, "b": same}).of("c").holes == ()


def test_it_is_told_in_sentences() -> None:
    lines = list(meter(HOLE, OTHER, BORDER, limits=(LIMIT,)).pinned().lines())
    assert lines == [
        "holding register 37: exception 02 (pinned)",
        "input register 5…8: silence (pinned)",
        "reads across the border before holding register 50: exception 03 (pinned)",
        "at most 64 registers in one read; 65 are refused (pinned)",
        "a read takes 30.0 ms apart from its registers",
    ]


def test_what_was_learnt_at_another_place_is_dropped_and_what_is_pinned_stays() -> None:
    knowledge = Knowledge()
    knowledge.set("a", replace(knowledge.of("a", "sdm630", "1.2", "tcp://h:502 unit 1"), holes=(HOLE,)))
    assert knowledge.of("a", "sdm630", "1.2", "tcp://h:502 unit 1").holes == (HOLE,)
    assert knowledge.of("a", "sdm630", "1.2", "tcp://h:502 unit 2").holes == ()
    again = read_knowledge(knowledge.text(), "learnt.json")
    assert again.of("a", "sdm630", "1.2", "tcp://other:502 unit 1").holes == ()
    assert knowledge.pin("a")
    (pinned,) = knowledge.of("a", "sdm630", "1.2", "tcp://h:502 unit 2").holes
    assert pinned.pinned
