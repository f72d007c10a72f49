"""The journal of commands: each key once, results kept in order, old ones dropped, keys never forgotten."""

import logging
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from collected import filled
from commanded_plant import commanded_plant

import busway
from busway.apps.collector.commands.command import MADE, CommandResult, CommandState, OldValue, PointCommand
from busway.apps.collector.commands.journal import CUT_OFF, CommandJournal
from busway.apps.collector.store.backup import back_up, restore
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.folder import COMMANDS
from busway.apps.collector.store.store_reader import Store
from busway.errors import ConfigError, Overloaded


def open_command(key: str, value: float = 1.0) -> CommandResult:
    command = PointCommand(key, "boiler", "setpoint", value, "anna", "api", 2_000_000_000.0)
    return CommandResult(command, CommandState.OPEN, 1_900_000_000.0, OldValue(0.5, "good", 1_899_999_999.0))


def test_a_key_is_taken_once_and_gives_its_result_from_then_on(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path)
    assert journal.take(open_command("a")) is None
    assert journal.take(open_command("a", 2.0)) == open_command("a")
    done = open_command("a").finished(CommandState.DONE, read_back=1.0)
    journal.finish(done)
    assert journal.take(open_command("a")) == journal.find("a") == done
    journal.close()
    again = CommandJournal(tmp_path)
    assert again.end_cut_off() == []
    assert again.newest(10) == [done]
    again.close()


def test_what_was_open_when_the_process_ended_is_unknown(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path)
    for key in ("a", "b"):
        assert journal.take(open_command(key)) is None
    journal.finish(open_command("a").finished(CommandState.FAILED, "why"))
    journal.close()
    again = CommandJournal(tmp_path)
    (ended,) = again.end_cut_off()
    assert (ended.command.key, ended.state, ended.reason) == ("b", CommandState.UNKNOWN, CUT_OFF)
    assert again.take(open_command("b")) == ended
    again.close()


def test_results_are_kept_as_long_as_samples_and_keys_of_callers_for_longer(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    journal = CommandJournal(tmp_path, keep=3600.0)
    for number in range(10):
        done = open_command(f"k{number}").finished(CommandState.DONE)
        assert journal.take(replace(done, at=done.at + 900 * number)) is None
    assert [each.command.key for each in journal.newest(100)] == ["k9", "k8", "k7", "k6", "k5"]
    refused = journal.take(open_command("k0"))
    assert refused is not None
    assert refused.state is CommandState.REFUSED
    assert "results of old commands are no longer kept" in caplog.text
    journal.close()


def test_a_backup_has_the_journal_and_a_key_that_it_has_is_not_sent_again(tmp_path: Path) -> None:
    with filled(tmp_path / "store", 3):
        journal = CommandJournal(tmp_path / "store")
        assert journal.take(open_command("done")) is None
        done = open_command("done").finished(CommandState.DONE, read_back=1.0)
        journal.finish(done)
        assert journal.take(open_command("on-the-wire")) is None
        back_up(tmp_path / "store", tmp_path / "copy")
        journal.finish(open_command("on-the-wire").finished(CommandState.DONE))
        journal.close()
    restore(tmp_path / "copy", tmp_path / "again")
    assert len(Store(tmp_path / "again").read()) == 9
    again = CommandJournal(tmp_path / "again")
    assert [each.command.key for each in again.end_cut_off()] == ["on-the-wire"]
    assert again.take(open_command("done")) == done
    unknown = again.take(open_command("on-the-wire"))
    assert unknown is not None
    assert unknown.state is CommandState.UNKNOWN
    again.close()


def test_a_journal_that_is_damaged_is_found_by_the_check_of_the_store(tmp_path: Path) -> None:
    with filled(tmp_path, 3):
        pass
    (tmp_path / COMMANDS).write_bytes(b"no database at all, but long enough to be looked at" * 100)
    (problem,) = check_store_files(tmp_path)
    assert problem.startswith("commands.sqlite cannot be read")


def test_old_results_are_dropped_and_keys_of_callers_are_not_forgotten(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path, most=20)
    assert journal.take(open_command("open")) is None
    for number in range(50):
        key = f"{MADE}{number}" if number % 2 else f"k{number}"
        assert journal.take(open_command(key).finished(CommandState.DONE)) is None
    assert len(journal.newest(100)) <= 20
    assert journal.find("open") is not None  # an open one is never dropped
    assert journal.find("k0") is None
    refused = journal.take(open_command("k0"))
    assert refused is not None
    assert refused.state is CommandState.REFUSED
    assert "used before" in refused.reason
    journal.close()
    again = CommandJournal(tmp_path, most=20)
    assert again.take(open_command("k0")) == refused
    again.close()


def test_the_number_of_keys_of_callers_is_bounded_and_then_none_is_taken(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path, most=10, most_keys=5)
    taken = 0
    while journal._used < 5:
        assert journal.take(open_command(f"k{taken}").finished(CommandState.DONE)) is None
        taken += 1
    with pytest.raises(Overloaded, match="keys of callers"):
        journal.take(open_command("one-more"))
    assert journal.take(open_command(f"{MADE}1")) is None
    journal.close()


def test_a_journal_that_cannot_be_written_records_nothing(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path)
    other = sqlite3.connect(tmp_path / COMMANDS, isolation_level=None)
    journal._database.execute("PRAGMA busy_timeout=1")
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(OSError, match="cannot be written"):
        journal.take(open_command("a"))
    other.execute("ROLLBACK")
    other.close()
    assert journal.find("a") is None
    assert journal.take(open_command("a")) is None
    journal.close()


def test_every_transaction_waits_for_the_disk(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path)
    assert journal._database.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
    assert (tmp_path / COMMANDS).stat().st_mode & 0o777 == 0o600
    journal.close()


def test_a_file_that_is_no_journal_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / COMMANDS).write_bytes(b"no database at all, but long enough to be looked at" * 100)
    with pytest.raises(ConfigError, match=COMMANDS):
        CommandJournal(tmp_path)


def test_a_journal_that_cannot_be_read_says_so_as_an_error_of_the_system(tmp_path: Path) -> None:
    journal = CommandJournal(tmp_path)
    assert journal.take(open_command("a")) is None
    journal._database.execute("ALTER TABLE commands RENAME TO lost")
    for asked in (lambda: journal.find("a"), lambda: journal.newest(1), lambda: journal.take(open_command("a"))):
        with pytest.raises(OSError, match="the journal of commands cannot be"):
            asked()
    journal._database.execute("ALTER TABLE lost RENAME TO commands")
    assert journal.find("a") == open_command("a")
    journal.close()


async def test_a_collector_whose_journal_cannot_be_written_does_not_begin_and_leaves_it_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[CommandJournal] = []

    def cannot_be_written(journal: CommandJournal) -> list[CommandResult]:
        opened.append(journal)
        raise OSError("the journal of commands cannot be written: the disk is full")

    monkeypatch.setattr(CommandJournal, "end_cut_off", cannot_be_written)
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    with pytest.raises(ConfigError, match="the disk is full"):
        async with busway.collect(file):
            pass
    with pytest.raises(OSError, match="closed database"):
        opened[0].newest(1)
