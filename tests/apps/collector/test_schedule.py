"""The schedule of a link on a virtual clock: periods that hold, order, overload, maintenance.

Silent devices are in `test_silent_devices`.
"""

import random
from itertools import pairwise

import pytest
from virtual_link import FAST, H, VirtualLink, book, link_with

from busway.apps.collector.admission import load_of_link
from busway.apps.collector.cost import network_cost
from busway.apps.collector.plan import PlainItem, ReadRules
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.schedule import (
    SLACK,
    LinkSchedule,
    Turn,
    TurnKind,
    TurnOutcome,
    lateness_bound,
)


def test_a_device_is_asked_once_a_period_without_drift() -> None:
    link = link_with({"a": book({"c": 5})}, {"c": 1.0})
    link.run(1000)
    times = link.polled["a"]
    assert len(times) == pytest.approx(1000, abs=2)
    grid = [round((each - times[10]) % 1.0, 6) for each in times[10:]]
    assert {min(each, 1 - each) <= 0.06 for each in grid} == {True}  # a test read may be in the way


def test_devices_do_not_wait_for_each_other_on_a_link_without_silent_ones() -> None:
    books = {f"d{at}": book({"c": 1 + at}) for at in range(30)}
    link = link_with(books, {"c": 2.5})
    assert load_of_link("hall", [(name, each, {"c": 2.5}) for name, each in books.items()], 1.0).load > 0.65
    link.run(100)
    for device in link.schedule.devices.values():
        device.worst_wait = 0.0
    link.run(200)
    assert max(device.worst_wait for device in link.schedule.devices.values()) < 0.1  # a test read


def test_slow_classes_of_devices_do_not_come_all_at_once() -> None:
    link = link_with({f"d{at}": book({"fast": 1, "slow": 5}) for at in range(20)}, {"fast": 1.0, "slow": 60.0})
    link.run(300)
    slow = [began for began, turn in link.turns if turn.round is not None and "slow" in turn.round.classes]
    for second in range(120, 300):
        assert sum(second <= each < second + 1 for each in slow) <= 8


def test_classes_that_are_due_together_make_one_plan() -> None:
    link = link_with({"a": book({"fast": 5, "slow": 5}, bridge=True)}, {"fast": 1.0, "slow": 10.0})
    link.run(100)
    sets = {turn.round.classes for _, turn in link.turns if turn.round is not None}
    assert sets == {frozenset({"fast"}), frozenset({"fast", "slow"})}


@pytest.mark.parametrize(
    ("later", "together"),
    [(0.95 * SLACK * 4.0, True), (1.05 * SLACK * 4.0, False), (-0.95 * SLACK, True), (-1.05 * SLACK, False)],
)
def test_due_times_that_differ_by_less_than_the_slack_are_one_round(later: float, together: bool) -> None:
    """The class that is due later is read early, by up to the slack of its own period: 4 s and 1 s."""
    link = link_with({"a": book({"fast": 5, "slow": 5}, bridge=True)}, {"fast": 1.0, "slow": 4.0})
    link.run(20.5)
    device = link.schedule.devices["a"]
    device.due["slow"] = device.due["fast"] + later
    link.schedule._release_at(min(device.due.values()), device)
    first = min(device.due.values())
    link.turns.clear()
    link.run(61)
    rounds = {turn.round.due: turn.round for _, turn in link.turns if turn.round is not None}
    slow = [each for each in rounds.values() if "slow" in each.classes]
    assert {each.classes for each in slow} == {frozenset({"fast", "slow"} if together else {"slow"})}
    begin = first if together else first + max(later, 0.0)
    begins = [begin + 4.0 * at for at in range(len(slow))]
    assert [each.due for each in slow] == pytest.approx(begins), "it is early each time by as much: the grid stays"
    assert len(slow) >= 10


def test_the_reads_of_a_round_follow_each_other() -> None:
    several = {
        f"d{at}": PlanBook({"c": [PlainItem(H, place, 1) for place in (0, 500, 999)]}, ReadRules(), FAST)
        for at in range(10)
    }
    link = link_with(several, {"c": 2.0})
    link.run(60)
    rounds = [turn.device for _, turn in link.turns if turn.kind is TurnKind.ROUND]
    changes = sum(a != b for a, b in pairwise(rounds))
    assert changes == pytest.approx(len(rounds) / 3, abs=2)


def test_a_round_with_an_earlier_deadline_goes_between_the_reads_of_a_long_one() -> None:
    long = PlanBook({"slow": [PlainItem(H, 300 * at, 1) for at in range(100)]}, ReadRules(), FAST)
    schedule = LinkSchedule(1.0)
    schedule.add("long", long, {"slow": 60.0}, 0.0)
    schedule.add("quick", book({"fast": 1}), {"fast": 1.0}, 0.0)
    link = VirtualLink(schedule)
    link.run(300)
    assert schedule.devices["quick"].worst_wait <= lateness_bound(1.0, schedule.blocking)
    assert schedule.devices["quick"].skipped == 0
    assert schedule.devices["long"].skipped == 0


