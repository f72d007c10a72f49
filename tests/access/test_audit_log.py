"""The audit log's file: when lines stand in it, what happens when it cannot be written, rotation and rights."""

import asyncio
import errno
import json
import os
import stat
import threading

import pytest

from busway.access.audit_log import AuditLog, WallClock
from busway.errors import ConfigError


class FakeTime:
    """A clock and a schedule that only go on when told."""

    def __init__(self):
        self.now = 0.0
        self.later = []

    def __call__(self):
        return self.now

    def schedule(self, seconds, function):
        self.later.append((self.now + seconds, function))
        return True

    def advance(self, seconds):
        self.now += seconds
        due = [each for each in self.later if each[0] <= self.now]
        self.later = [each for each in self.later if each[0] > self.now]
        for _, function in due:
            function()


class Disk:
    """Takes the place of ``os.write``: full after some bytes."""

    def __init__(self, monkeypatch, room=None):
        self.room = room
        self.calls = 0
        self._write = os.write
        monkeypatch.setattr("busway.access.audit_log.os.write", self)

    def __call__(self, file, data):
        self.calls += 1
        if self.room is not None:
            if not self.room:
                raise OSError(errno.ENOSPC, "No space left on device")
            data = data[: self.room]
            self.room -= len(data)
        return self._write(file, data)


@pytest.fixture
def time():
    return FakeTime()


def opened(tmp_path, time, **options):
    return AuditLog(tmp_path / "audit.jsonl", clock=time, schedule=time.schedule, **options)


def test_lines_stand_in_the_file_after_the_interval_at_the_latest(tmp_path, time):
    log = opened(tmp_path, time)
    log.append('{"a":1}\n')
    time.advance(0.1)
    log.append('{"a":2}\n')
    assert log.path.read_text() == ""
    time.advance(0.1)
    assert log.path.read_text() == '{"a":1}\n{"a":2}\n'
    assert log.written == 2
    assert time.later == []


def test_many_lines_do_not_wait_and_go_in_one_write(tmp_path, time, monkeypatch):
    disk = Disk(monkeypatch)
    log = opened(tmp_path, time)
    for _ in range(1000):
        log.append("x" * 99 + "\n")
    assert disk.calls == 1
    assert 500 < log.path.read_text().count("\n") < 1000
    log.close()
    assert log.path.read_text().count("\n") == 1000


def test_many_lines_set_no_timer_while_there_is_one_and_the_last_are_written_in_time(tmp_path, time):
    log = opened(tmp_path, time)
    for _ in range(2000):
        log.append("x" * 99 + "\n")
    assert len(time.later) == 1
    assert log.written < 2000
    time.advance(0.2)
    assert (log.written, time.later) == (2000, [])
    log.append("1\n")
    time.advance(0.2)
    assert log.written == 2001


def test_without_an_interval_or_a_timer_each_line_is_written_at_once(tmp_path, time):
    at_once = AuditLog(tmp_path / "one", interval=0, clock=time, schedule=time.schedule)
    at_once.append("1\n")
    assert at_once.path.read_text() == "1\n"
    alone = AuditLog(tmp_path / "two", clock=time, schedule=lambda seconds, function: False)
    alone.append("1\n")
    assert alone.path.read_text() == "1\n"


async def test_the_running_loop_is_who_calls_later(tmp_path):
    log = AuditLog(tmp_path / "log", interval=0.001)
    written = asyncio.Event()
    flush = log.flush
    log.flush = lambda: (flush(), written.set())
    log.append("1\n")
    await written.wait()
    assert log.path.read_text() == "1\n"
    log.close()


def test_a_timer_whose_loop_has_gone_holds_nothing_back(tmp_path, time):
    log = opened(tmp_path, time)
    log.append("1\n")
    time.later.clear()
    time.now += 2
    log.append("2\n")
    assert log.path.read_text() == "1\n2\n"


def test_it_is_only_for_its_owner_and_is_never_cut(tmp_path, time):
    mask = os.umask(0)
    try:
        with opened(tmp_path, time) as log:
            log.append("1\n")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(log.path.stat().st_mode) == 0o600
    with opened(tmp_path, time) as log:
        log.append("2\n")
    assert log.path.read_text() == "1\n2\n"


def test_two_logs_of_one_file_do_not_write_over_each_other(tmp_path, time):
    one, two = opened(tmp_path, time), opened(tmp_path, time)
    for log, text in ((one, "1\n"), (two, "2\n"), (one, "3\n")):
        log.append(text)
        log.flush()
    assert one.path.read_text() == "1\n2\n3\n"


def test_a_full_disk_is_said_once_and_what_is_kept_is_written_when_there_is_room(tmp_path, time, monkeypatch, caplog):
    disk = Disk(monkeypatch, room=10)
    log = opened(tmp_path, time)
    for number in range(4):
        log.append(f'{{"a":{number}}}\n')
    time.advance(0.2)
    assert log.path.read_text() == '{"a":0}\n{"'
    assert (log.is_failing, log.failures, log.written) == (True, 1, 1)
    assert log.takes_writes
    time.advance(1)
    time.advance(1)
    assert log.failures == 3
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert "no space left on device" in caplog.text
    disk.room = None
    log.append('{"a":4}\n')
    time.advance(1)
    assert [json.loads(line) for line in log.path.read_text().splitlines()] == [{"a": number} for number in range(5)]
    assert (log.is_failing, log.lost, log.written) == (False, 0, 5)


