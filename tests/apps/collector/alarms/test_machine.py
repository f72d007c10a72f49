"""One limit: an independent oracle that looks at the whole history, and each sentence of the documentation alone."""

import math
from dataclasses import dataclass
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind, AlarmState, alarms_after
from busway.apps.collector.alarms.machine import AlarmMachine
from busway.apps.collector.samples import Reason, SampleValue
from busway.points.point_rules import AlarmRule

SECOND = 1_000_000_000
RAISED, CLEARED, ACKNOWLEDGED = AlarmEventKind.RAISED, AlarmEventKind.CLEARED, AlarmEventKind.ACKNOWLEDGED


@dataclass(frozen=True)
class Step:
    """A sample at a second, or (``value`` None and ``reason`` None) an acknowledgement."""

    at: int
    value: float | None
    reason: int | None

    @property
    def counts(self) -> bool:
        return self.reason is not None and self.reason < Reason.TIMEOUT and self.value is not None


class Oracle:
    """What the sentences say, from the whole history, without a state machine.

    A value is beyond, or has come back by the hysteresis, or is between. The alarm is on from a value beyond, whose
    unbroken row of values beyond began a delay earlier, to the first value that has come back.
    """

    def __init__(self, rule: AlarmRule, history: list[Step]) -> None:
        sign = 1 if rule.kind in ("H", "HH") else -1
        usable = [(place, step) for place, step in enumerate(history) if step.counts]
        values = [(place, sign * float(step.value or 0), step.at) for place, step in usable]
        limit = sign * rule.limit
        self.raised: list[int] = []
        self.cleared: list[int] = []
        for number, (place, value, at) in enumerate(values):
            if self.is_on:
                if value <= limit - rule.hysteresis:
                    self.cleared.append(place)
            elif value > limit:
                row = number
                while row > 0 and values[row - 1][1] > limit and values[row - 1][0] > (self.cleared or [-1])[-1]:
                    row -= 1
                if at - values[row][2] >= rule.delay:
                    self.raised.append(place)
        acknowledgements = [place for place, step in enumerate(history) if step.reason is None]
        self.is_unacknowledged = bool(
            rule.acknowledge and self.raised and not any(place > self.raised[-1] for place in acknowledgements)
        )

    @property
    def is_on(self) -> bool:
        return len(self.raised) > len(self.cleared)


def rules() -> st.SearchStrategy[AlarmRule]:
    return st.builds(
        AlarmRule,
        st.sampled_from(["HH", "H", "L", "LL"]),
        st.sampled_from([-1.0, 0.0, 2.0]),
        st.sampled_from([0.0, 1.0, 3.0, 10.0]),
        st.sampled_from([0.0, 1.0, 2.5]),
        st.booleans(),
    )


def histories() -> st.SearchStrategy[list[Step]]:
    values = st.sampled_from([-5.0, -3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 2.5, 4.0, 5.0])
    reasons = st.sampled_from([0, 0, 0, int(Reason.OUT_OF_RANGE), int(Reason.TIMEOUT), 256 + 4])
    steps = st.tuples(st.integers(0, 4), st.one_of(st.tuples(values, reasons), st.none()))
    return st.lists(steps, max_size=40).map(_histories)


def _histories(steps: list[tuple[int, tuple[float, int] | None]]) -> list[Step]:
    made, at = [], 0
    for pause, sample in steps:
        at += pause
        made.append(Step(at, None, None) if sample is None else Step(at, *sample))
    return made


def play(machine: AlarmMachine, history: list[Step]) -> list[tuple[int, AlarmEvent]]:
    told = []
    for place, step in enumerate(history):
        if step.reason is None:
            event = machine.acknowledge("anna", step.at * SECOND)
        else:
            event = machine.take(step.value, step.reason, step.at * SECOND, float(step.at))
        if event is not None:
            told.append((place, event))
    return told