def test_a_write_goes_before_all_reads() -> None:
    link = link_with({f"d{at}": book({"c": 30}) for at in range(30)}, {"c": 1.0})
    link.run(20.5)
    link.schedule.write("d3", "open the valve")
    turn = link.schedule.next(link.now)
    assert isinstance(turn, Turn)
    assert (turn.kind, turn.device, turn.write) == (TurnKind.WRITE, "d3", "open the valve")


def test_a_flood_of_writes_does_not_stop_polling() -> None:
    link = link_with({f"d{at}": book({"c": 30}) for at in range(3)}, {"c": 1.0})
    link.run(20.5)
    kinds = []
    for _ in range(90):
        link.schedule.write("d0", "again")
        turn = link.schedule.next(link.now)
        assert isinstance(turn, Turn)
        kinds.append(turn.kind)
        link.now += 0.1
        link.schedule.done(turn, link.now - 0.1, link.now, TurnOutcome.ANSWERED)
    assert kinds.count(TurnKind.ROUND) == 10
    assert kinds[:8] == [TurnKind.WRITE] * 8
    assert TurnKind.TEST_READ not in kinds


def test_writes_go_on_where_no_read_is_due() -> None:
    schedule = LinkSchedule(1.0)
    for at in range(20):
        schedule.write("d", at)
    turns = [schedule.next(0.0) for _ in range(20)]
    assert [turn.write for turn in turns if isinstance(turn, Turn)] == list(range(20))


def test_writes_are_bounded_and_refused_beyond() -> None:
    schedule = LinkSchedule(1.0)
    taken = [schedule.write("d", at) for at in range(300)]
    assert taken.count(True) == 256
    assert schedule.refused_writes == 44


def test_leased_points_go_before_classes_and_end_with_the_lease() -> None:
    link = link_with({f"d{at}": book({"c": 30}) for at in range(20)}, {"c": 3.0})
    link.run(30)
    device = link.schedule.devices["d7"]
    link.schedule.lease("d7", device.book.points()[:1], 0.5, 40.0, link.now)
    link.run(60)
    leased = [began for began, turn in link.turns if turn.round is not None and turn.round.rank == 0]
    assert len(leased) >= 18
    assert max(leased) <= 40.6
    assert max(b - a for a, b in pairwise(leased)) < 0.7


def test_overload_skips_and_counts_and_keeps_nothing() -> None:
    books = {f"d{at}": book({"c": 60}) for at in range(50)}
    link = link_with(books, {"c": 1.0})
    assert not load_of_link("hall", [(name, each, {"c": 1.0}) for name, each in books.items()], 1.0).fits
    link.keep = False
    link.run(500)
    skipped = sum(device.skipped for device in link.schedule.devices.values())
    rounds = sum(device.rounds for device in link.schedule.devices.values())
    assert skipped > 1000
    assert skipped + rounds == pytest.approx(50 * 500, rel=0.05)
    assert len(link.schedule._ready) <= 100
    assert len(link.schedule._releases) <= 100
    assert min(device.rounds for device in link.schedule.devices.values()) > 0.9 * rounds / 50  # fair


def test_what_was_skipped_is_told_with_the_next_round() -> None:
    link = link_with({f"d{at}": book({"c": 60}) for at in range(50)}, {"c": 1.0})
    link.run(60)
    late = [turn.round for _, turn in link.turns if turn.round is not None and turn.round.skipped_since is not None]
    assert late
    assert all(each.began is not None and each.skipped_since < each.began for each in late)


# Devices in maintenance, and removed ones.


def test_a_device_in_maintenance_is_left_alone_and_polled_again_afterwards() -> None:
    link = link_with({"a": book({"c": 5}), "b": book({"c": 5})}, {"c": 1.0})
    link.hooks = [
        (50.0, lambda: link.schedule.pause("a", paused=True, now=link.now)),
        (80.0, lambda: link.schedule.pause("a", paused=False, now=link.now)),
    ]
    link.run(120)
    assert not [each for each in link.polled["a"] if 50.1 < each < 80]
    assert len([each for each in link.polled["a"] if each >= 80]) >= 38
    assert len(link.polled["b"]) >= 117


def test_a_device_whose_first_request_was_not_sent_because_of_maintenance_is_asked_afterwards() -> None:
    schedule = LinkSchedule(1.0)
    schedule.add("a", book({"c": 5}), {"c": 1.0}, 0.0)
    first = schedule.next(0.0)
    assert isinstance(first, Turn)  # and there is no `done`: the poller drops it
    schedule.pause("a", paused=True, now=0.1)
    assert isinstance(schedule.next(0.2), float)
    schedule.pause("a", paused=False, now=5.0)
    assert schedule.next(5.0) == first
    schedule.done(first, 5.0, 5.1, TurnOutcome.ANSWERED)
    link = VirtualLink(schedule, now=5.1)
    link.run(20.0)
    assert len(link.polled["a"]) == pytest.approx(15, abs=1), "it is asked for the first time only once"
    assert TurnKind.PROBE not in {turn.kind for _, turn in link.turns}