def test_what_cannot_be_kept_is_counted_and_the_file_says_how_much(tmp_path, time, monkeypatch):
    monkeypatch.setattr("busway.access.audit_log._KEPT", 100)
    disk = Disk(monkeypatch, room=0)
    log = opened(tmp_path, time)
    for _ in range(100):
        log.append('{"a":12}\n')
        time.advance(0.01)
    assert log.lost == 88
    disk.room = None
    time.advance(2)
    time.advance(2)
    found = [json.loads(line) for line in log.path.read_text().splitlines()]
    assert found[:12] == [{"a": 12}] * 12
    assert (found[12]["outcome"], found[12]["lines"], len(found)) == ("lost", 88, 13)


def test_while_it_fails_no_write_is_taken_if_that_is_wanted(tmp_path, time, monkeypatch):
    disk = Disk(monkeypatch, room=0)
    log = opened(tmp_path, time, on_failure="refuse")
    assert log.takes_writes
    log.append("1\n")
    time.advance(0.2)
    assert not log.takes_writes
    disk.room = None
    time.advance(1)
    assert log.takes_writes


def test_after_a_rotation_it_goes_on_in_the_new_file_with_whole_lines(tmp_path, time, monkeypatch):
    disk = Disk(monkeypatch, room=3)
    log = opened(tmp_path, time)
    log.append("11111\n")
    log.append("22222\n")
    time.advance(0.2)
    os.rename(log.path, tmp_path / "old")
    disk.room = 0
    log.reopen()
    disk.room = None
    time.advance(1)
    assert (tmp_path / "old").read_text() == "111"
    first, last = log.path.read_text().splitlines()
    assert first == "22222"
    assert json.loads(last)["lines"] == log.lost == 1


def test_a_rotation_to_a_place_that_cannot_be_keeps_the_old_file(tmp_path, time):
    (tmp_path / "folder").mkdir()
    log = AuditLog(tmp_path / "folder" / "log", clock=time, schedule=time.schedule)
    log.append("1\n")
    os.rename(tmp_path / "folder", tmp_path / "moved")
    with pytest.raises(ConfigError, match="cannot be opened: no such file"):
        log.reopen()
    log.append("2\n")
    log.close()
    assert (tmp_path / "moved" / "log").read_text() == "1\n2\n"


def test_a_log_that_was_closed_stays_closed_if_its_file_is_rotated(tmp_path, time):
    log = opened(tmp_path, time, on_failure="refuse")
    log.append('{"n":1}\n')
    log.close()
    log.path.rename(tmp_path / "audit.1")
    log.reopen()
    log.append('{"n":2}\n')
    assert not log.path.exists()
    assert (log.written, log.lost, log.takes_writes) == (1, 1, False)


def test_lines_after_the_end_are_counted_as_lost(tmp_path, time):
    log = opened(tmp_path, time)
    log.close()
    log.append("1\n")
    log.close()
    assert log.lost == 1
    assert log.path.read_text() == ""


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"interval": -1}, "interval"),
        ({"interval": 11}, "interval"),
        ({"on_failure": "x"}, "on_failure"),
        ({"repeat_interval": -1}, "repeat_interval"),
        ({"repeat_interval": 3601}, "repeat_interval"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, options, key):
    with pytest.raises(ConfigError) as caught:
        AuditLog(tmp_path / "log", **options)
    assert caught.value.key == key
    assert not (tmp_path / "log").exists()


def test_a_file_that_cannot_be_opened_is_named(tmp_path):
    with pytest.raises(ConfigError, match="the audit log cannot be opened"):
        AuditLog(tmp_path / "nowhere" / "log")


