"""Silent devices: when they are probed, what time probes take, alone and in the schedule of a link."""

from itertools import pairwise

import pytest
from virtual_link import VirtualLink, book, link_with

from busway.apps.collector.schedule import LinkSchedule, TurnKind
from busway.apps.collector.silent_devices import DEAD_SHARE, LONGEST_BACKOFF, SilentDevices


def silent_devices(*names: str, timeout: float = 1.0, share: float = 1.0) -> SilentDevices:
    """Devices of a link at time 0, none of which was asked yet."""
    silent = SilentDevices(timeout, share)
    for name in names:
        silent.add(name)
    silent.credit_until(0.0)
    return silent


def test_a_device_that_was_polled_is_probed_at_once_and_then_after_pauses_that_double() -> None:
    silent = silent_devices("a")
    pauses = []
    for time in range(8):
        silent.unanswered("a", 100.0 * time, 4.0, was_polled=not time, was_down=False)
        due = silent.next_probe_at(100.0 * time)
        assert due is not None
        pauses.append(due - 100.0 * time)
        assert silent.take_due(due) == "a"
    assert pauses == [0.0, 4.0, 8.0, 16.0, 32.0, LONGEST_BACKOFF, LONGEST_BACKOFF, LONGEST_BACKOFF]


def test_a_device_that_never_answered_is_probed_after_its_shortest_period() -> None:
    silent = silent_devices("a")
    silent.unanswered("a", 10.0, 4.0, was_polled=False, was_down=False)
    assert silent.take_due(13.9) is None
    assert silent.take_due(14.0) == "a"


def test_the_pause_of_a_device_that_is_silent_for_years_stays_a_number() -> None:
    silent = silent_devices("a")
    for _ in range(2000):
        silent.unanswered("a", 0.0, 4.0, was_polled=False, was_down=False)
    assert silent.next_probe_at(0.0) == LONGEST_BACKOFF


def test_an_answer_to_a_read_ends_a_silence_and_one_to_a_write_makes_its_pause_short() -> None:
    silent = silent_devices("a")
    for _ in range(6):
        silent.unanswered("a", 0.0, 4.0, was_polled=False, was_down=False)
    silent.answered("a", 1.0, is_read=False)
    assert silent.next_probe_at(1.0) == LONGEST_BACKOFF, "it is silent still"
    silent.unanswered("a", 60.0, 4.0, was_polled=False, was_down=False)
    assert silent.next_probe_at(60.0) == 64.0
    silent.answered("a", 65.0, is_read=True)
    assert silent.next_probe_at(65.0) is None
    assert silent.take_due(1000.0) is None


def test_devices_are_probed_in_the_order_of_their_times() -> None:
    silent = silent_devices("a", "b", "c")
    silent.unanswered("a", 0.0, 9.0, was_polled=False, was_down=False)
    silent.unanswered("b", 0.0, 3.0, was_polled=False, was_down=False)
    silent.unanswered("c", 0.0, 9.0, was_polled=False, was_down=False)
    assert [silent.take_due(20.0) for _ in range(4)] == ["b", "a", "c", None]


def test_probes_wait_while_their_share_of_the_time_is_used_up() -> None:
    silent = silent_devices("a", share=0.1)
    assert silent.has_saved_a_timeout
    silent.probed(1.0, is_silent=True)  # what was saved up is gone
    silent.unanswered("a", 1.0, 1.0, was_polled=True, was_down=False)
    silent.credit_until(1.0)
    assert silent.take_due(1.0) == "a"
    silent.probed(2.0, is_silent=True)
    silent.unanswered("a", 3.0, 1.0, was_polled=False, was_down=False)
    silent.credit_until(3.0)
    assert silent.take_due(10.0) is None
    assert silent.next_probe_at(3.0) == pytest.approx(20.0), "a tenth of 20 s are the 2 s beyond what was saved up"
    silent.credit_until(20.0)
    assert silent.take_due(20.0) == "a"
    assert not silent.has_saved_a_timeout


def test_one_timeout_is_saved_up_at_most() -> None:
    silent = silent_devices("a", timeout=2.0, share=0.5)
    silent.credit_until(1000.0)
    silent.probed(2.0, is_silent=True)
    silent.credit_until(1001.0)
    assert not silent.has_saved_a_timeout
    silent.credit_until(1004.0)
    assert silent.has_saved_a_timeout


def test_the_first_read_of_a_device_that_answers_uses_the_share_and_is_no_time_of_probes() -> None:
    silent = silent_devices("a")
    silent.probed(0.5, is_silent=False)
    assert silent.probing == 0.0
    assert not silent.has_saved_a_timeout
    silent.probed(0.25, is_silent=True)
    assert silent.probing == 0.25


def test_when_one_device_of_a_lost_link_answers_the_others_that_were_asked_then_are_probed_at_once() -> None:
    silent = silent_devices("a", "b", "dead", "in maintenance")
    for name in ("a", "b", "in maintenance"):
        silent.unanswered(name, 0.0, 50.0, was_polled=False, was_down=True)
    silent.unanswered("dead", 0.0, 50.0, was_polled=False, was_down=False)
    silent.leave_alone("in maintenance")
    silent.answered("a", 10.0, is_read=True)
    assert [silent.take_due(10.0) for _ in range(2)] == ["b", None]
    assert silent.next_probe_at(10.0) == 50.0