def test_nothing_is_awaited_of_a_device_in_maintenance_that_has_something_to_learn() -> None:
    link = link_with({"a": book({"c": 5}), "b": book({"c": 5})}, {"c": 1.0})
    link.run(5)
    asking = link.schedule.devices["a"]
    asking.book._probes = None  # it may ask
    link.schedule.pause("a", paused=True, now=link.now)
    for _ in range(20):
        link.run(link.now + 1)
        turn = link.schedule.next(link.now)
        if isinstance(turn, float):
            assert turn > link.now, "the link's task would spin"
    assert asking.book.may_ask


def test_a_device_that_is_removed_and_added_again_is_polled_once_a_period() -> None:
    link = link_with({"a": book({"c": 5})}, {"c": 1.0})

    def again() -> None:
        link.schedule.remove("a")
        link.schedule.add("a", book({"c": 5}), {"c": 1.0}, link.now)

    link.hooks = [(10.0 + at, again) for at in range(50)]
    link.run(200)
    assert len([each for each in link.polled["a"] if each > 100]) == pytest.approx(100, abs=2)
    assert len(link.schedule._releases) <= 2


# A plant.


def test_of_a_thousand_devices_of_which_three_hundred_are_dead_every_other_keeps_its_period() -> None:
    source = random.Random(1)
    periods = {"fast": 5.0, "slow": 60.0}
    names = [f"d{at}" for at in range(1000)]
    dead = set(source.sample(names, 300))
    worst = 0.0
    for number in range(20):
        own = {name: book({"fast": source.randrange(5, 30), "slow": 20}) for name in names[number::20]}
        load = load_of_link(f"line {number}", [(name, each, periods) for name, each in own.items()], 0.5)
        assert load.fits, load.problems
        link = link_with(own, periods, timeout=0.5)
        link.keep = False
        link.dead = dead & set(own)
        link.run(300)
        bound = lateness_bound(5.0, link.schedule.blocking)
        for name, device in link.schedule.devices.items():
            if name in link.dead:
                assert device.rounds == 0
                continue
            assert device.skipped == 0
            gaps = [b - a for a, b in pairwise(link.polled[name])]
            assert max(gaps) <= 5.0 + bound
            assert device.rounds >= 60 * 0.8  # from its first contact on: that of dead ones takes a timeout each
            worst = max(worst, device.worst_wait)
            assert device.worst_wait <= lateness_bound(60.0, link.schedule.blocking)
            assert device.worst_fast <= bound
        assert len(link.schedule._ready) + len(link.schedule._releases) + len(link.schedule._silent._probes) <= 400
    assert worst > 0


# LinkLoad.


def test_a_link_that_fits_is_admitted_with_its_load() -> None:
    load = load_of_link("hall", [("a", book({"c": 5}), {"c": 5.0})], 1.0)
    assert load.fits
    assert load.load == pytest.approx(book({"c": 5}).plan_for(frozenset({"c"})).seconds / 5.0)


def test_an_overloaded_link_names_the_class_to_slow_and_a_period_that_fits() -> None:
    devices = [(f"d{at}", book({"fast": 30, "slow": 20}), {"fast": 2.0, "slow": 60.0}) for at in range(40)]
    load = load_of_link("hall", devices, 0.2)
    assert load.load > 0.85
    assert "give class fast a period of" in load.problems[0]
    period = float(load.problems[0].split("period of ")[1].split(" s")[0])
    slower = [(name, each, {"fast": period, "slow": 60.0}) for name, each, _ in devices]
    assert load_of_link("hall", slower, 0.2).fits


def test_a_class_that_one_timeout_can_make_late_is_named() -> None:
    both = [(name, book({"c": 5}), {"c": 0.5}) for name in "ab"]
    load = load_of_link("hall", both, 1.0)
    assert len(load.problems) == 1
    assert "class c has a period of 0.5 s" in load.problems[0]
    assert load_of_link("hall", both, 0.3).fits


def test_a_device_that_is_alone_waits_for_no_other() -> None:
    assert load_of_link("hall", [("a", book({"c": 5}), {"c": 0.5})], 1.0).fits
    assert not load_of_link("hall", [("a", book({"c": 5}), {"c": 0.01})], 1.0).fits


def test_a_network_link_is_judged_by_its_reads() -> None:
    load = load_of_link("plc", [("a", book({"c": 50}, network_cost()), {"c": 0.1})], 0.05)
    assert load.fits
    assert load.load == pytest.approx(0.05, rel=0.1)