@given(rules(), histories())
def test_the_machine_says_what_the_sentences_say_of_any_history(rule: AlarmRule, history: list[Step]) -> None:
    machine = AlarmMachine("d", "p", rule)
    told = play(machine, history)
    oracle = Oracle(rule, history)
    assert [place for place, event in told if event.kind is RAISED] == oracle.raised
    assert [place for place, event in told if event.kind is CLEARED] == oracle.cleared
    assert machine.state.is_active == oracle.is_on
    assert machine.state.is_unacknowledged == oracle.is_unacknowledged
    assert (machine.alarm is not None) == (oracle.is_on or oracle.is_unacknowledged)


@given(rules(), histories(), st.integers(0, 40))
def test_a_start_anew_from_the_journal_goes_on_as_if_nothing_had_happened(
    rule: AlarmRule, history: list[Step], cut: int
) -> None:
    whole = AlarmMachine("d", "p", rule)
    before = play(whole, history[:cut])
    kept = alarms_after(event for _, event in before)
    again = AlarmMachine("d", "p", rule, "", kept.get(("d", "p", rule.kind)))
    if whole.state is AlarmState.PENDING or (whole.state is AlarmState.CLEARED and rule.delay):
        return  # a delay that ran begins again
    assert again.state == whole.state
    assert play(again, history[cut:]) == play(whole, history[cut:])