def test_lines_of_several_threads_are_whole(tmp_path, time):
    log = opened(tmp_path, time)
    start = threading.Barrier(4)

    def write(name):
        start.wait()
        for _ in range(2000):
            log.append(name * 50 + "\n")

    threads = [threading.Thread(target=write, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    lines = log.path.read_text().splitlines()
    assert len(lines) == 8000
    assert {(len(line), len(set(line))) for line in lines} == {(50, 1)}


def test_the_time_is_utc_with_milliseconds():
    assert WallClock(lambda: 1_772_366_400.25)() == "2026-03-01T12:00:00.250Z"
    assert WallClock(lambda: 0)() == "1970-01-01T00:00:00.000Z"


# ---- denials


class Denier:
    """Denies requests, each with a line of its own making."""

    def __init__(self, log):
        self.log = log
        self.denied = 0

    def __call__(self, host="10.0.0.7", rule="default"):
        self.denied += 1
        number = self.denied

        def line(repeated):
            return json.dumps({"outcome": "denied", "host": host, "rule": rule, "number": number, "r": repeated}) + "\n"

        self.log.append_denied((host, "", rule), line)


def found(log):
    return [json.loads(line) for line in log.path.read_text().splitlines()]


def stands_for(lines):
    """Denials that lines stand for."""
    return sum(each["r"] or 1 for each in lines if each["outcome"] == "denied" and "r" in each)


def test_repeated_denials_leave_the_first_line_at_once_and_then_one_with_their_number_per_interval(tmp_path, time):
    log = opened(tmp_path, time, interval=0, repeat_interval=60)
    deny = Denier(log)
    for _ in range(1000):
        deny()
    assert [each["number"] for each in found(log)] == [1]
    time.advance(60)
    assert [(each["number"], each["r"]) for each in found(log)] == [(1, 0), (1000, 999)]
    for _ in range(5):
        deny()
    time.advance(60)
    assert [(each["number"], each["r"]) for each in found(log)][2:] == [(1005, 5)]
    time.advance(60)
    assert time.later == []
    deny()
    assert found(log)[-1]["number"] == 1006  # the first again, after an interval without any
    assert stands_for(found(log)) == deny.denied


def test_denials_are_counted_apart_by_host_and_rule(tmp_path, time):
    log = opened(tmp_path, time, interval=0)
    deny = Denier(log)
    for _ in range(10):
        for host, rule in (("a", "one"), ("a", "two"), ("b", "one")):
            deny(host, rule)
    log.close()
    told = found(log)
    assert [(each["host"], each["rule"], each["r"]) for each in told] == [
        (host, rule, number) for number in (0, 9) for host, rule in (("a", "one"), ("a", "two"), ("b", "one"))
    ]
    assert stands_for(told) == deny.denied == 30


def test_with_an_interval_of_0_each_denial_leaves_its_line(tmp_path, time):
    log = opened(tmp_path, time, interval=0, repeat_interval=0)
    deny = Denier(log)
    for _ in range(10):
        deny()
    assert [each["number"] for each in found(log)] == list(range(1, 11))


def test_invented_senders_make_a_bounded_number_of_lines(tmp_path, time):
    log = opened(tmp_path, time, repeat_interval=60)
    deny = Denier(log)
    for number in range(5000):
        deny(f"10.0.{number >> 8}.{number & 255}")
    time.advance(60)
    log.close()
    told = found(log)
    assert len(told) == 1025
    assert told[-1]["outcome"] == "denied"
    assert told[-1]["repeated"] == 5000 - 1024
    assert stands_for(told) == 1024


def test_a_count_whose_loop_has_gone_is_told_with_the_next_denial(tmp_path, time):
    log = opened(tmp_path, time, interval=0)
    deny = Denier(log)
    deny()
    deny()
    time.later.clear()
    time.now += 62
    deny("b")
    assert [(each["host"], each["r"]) for each in found(log)] == [("10.0.0.7", 0), ("10.0.0.7", 1), ("b", 0)]


def test_denials_stop_where_little_of_the_disk_is_left_and_writes_still_go_in(tmp_path, time, caplog):
    room = [100_000]
    log = opened(tmp_path, time, interval=0, repeat_interval=0, room=lambda file: (room[0], 1_000_000))
    deny = Denier(log)
    deny()
    room[0] = 49_999  # under a twentieth
    time.advance(1)
    for _ in range(7):
        deny()
    log.append('{"outcome":"done"}\n')
    assert [each["outcome"] for each in found(log)] == ["denied", "done"]
    assert log.denials_left_out == 7
    assert "denials are not logged: the 49999 bytes left are kept for writes" in caplog.text
    room[0] = 50_000
    time.advance(1)
    deny()
    told = found(log)[2:]
    assert [each["outcome"] for each in told] == ["denials left out", "denied"]
    assert told[0]["lines"] == 7
    assert "denials are logged again" in caplog.text


def test_denials_that_left_no_line_are_told_at_the_end_and_before_a_rotation(tmp_path, time):
    log = opened(tmp_path, time, room=lambda file: (0, 1_000_000))
    deny = Denier(log)
    for _ in range(3):
        deny()
    log.reopen()
    assert [(each["outcome"], each["lines"]) for each in found(log)] == [("denials left out", 1)]
    log.close()
    assert [each["lines"] for each in found(log)] == [1, 2]


def test_what_is_kept_while_the_disk_is_full_has_room_for_writes_however_much_is_denied(tmp_path, time, monkeypatch):
    monkeypatch.setattr("busway.access.audit_log._KEPT", 4000)
    disk = Disk(monkeypatch, room=0)
    log = opened(tmp_path, time, repeat_interval=0)
    deny = Denier(log)
    for _ in range(1000):
        deny()
    for number in range(100):
        log.append(f'{{"outcome":"done","a":{number:3}}}\n')
    disk.room = None
    time.advance(2)
    told = found(log)
    assert [each["a"] for each in told if each["outcome"] == "done"] == list(range(100))
    assert log.lost == 0
    assert log.denials_left_out == 1000 - stands_for(told) > 900
