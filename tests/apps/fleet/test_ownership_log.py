"""The record of ownership: what is recorded late, after the same commit, or with a clock that was set back."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.store.backup import back_up, restore
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.apps.fleet.ownership_log import OwnershipLog

FIRST, SECOND, THIRD = Epoch(1, 10), Epoch(1, 20), Epoch(1, 30)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[OwnershipLog]:
    with closing(OwnershipLog(tmp_path)) as opened:
        yield opened


def again(log: OwnershipLog, folder: Path) -> OwnershipLog:
    """The same file at the next start."""
    log.close()
    return OwnershipLog(folder)


def test_a_gap_that_is_on_disk_after_later_commits_were_sent_belongs_to_the_next_ones(log: OwnershipLog) -> None:
    assert log.gaps(0, 10) == []
    assert log.gaps(10, 12) == [], "commits of other links, which are sent while the disk is waited for"
    gap = OwnershipGap("hall", SECOND, 11, ("meter",), 1000, 2000)
    log.begin([("hall", SECOND)], 10, 2000, [gap])
    assert log.gaps(12, 12) == []
    (found,) = log.gaps(12, 13)
    assert (found.epoch, found.commit, found.begin, found.end) == (SECOND, 13, 1000, 2000)
    assert log.epoch_of("hall", 12) is None
    assert log.epoch_of("hall", 13) == SECOND


def test_a_gap_that_is_on_disk_before_the_commits_after_it_are_sent_keeps_its_place(log: OwnershipLog) -> None:
    assert log.gaps(0, 10) == []
    log.begin([("hall", SECOND)], 10, 2000, [OwnershipGap("hall", SECOND, 11, ("meter",), 1000, 2000)])
    assert [each.commit for each in log.gaps(10, 12)] == [11]
    assert [each.commit for each in log.gaps(10, 11)] == [11]
    assert log.gaps(0, 10) == []
    assert log.gaps(11, 12) == []


def test_two_gaps_with_equal_times_and_epochs_of_two_links_are_two(log: OwnershipLog) -> None:
    gaps = [OwnershipGap(link, FIRST, 1, (f"meter of {link}",), 1000, 2000) for link in ("hall", "roof")]
    log.begin([("hall", FIRST), ("roof", FIRST)], 0, 2000, gaps)
    assert log.gaps(0, 1) == gaps


def test_a_commit_that_was_sent_keeps_its_revision(log: OwnershipLog) -> None:
    log.set_configuration(3, 0)
    log.gaps(0, 12)
    before = [log.revision_of(commit) for commit in range(14)]
    log.set_configuration(4, 10)
    assert [log.revision_of(commit) for commit in range(13)] == before[:13]
    assert log.revision_of(13) == 4


@pytest.mark.parametrize("second_begin", [50, 100, 200])
def test_of_ownerships_after_the_same_commit_the_last_one_counts_also_after_the_clock_was_set_back(
    log: OwnershipLog, tmp_path: Path, second_begin: int
) -> None:
    log.begin([("hall", FIRST), ("roof", FIRST)], 7, 100)
    log.end([("hall", FIRST), ("roof", FIRST)], 7, 150)
    log.begin([("hall", SECOND)], 7, second_begin)
    for _ in range(2):
        assert log.epoch_of("hall", 7) is None
        assert log.epoch_of("hall", 8) == SECOND
        assert log.epoch_of("roof", 8) == FIRST
        assert log.unended() == {"hall": SECOND}, "it ended with the process"
        log = again(log, tmp_path)
    log.close()


def test_a_link_that_goes_on_in_its_epoch_is_owned_until_that_ends(log: OwnershipLog, tmp_path: Path) -> None:
    log.begin([("hall", FIRST)], 7, 100)
    log.end([("hall", FIRST)], 9, 150)
    log.begin([("hall", FIRST)], 12, 200)
    opened = again(log, tmp_path)
    assert opened.unended() == {"hall": FIRST}
    assert opened.epoch_of("hall", 13) == FIRST
    opened.end([("hall", FIRST)], 13, 250)
    opened.begin([("hall", THIRD)], 13, 250)
    assert opened.unended() == {"hall": THIRD}
    opened.close()


def test_the_record_is_part_of_a_backup_of_the_store(tmp_path: Path) -> None:
    gap = OwnershipGap("hall", SECOND, 11, ("meter",), 1000, 2000)
    with StoreWriter(tmp_path / "store", now=1_800_000_000 * 10**9), closing(OwnershipLog(tmp_path / "store")) as log:
        log.set_configuration(3, 0)
        log.begin([("hall", SECOND)], 10, 2000, [gap])
        back_up(tmp_path / "store", tmp_path / "backup")
        restore(tmp_path / "backup", tmp_path / "restored")
        with closing(OwnershipLog(tmp_path / "restored")) as restored:
            assert restored.store == log.store
            assert restored.all() == log.all()
            assert restored.gaps(0, 20) == [gap]
            assert (restored.epoch_of("hall", 11), restored.revision_of(11)) == (SECOND, 3)


@pytest.mark.parametrize(("of_one_clock", "begin"), [(True, 51_000), (False, 1000)])
def test_times_from_before_the_clock_was_set_are_corrected_where_this_start_recorded_them(
    log: OwnershipLog, tmp_path: Path, of_one_clock: bool, begin: int
) -> None:
    for number, (after, epoch) in enumerate([(9, FIRST), (10, SECOND)]):
        log.begin([("hall", epoch)], after, 2000 + number, [OwnershipGap("hall", epoch, 0, ("meter",), 1000, 2000)])
    log.end([("hall", SECOND)], 12, 3000)
    log.mend(ClockCorrection(50_000, 0, 3000), 10, of_one_clock=of_one_clock)
    assert [(each.begin, each.end) for each in log.gaps(0, 20)] == [(1000, 2000), (begin, 52_000)]
    assert [(each.begin, each.end) for each in log.all()] == [(2000, None), (52_001, 3000)], "that end is later"