def test_a_device_in_maintenance_is_probed_only_afterwards_and_then_at_once() -> None:
    silent = silent_devices("a")
    silent.unanswered("a", 0.0, 4.0, was_polled=True, was_down=False)
    silent.leave_alone("a")
    assert silent.take_due(100.0) is None
    assert silent.next_probe_at(100.0) is None
    silent.probe_now("a", 200.0)
    assert silent.take_due(200.0) == "a"


def test_a_device_that_was_removed_or_added_again_is_not_probed() -> None:
    silent = silent_devices("a", "b")
    for name in ("a", "b"):
        silent.unanswered(name, 0.0, 4.0, was_polled=True, was_down=False)
    silent.remove("a")
    silent.remove("a")  # and once more does no harm
    silent.add("b")
    assert silent.take_due(100.0) is None


# In the schedule of a link.


def test_silent_devices_use_a_twentieth_of_the_time_of_a_link_at_most() -> None:
    link = link_with({f"d{at}": book({"c": 5}) for at in range(20)}, {"c": 2.0})
    link.dead = {f"d{at}" for at in range(10)}
    link.run(3000)
    assert link.schedule.probing <= DEAD_SHARE * 3000 + 2 * link.schedule.timeout
    assert link.schedule.probing >= 0.5 * DEAD_SHARE * 3000  # and it is used


def test_where_all_devices_answer_no_time_counts_as_that_of_probes() -> None:
    link = link_with({f"d{at}": book({"c": 5}) for at in range(20)}, {"c": 2.0})
    link.run(20)
    assert link.schedule.busy > 0.0
    assert link.schedule.probing == 0.0


@pytest.mark.parametrize("seconds", [10.0, 60.0])
def test_in_a_short_time_probes_may_use_two_timeouts_more_than_their_share(seconds: float) -> None:
    """Wherever the time begins: one that was saved up, and one of the probe that began with the last of it."""
    link = link_with({f"d{at}": book({"c": 5}) for at in range(20)}, {"c": 2.0})
    link.run(100)
    link.dead = {f"d{at}" for at in range(10)}
    link.run(1000)
    probes = [began for began, turn in link.turns if turn.kind is TurnKind.PROBE and began > 20]
    most = max(sum(begin <= each < begin + seconds for each in probes) for begin in probes) * link.schedule.timeout
    assert most <= DEAD_SHARE * seconds + 2 * link.schedule.timeout
    assert most > DEAD_SHARE * seconds + 0.5 * link.schedule.timeout, "and it is used"


def test_a_silent_device_is_probed_by_its_cheapest_read_at_once_and_then_ever_more_rarely() -> None:
    """Of three reads the narrowest; the share of the link is not what holds the probes back here."""
    own = book({"wide": 40, "narrow": 1, "middle": 9})
    schedule = LinkSchedule(1.0, share=1.0)
    schedule.add("a", own, {"wide": 4.0, "narrow": 60.0, "middle": 8.0}, 0.0)
    link = VirtualLink(schedule)

    def falls_silent() -> None:
        for _, turn in link.turns:
            for read in turn.reads:
                own.succeeded(read, read.seconds)
        link.dead.add("a")

    link.hooks = [(100.0, falls_silent)]
    link.run(600)
    probes = [(began, turn) for began, turn in link.turns if turn.kind is TurnKind.PROBE and began > 100]
    (narrow,) = {turn.reads for _, turn in probes}
    assert [(read.start, read.width) for read in narrow] == [(280, 2)]
    assert narrow[0].seconds == min(read.seconds for _, turn in link.turns for read in turn.reads)
    first = max(began for began, turn in link.turns if turn.kind is TurnKind.ROUND)
    waits = [after - before for before, after in pairwise([first, *(began for began, _ in probes)])]
    assert waits[:2] == pytest.approx([1.0, 5.0]), "after its timeout, then after its shortest period more"
    assert waits[1:] == pytest.approx([1.0 + min(4.0 * 2**place, LONGEST_BACKOFF) for place in range(len(waits) - 1)])
    assert waits[-1] == pytest.approx(1.0 + LONGEST_BACKOFF)


def test_a_device_that_is_silent_for_a_moment_misses_one_or_two_rounds() -> None:
    link = link_with({"a": book({"c": 5}), "b": book({"c": 5})}, {"c": 5.0})
    link.hooks = [(100.0, lambda: link.dead.add("a")), (103.0, link.dead.clear)]
    link.run(200)
    gaps = [b - a for a, b in pairwise(link.polled["a"])]
    assert 7 < max(gaps) <= 5.0 + 5.0 + 2 * link.schedule.timeout + 0.1  # missed twice: by its round and its probe


def test_a_device_that_comes_back_is_polled_within_the_bound() -> None:
    link = link_with({f"d{at}": book({"c": 5}) for at in range(20)}, {"c": 2.0})
    link.dead = {f"d{at}" for at in range(8)}
    link.run(2000)
    assert "d3" not in link.polled
    link.dead.discard("d3")
    bound = link.schedule.revival_bound
    link.run(2000 + bound + 2.0)
    assert "d3" in link.polled
    assert bound < 300


def test_a_link_that_comes_back_has_all_its_devices_back_at_once() -> None:
    link = link_with({f"d{at}": book({"c": 5}) for at in range(20)}, {"c": 2.0})
    link.hooks = [(100.0, lambda: setattr(link, "is_down", True)), (500.0, lambda: setattr(link, "is_down", False))]
    link.run(700)
    for times in link.polled.values():
        after = [each for each in times if each > 500]
        assert after[0] < 500 + LONGEST_BACKOFF + 5