@given(rules(), histories())
def test_no_alarm_is_raised_twice_or_cleared_twice_in_a_row(rule: AlarmRule, history: list[Step]) -> None:
    kinds = [event.kind for _, event in play(AlarmMachine("d", "p", rule), history) if event.kind is not ACKNOWLEDGED]
    assert kinds == [RAISED, CLEARED] * (len(kinds) // 2) + [RAISED] * (len(kinds) % 2)


def machine_of(
    kind: Literal["H", "LL"] = "H", limit: float = 80.0, delay: float = 0.0, hysteresis: float = 0.0
) -> AlarmMachine:
    return AlarmMachine("boiler", "temperature", AlarmRule(kind, limit, delay, hysteresis, True), "°C")


def feed(machine: AlarmMachine, at: float, value: SampleValue | None, reason: int = 0) -> AlarmEventKind | None:
    event = machine.take(value, reason, int(at * SECOND), at)
    return None if event is None else event.kind


def test_the_limit_itself_is_no_alarm_and_the_event_says_what_the_value_was() -> None:
    machine = machine_of()
    assert feed(machine, 0, 80.0) is None
    event = machine.take(80.1, 0, 5 * SECOND, 5.0)
    assert event == AlarmEvent("boiler", "temperature", "H", RAISED, 5 * SECOND, 80.1, "", True, "above 80 °C")
    assert machine.state is AlarmState.UNACKNOWLEDGED


def test_it_clears_when_the_value_has_come_back_by_the_hysteresis() -> None:
    machine = machine_of(hysteresis=2.0)
    assert [feed(machine, at, value) for at, value in enumerate((81, 79, 78.1, 78.0))] == [RAISED, None, None, CLEARED]


@pytest.mark.parametrize(
    ("kind", "limit", "hysteresis", "back", "beside"),
    [("H", 0.3, 0.1, 0.2, 0.2001), ("LL", 0.7, 0.1, 0.8, 0.7999), ("HH", -0.3, 0.1, -0.4, -0.3999)],
)
def test_numbers_count_as_they_are_written(
    kind: Literal["H", "LL", "HH"], limit: float, hysteresis: float, back: float, beside: float
) -> None:
    rule = AlarmRule(kind, limit, hysteresis=hysteresis)
    assert [rule.is_beyond(value, active=True) for value in (back, beside)] == [False, True]


def test_a_delay_is_over_at_its_end_also_where_floats_do_not_add_up() -> None:
    machine = machine_of(delay=0.7)
    assert [feed(machine, at, 90) for at in (0.6, 0.6 + 0.7)] == [None, RAISED]


def test_an_alarm_that_is_raised_again_needs_its_acknowledgement_whatever_the_limit_says_by_then() -> None:
    machine = machine_of()
    assert [feed(machine, 0, 90), feed(machine, 1, 70)] == [RAISED, CLEARED]
    machine.continue_as("temperature", AlarmRule("H", 80.0), "")
    event = machine.take(90, 0, 2 * SECOND, 2.0)
    assert event is not None
    assert event.needs_acknowledgement
    assert machine.state is AlarmState.UNACKNOWLEDGED


def test_a_low_limit_is_the_other_way_round() -> None:
    machine = machine_of("LL", limit=1.0, hysteresis=0.5)
    assert [feed(machine, at, value) for at, value in enumerate((1, 0.9, 1.4, 1.5))] == [None, RAISED, None, CLEARED]


def test_the_delay_begins_again_after_a_value_within_the_limit() -> None:
    machine = machine_of(delay=10)
    assert [feed(machine, at, value) for at, value in ((0, 90), (9, 90), (9.5, 70), (10, 90), (19, 90))] == [None] * 5
    assert machine.state is AlarmState.PENDING
    assert feed(machine, 20, 90) is RAISED


@pytest.mark.parametrize("reason", [Reason.TIMEOUT, Reason.NO_CONNECTION, Reason.MAINTENANCE, 256 + 2])
def test_a_bad_sample_raises_and_clears_nothing_and_is_shown(reason: int) -> None:
    machine = machine_of(delay=10)
    assert feed(machine, 0, 99.0, reason) is None
    assert machine.state is AlarmState.NORMAL
    assert [feed(machine, 1, 99.0), feed(machine, 5, None, reason), feed(machine, 11, 99.0)] == [None, None, RAISED]
    assert feed(machine, 12, 0.0, reason) is None
    assert machine.state is AlarmState.UNACKNOWLEDGED
    assert machine.reason == reason


def test_a_value_out_of_range_raises_an_alarm_although_it_is_uncertain() -> None:
    machine = machine_of()
    assert feed(machine, 0, 999.0, Reason.OUT_OF_RANGE) is RAISED
    assert feed(machine, 1, math.nan) is None


def test_an_alarm_that_came_back_waits_for_its_acknowledgement_and_may_be_raised_again() -> None:
    machine = machine_of()
    assert [feed(machine, 0, 90), feed(machine, 1, 70)] == [RAISED, CLEARED]
    assert machine.state is AlarmState.CLEARED
    assert feed(machine, 2, 90) is RAISED
    assert machine.acknowledge("anna", 3 * SECOND) is not None
    assert machine.alarm is not None
    assert (machine.alarm.acknowledged_by, machine.alarm.acknowledged_at) == ("anna", 3 * SECOND)
    assert machine.acknowledge("otto", 4 * SECOND) is None
    assert feed(machine, 5, 70) is CLEARED
    assert machine.state is AlarmState.NORMAL


def test_a_rule_without_acknowledgement_needs_none() -> None:
    machine = AlarmMachine("d", "p", AlarmRule("H", 1.0))
    assert feed(machine, 0, 2) is RAISED
    assert machine.state is AlarmState.ACKNOWLEDGED
    assert machine.acknowledge("anna", 0) is None
    assert feed(machine, 1, 0) is CLEARED
    assert machine.alarm is None


def test_states_of_an_enumeration_flags_and_bits_are_alarms_too() -> None:
    fault = AlarmRule("state", states=("fault", "lost"), numbers=frozenset({3, 4}))
    assert [fault.is_beyond(value, active=False) for value in (0, 3, 4)] == [False, True, True]
    flags = AlarmRule("state", states=("door", "fire"), bits=0b10010)
    assert [each for each in (0, 1, 2, 16, 18, -1) if flags.is_beyond(each, active=False)] == [2, 16, 18, -1]
    bit = AlarmMachine("d", "p", AlarmRule("state", states=("on",), numbers=frozenset({1})))
    assert [feed(bit, at, value) for at, value in enumerate((False, True, True))] == [None, RAISED, None]
    assert feed(bit, 3, False) is CLEARED
    assert fault.text() == "is fault or lost"
