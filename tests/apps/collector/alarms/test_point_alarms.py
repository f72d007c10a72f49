"""The alarms of all points: which samples concern which limits, and what a changed file does to alarms."""

from collections.abc import Sequence
from dataclasses import replace

from busway.apps.collector.alarms.events import AlarmEventKind, AlarmState
from busway.apps.collector.alarms.point_alarms import PointAlarms
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch, SampleValue
from busway.codes import Table
from busway.points.point import Point
from busway.points.point_rules import AlarmRule

GROUP = PointGroup("meter", ("voltage", "current"))
LIMITS = (AlarmRule("H", 10.0, acknowledge=True), AlarmRule("HH", 20.0))
CURRENT = Point("current", Table.HOLDING_REGISTERS, 1, alarms=LIMITS)
POINTS = (Point("voltage", Table.HOLDING_REGISTERS, 0), CURRENT)


def book_of(points: Sequence[Point] = POINTS) -> PointAlarms:
    book = PointAlarms()
    assert book.configure({"meter": points}, 0) == []
    return book


def told(
    book: PointAlarms, current: SampleValue | None, at: float = 0.0, group: PointGroup = GROUP, reason: int = 0
) -> list[str]:
    values = [None] * (len(group.points) - 1) + [current]
    reasons = [int(Reason.TIMEOUT)] * (len(group.points) - 1) + [reason]
    return [f"{event.limit} {event.kind}" for event in book.take(SampleBatch(group, 0, 0, values, reasons), at)]


def test_each_limit_of_a_point_is_an_alarm_of_its_own() -> None:
    book = book_of()
    assert told(book, 25.0) == ["H raised", "HH raised"]
    assert told(book, 15.0) == ["HH cleared"]
    assert told(book, 5.0, group=PointGroup("other", ("current",))) == []
    assert told(book, 5.0, group=PointGroup("meter", ("voltage",))) == []


def test_a_changed_limit_holds_from_the_next_sample_on_and_the_alarm_stays_what_it_was() -> None:
    book = book_of()
    told(book, 15.0)
    assert book.acknowledge(("meter", "current", "H"), "anna", 1) is not None
    higher = replace(CURRENT, alarms=(replace(LIMITS[0], limit=30.0),))
    assert book.configure({"meter": (higher,)}, 2) == []
    machine = book.machines["meter", "current", "H"]
    assert machine.state is AlarmState.ACKNOWLEDGED
    assert told(book, 29.0) == ["H cleared"]
    assert told(book, 31.0) == ["H raised"]


def test_a_renamed_point_takes_its_alarms_along() -> None:
    book = book_of()
    told(book, 15.0)
    renamed = replace(CURRENT, name="amps", was="current")
    assert book.configure({"meter": (renamed,)}, 2, moved={("meter", "current"): "amps"}) == []
    alarm = book.machines["meter", "amps", "H"].alarm
    assert alarm is not None
    assert (alarm.point, alarm.state) == ("amps", AlarmState.UNACKNOWLEDGED)
    assert told(book, 5.0, group=PointGroup("meter", ("amps",))) == ["H cleared"]


def test_points_that_exchange_their_names_keep_their_own_alarms_and_delays() -> None:
    slow = (AlarmRule("H", 10.0, delay=10.0),)
    points = (replace(POINTS[0], alarms=LIMITS), CURRENT, Point("power", Table.HOLDING_REGISTERS, 2, alarms=slow))
    group = PointGroup("meter", ("power", "current"))
    book = book_of(points)
    assert told(book, 15.0) == ["H raised"]
    assert [event.limit for event in book.take(SampleBatch(group, 0, 0, [50.0, None], [0, 64]), 0.0)] == []
    exchanged = [
        replace(points[0], name="current", was="voltage"),
        replace(points[1], name="voltage", was="current"),
        replace(points[2], name="apparent", was="power"),
        Point("power", Table.HOLDING_REGISTERS, 3, alarms=slow),
    ]
    moved = {("meter", "voltage"): "current", ("meter", "current"): "voltage", ("meter", "power"): "apparent"}
    for names in (moved, {}):  # read again, it says the same, and nothing is exchanged a second time
        assert book.configure({"meter": exchanged}, 2, moved=names) == []
        alarms = {key[1]: machine.alarm for key, machine in book.machines.items() if machine.alarm}
        assert {name: (alarm.point, alarm.limit) for name, alarm in alarms.items()} == {"voltage": ("voltage", "H")}
    assert told(book, 50.0, at=11.0, group=PointGroup("meter", ("power",))) == [], "the delay was that of another point"
    assert told(book, 50.0, at=11.0, group=PointGroup("meter", ("apparent",))) == ["H raised"], "its delay went on"
    ended = book.configure({"meter": [replace(each, alarms=()) for each in exchanged]}, 3)
    assert {event.key for event in ended} == {("meter", "voltage", "H"), ("meter", "apparent", "H")}


def test_the_end_of_an_alarm_of_a_renamed_point_has_its_new_name() -> None:
    book = book_of()
    told(book, 15.0)
    renamed = replace(CURRENT, name="amps", was="current", alarms=())
    (ended,) = book.configure({"meter": (renamed,)}, 2, moved={("meter", "current"): "amps"})
    assert ended.key == ("meter", "amps", "H")


def test_an_alarm_whose_limit_or_device_is_gone_is_ended_by_an_event() -> None:
    book = book_of()
    told(book, 25.0)
    gone = book.configure({"meter": (replace(CURRENT, alarms=LIMITS[:1]),)}, 7)
    assert [(event.limit, event.kind, event.at) for event in gone] == [("HH", AlarmEventKind.REMOVED, 7)]
    assert [event.limit for event in book.configure({}, 8)] == ["H"]
    assert book.configure({"meter": POINTS}, 9) == []
    assert book.machines["meter", "current", "H"].state is AlarmState.NORMAL


def test_a_delay_that_runs_is_not_begun_again_by_a_file_that_says_the_same() -> None:
    slow = replace(CURRENT, alarms=(AlarmRule("H", 10.0, delay=10.0),))
    book = book_of((slow,))
    assert told(book, 15.0, at=0.0) == []
    book.configure({"meter": (slow,)}, 1)
    assert told(book, 15.0, at=10.0) == ["H raised"]


def test_a_delay_that_runs_goes_on_under_another_limit() -> None:
    slow = replace(CURRENT, alarms=(AlarmRule("H", 10.0, delay=10.0),))
    book = book_of((slow,))
    assert told(book, 15.0, at=0.0) == []
    book.configure({"meter": (replace(CURRENT, alarms=(AlarmRule("H", 12.0, delay=10.0),)),)}, 1)
    assert told(book, 15.0, at=10.0) == ["H raised"]
