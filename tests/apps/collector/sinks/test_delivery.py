"""One delivery: cursor, repetition, a sink that is down, loss that is counted, samples that are refused, reports."""

import asyncio
import json
import sqlite3
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
from collected import METER, NOON, PUMP, SECOND, at, filled, read_of
from deliveries import RecordingSink, assert_in_order, commit_reads, delivered_once, delivery_to, run_until
from waiting import until, wait_until

from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import PointGroup, Reason, StateInterval
from busway.apps.collector.sinks.delivery import ASIDE, Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.sink_thread import SinkThread
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.writer import StoreOptions, StoreWriter
from busway.errors import ConfigError
from busway.points.point_rules import ReportRule


async def test_everything_that_is_committed_arrives_in_order(tmp_path: Path) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 10) as writer:
        await run_until(delivery_to(sink, writer, DeliveryOptions(age=0, most=7)), lambda: len(sink.taken) == 30)
        assert_in_order(sink.taken)
        assert max(sink.batches) <= 7
        assert [sample.value for sample in sink.taken if sample.point == "voltage"] == [230.0 + n for n in range(10)]
        assert sink.taken[0].commit < sink.taken[-1].commit


async def test_samples_of_its_age_go_in_one_batch(tmp_path: Path) -> None:
    sink, pauses = RecordingSink(), list[float]()
    with filled(tmp_path, 1) as writer:
        delivery = delivery_to(sink, writer, DeliveryOptions(age=7.0, most=1000))

        async def pause(seconds: float) -> None:
            """Let the age of a batch go by, in which the meter is read four times."""
            pauses.append(seconds)
            if len(pauses) == 4:
                await asyncio.Event().wait()
            commit_reads(writer, 4 * len(pauses), 4)

        delivery._pause = pause
        task = asyncio.create_task(delivery.run())
        await until(lambda: len(pauses) == 4)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert pauses == [7.0] * 4
    assert sink.batches == [3, 12, 12, 12]


async def test_a_delivery_goes_on_where_the_last_one_ended(tmp_path: Path) -> None:
    first, second = RecordingSink(), RecordingSink()
    with filled(tmp_path, 5) as writer:
        delivery = delivery_to(first, writer)
        await run_until(delivery, lambda: delivery.status().sent == 15 and delivery.status().cursor > 5)
    with StoreWriter(tmp_path, now=at(10)) as writer:
        commit_reads(writer, 20, 2)
        await run_until(delivery_to(second, writer), lambda: len(second.taken) == 6)
    assert {sample.time for sample in second.taken} == {at(20), at(21)}


async def test_a_batch_whose_answer_was_lost_comes_again_with_the_same_keys(tmp_path: Path) -> None:
    sink = RecordingSink()
    sink.takes_then_fails = 1
    with filled(tmp_path, 4) as writer:
        await run_until(delivery_to(sink, writer), lambda: len(sink.taken) == 24)
    assert sink.taken[:12] == sink.taken[12:]
    assert len(delivered_once(sink.taken)) == 12


async def test_a_sink_gets_a_point_that_is_named_with_its_index(tmp_path: Path) -> None:
    sink = RecordingSink()
    with StoreWriter(tmp_path, now=at(0)) as writer:
        writer.commit([read_of(PointGroup("plc", ("t[1]", "t[2]")), 1, 1, 2)], [], at(1))
        await run_until(
            delivery_to(sink, writer, DeliveryOptions(age=0, points=("plc/t[1]",))), lambda: bool(sink.taken)
        )
    assert [sample.point for sample in sink.taken] == ["t[1]"]


@pytest.mark.parametrize("sealed", [False, True])
async def test_a_sink_that_was_down_gets_everything_in_order_when_it_is_back(tmp_path: Path, sealed: bool) -> None:
    if sealed:
        pytest.importorskip("pyarrow")
    sink = RecordingSink()
    sink.is_down = True
    options = DeliveryOptions(age=0, most=10)
    with filled(tmp_path, 1, options=StoreOptions(seals=sealed)) as writer:
        delivery = delivery_to(sink, writer, options)
        await run_until(delivery, lambda: delivery.status().error is not None)
        assert "no answer" in (delivery.status().error or "")
        for part in range(3):
            commit_reads(writer, 1 + 20 * part, 20)
            writer.roll()
            writer.seal_closed()
        sink.is_down = False
        await run_until(delivery, lambda: len(sink.taken) >= 183)
        assert len(sink.taken) == 183
        assert_in_order(sink.taken)
        assert delivery.status().error is None
        assert delivery.status().lost == 0


async def test_samples_that_waited_too_long_are_dropped_and_counted(tmp_path: Path) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 10, step=100.0) as writer:  # at 0, 100 … 900; now is 1000
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0, keep=350.0))
        await run_until(delivery, lambda: len(sink.taken) == 9)
        assert {sample.time for sample in sink.taken} == {at(700), at(800), at(900)}
        assert delivery.status().lost == 21
        assert writer.manifest.cursors()["sink"][1] == 21


async def test_samples_whose_time_is_still_to_be_corrected_have_not_waited_too_long(tmp_path: Path) -> None:
    """A machine that was off for a month begins where it ended; its network, and so the time, come after a while."""
    month, sink = 30 * 86_400 * SECOND, RecordingSink()
    with StoreWriter(tmp_path, now=at(0), clock_is_right=False) as writer:
        for second in range(1, 6):
            writer.commit([read_of(PUMP, second, second, reasons=Reason.CLOCK)], [], at(second))
        delivery = delivery_to(sink, writer)
        delivery._now = lambda: at(10) + month
        assert delivery._reader.last_before(at(3), 0) == 0
        await run_until(delivery, lambda: len(sink.taken) == 5)
        assert delivery.status().lost == 0
        writer.begin_mending(ClockCorrection(month, at(0), at(6)), writer.newest_commit)
        while writer.mend_next():
            pass
        assert delivery._reader.last_before(at(3) + month, 0) == 3


async def test_commits_that_are_old_by_a_wrong_clock_take_none_of_before_with_them(tmp_path: Path) -> None:
    sink = RecordingSink()
    sink.is_down = True
    with filled(tmp_path, 3) as writer:
        commit_reads(writer, -400, 2)  # a process with a clock that was never set
        commit_reads(writer, 10, 2)
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0, keep=300.0))
        delivery._now = lambda: at(20)
        await run_until(delivery, lambda: delivery.status().error is not None)
        assert delivery.status().lost == 0
        delivery._now = lambda: at(305)
        sink.is_down = False
        await run_until(delivery, lambda: delivery.status().cursor == writer.newest_commit)
        assert {sample.time for sample in sink.taken} == {at(10), at(11)}


def test_a_sink_that_is_removed_finishes_what_it_sends_so_that_its_successor_does_not_send_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrived, is_removed, taken = threading.Event(), asyncio.Event(), list[CommittedSample]()
    finish = Delivery.finish

    async def note_and_finish(delivery: Delivery, seconds: float) -> None:
        is_removed.set()  # `send` goes on in a later turn of the loop: it is under way when `finish` looks
        await finish(delivery, seconds)

    monkeypatch.setattr(Delivery, "finish", note_and_finish)

    class Slow(RecordingSink):
        """Sends until it is removed."""

        async def send(self, samples: Sequence[CommittedSample]) -> None:
            taken.extend(samples)
            is_removed.clear()
            arrived.set()
            await is_removed.wait()

    with filled(tmp_path, 10) as writer:
        options = DeliveryOptions(age=0, most=9)
        thread = SinkThread(writer, {"slow": (Slow(), options)})
        for _ in range(3):
            assert arrived.wait(10)
            thread.remove("slow")
            arrived.clear()
            thread.add("slow", Slow(), options)
        wait_until(lambda: len(taken) >= 30)
        thread.close()
    assert len(taken) == len(delivered_once(taken)) == 30


async def test_what_retention_takes_from_a_sink_is_counted(tmp_path: Path) -> None:
    sink = RecordingSink()
    options = StoreOptions(seals=False, retention=Retention(age=500))
    with filled(tmp_path, 20, options=options, step=100.0) as writer:
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0))
        assert len(writer.apply_retention(at(2000))) == 2
        await run_until(delivery, lambda: len(sink.taken) == 24)
        assert delivery.status().lost == 36


async def test_a_store_that_is_too_large_drops_what_a_dead_sink_has_not_got_counts_it_and_logs_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    options = StoreOptions(seals=False, retention=Retention(size=1_000_000), segment_size=1)
    with filled(tmp_path, 20, options=options, step=100.0) as writer:
        dead = delivery_to(RecordingSink(), writer, DeliveryOptions(age=0))
        assert writer.apply_retention(at(2000)) == []
        for part in writer.manifest.parts()[:2]:
            with writer.manifest.transaction() as database:
                database.execute("UPDATE parts SET bytes = 600000 WHERE id = ?", (part.id,))
        dropped = writer.apply_retention(at(2000))
        lost = sum(part.rows or 0 for part in dropped)
        assert lost > 0
        assert writer.manifest.cursors()["sink"] == (0, lost)
        await run_until(dead, lambda: dead.status().lost == lost)
        assert f"sink sink: {lost} samples were dropped with the oldest parts of the store" in caplog.text


def full(*arguments: object) -> None:
    raise sqlite3.OperationalError("database or disk is full")


async def test_a_full_disk_ends_no_delivery_and_nothing_is_sent_twice_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 10) as writer:
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0, most=6))
        with monkeypatch.context() as disk:
            disk.setattr(writer.manifest, "set_cursor", full)
            await run_until(delivery, lambda: len(sink.taken) >= 6 and delivery.status().error is not None)
            disk.setattr(delivery._reader, "read", full)
            await run_until(delivery, lambda: True)
            assert delivery.status().error == "the store cannot be used now: database or disk is full"
        await run_until(delivery, lambda: len(sink.taken) >= 30 and delivery.status().error is None)
        assert writer.manifest.cursors()["sink"][0] == delivery.status().cursor
    assert_in_order(sink.taken)
    assert len(sink.taken) == 30


async def test_a_delivery_goes_on_while_its_cursor_cannot_be_saved_and_saves_it_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 10, step=100.0) as writer:  # at 0, 100 … 900; now is 1000
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0, most=6, keep=550.0))
        with monkeypatch.context() as disk:
            disk.setattr(writer.manifest, "set_cursor", full)
            await run_until(delivery, lambda: len(sink.taken) == 15)
            assert delivery.status().error == "the store cannot be used now: database or disk is full"
            assert writer.manifest.cursors()["sink"] == (0, 0)
        await run_until(delivery, lambda: delivery.status().error is None)
        assert writer.manifest.cursors()["sink"] == (delivery.status().cursor, 15)
    assert_in_order(sink.taken)
    assert (len(sink.taken), delivery.status().lost) == (15, 15)


async def test_a_cursor_that_could_not_be_saved_is_saved_at_the_end_so_that_the_next_start_sends_nothing_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 3) as writer:
        delivery = delivery_to(sink, writer)
        with monkeypatch.context() as disk:
            disk.setattr(writer.manifest, "set_cursor", full)
            await run_until(delivery, lambda: len(sink.taken) == 9)
        await delivery.finish(60.0)
        assert writer.manifest.cursors()["sink"] == (writer.newest_commit, 0)


async def test_what_arrived_of_a_batch_before_the_sink_went_away_is_neither_sent_nor_set_aside_again(
    tmp_path: Path,
) -> None:
    class Leaving(RecordingSink):
        """Refuses one sample, and takes what comes behind it only when it is back."""

        async def send(self, samples: Sequence[CommittedSample]) -> None:
            if is_away and samples[0].time >= at(2):
                raise SinkDown("no answer")
            await super().send(samples)

    is_away = True
    sink = Leaving(poison=lambda sample: sample.point == "current" and sample.value == 1)
    with filled(tmp_path, 4) as writer:
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: sink.opened == 5)
        assert {sample.time for sample in sink.taken} == {at(0), at(1)}
        commit_reads(writer, 4, 1)
        is_away = False
        await run_until(delivery, lambda: delivery.status().cursor == writer.newest_commit)
        assert (delivery.status().sent, delivery.status().set_aside) == (14, 1)
    assert len(sink.taken) == len(delivered_once(sink.taken)) == 14
    assert_in_order(sink.taken)
    assert len((tmp_path / ASIDE / "sink.jsonl").read_text().splitlines()) == 1


async def test_a_set_aside_line_that_was_cut_off_is_ended_before_the_next(tmp_path: Path) -> None:
    sink = RecordingSink(poison=lambda sample: sample.point == "current" and sample.value == 1)
    (tmp_path / ASIDE).mkdir()
    path = tmp_path / ASIDE / "sink.jsonl"
    path.write_text('{"device": "met')  # the disk was full in the middle of a line
    with filled(tmp_path, 2) as writer:
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().set_aside == 1)
    cut, line = path.read_text().splitlines()
    assert cut == '{"device": "met'
    assert json.loads(line)["point"] == "current"


async def test_a_refused_sample_is_found_set_aside_and_told_and_all_others_arrive(tmp_path: Path) -> None:
    sink = RecordingSink(poison=lambda sample: sample.point == "current" and sample.value == 3)
    with filled(tmp_path, 10) as writer:
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: len(sink.taken) == 29)
        assert_in_order(sink.taken)
        status = delivery.status()
    assert (status.set_aside, status.sent) == (1, 29)
    assert "a value is refused" in (status.error or "")
    (line,) = (tmp_path / ASIDE / "sink.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "device": "meter-7",
        "point": "current",
        "time": at(3),
        "value": 3,
        "reason": "",
        "error": "a value is refused",
    }


async def test_a_refused_sample_that_cannot_be_set_aside_is_counted_once_and_all_others_arrive_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sink = RecordingSink(poison=lambda sample: sample.point == "current")
    (tmp_path / ASIDE).write_text("no folder, so nothing can be written into it")
    with filled(tmp_path, 5) as writer:
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: len(sink.taken) == 10 and delivery.status().cursor >= 5)
        assert len(delivered_once(sink.taken)) == 10
        assert (delivery.status().set_aside, delivery.status().sent) == (5, 10)
        assert "a value is refused; it cannot be set aside: " in (delivery.status().error or "")
        assert caplog.text.count("cannot be set aside, and is only counted: ") == 1
        (tmp_path / ASIDE).unlink()
        commit_reads(writer, 5, 1)
        await run_until(delivery, lambda: delivery.status().set_aside == 6)
    assert delivery.status().error == "a value is refused"
    (line,) = (tmp_path / ASIDE / "sink.jsonl").read_text().splitlines()
    assert json.loads(line)["time"] == at(5)


async def test_a_sink_that_has_refused_a_sample_is_said_to_be_down_only_while_it_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sink = RecordingSink(poison=lambda sample: sample.point == "current" and sample.value == 0)
    with filled(tmp_path, 1) as writer:
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().set_aside == 1)
        sink.is_down = True
        commit_reads(writer, 1, 1)
        await run_until(delivery, lambda: delivery.status().error == "no answer")
        assert caplog.text.count("sink sink is down: no answer") == 1
        sink.is_down = False
        await run_until(delivery, lambda: len(sink.taken) == 5)
        assert delivery.status().error == "a value is refused"


async def test_only_the_points_that_are_named_are_sent(tmp_path: Path) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 5) as writer:
        await run_until(
            delivery_to(sink, writer, DeliveryOptions(age=0, points=("*/volt*", "pump-1/*"))),
            lambda: len(sink.taken) == 5,
        )
    assert {sample.point for sample in sink.taken} == {"voltage"}


async def test_with_a_rule_of_change_only_changes_are_sent_and_quality_always(tmp_path: Path) -> None:
    sink = RecordingSink()
    options = DeliveryOptions(age=0, report=ReportRule("change", deadband=1.0, max_silence=50.0))
    with StoreWriter(tmp_path, now=NOON) as writer:
        for second, value, reason in (
            (0, 10.0, 0),
            (1, 10.5, 0),
            (2, 11.5, 0),
            (3, 11.5, Reason.HELD),
            (4, None, Reason.TIMEOUT),
            (5, 11.5, 0),
            (6, 11.5, 0),
            (60, 11.5, 0),
        ):
            writer.commit([read_of(PUMP, second, value, reasons=reason)], [], at(second))
        await run_until(delivery_to(sink, writer, options), lambda: len(sink.taken) == 6)
    assert [sample.time for sample in sink.taken] == [at(second) for second in (0, 2, 3, 4, 5, 60)]


async def test_an_interval_is_a_sample_without_a_value_for_each_point(tmp_path: Path) -> None:
    sink = RecordingSink()
    with filled(tmp_path, 1) as writer:
        writer.commit([], [StateInterval("meter-7", at(5), None, Reason.SUSPENDED)], at(5))
        writer.commit([], [StateInterval("meter-7", at(5), at(9), Reason.SUSPENDED)], at(9))
        await run_until(delivery_to(sink, writer), lambda: len(sink.taken) == 6)
    marks = [(sample.point, sample.time, sample.value, sample.reason) for sample in sink.taken[3:]]
    assert marks == [(point, at(5), None, Reason.SUSPENDED) for point in METER.points]


async def test_a_sink_that_fails_in_open_is_closed_before_it_is_opened_again(tmp_path: Path) -> None:
    sink = RecordingSink()
    sink.is_down = True
    with filled(tmp_path, 1) as writer:
        delivery = delivery_to(sink, writer)
        with pytest.raises(SinkDown):
            await delivery.step()
        await run_until(delivery, lambda: sink.opened >= 3)
    assert sink.closed >= sink.opened - 1


def test_a_sink_that_hangs_delays_no_other_and_no_commit(tmp_path: Path) -> None:
    arrived = threading.Event()

    class Hanging(RecordingSink):
        async def send(self, samples: object) -> None:
            await asyncio.Event().wait()

    class Quick(RecordingSink):
        async def send(self, samples: object) -> None:
            arrived.set()

    with filled(tmp_path, 1) as writer:
        quick = DeliveryOptions(age=0)
        thread = SinkThread(writer, {"hanging": (Hanging(), quick), "quick": (Quick(), quick)})
        assert arrived.wait(10)
        commit_reads(writer, 5, 5)
        thread.close()
        assert {status.name: status.sent > 0 for status in thread.statuses()} == {"hanging": False, "quick": True}


def test_a_sink_that_breaks_is_logged_and_ends_no_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:

    arrived = threading.Event()

    class Broken(RecordingSink):
        async def open(self) -> None:
            raise ZeroDivisionError

    class Quick(RecordingSink):
        async def send(self, samples: object) -> None:
            arrived.set()

    with filled(tmp_path, 1) as writer:
        options = DeliveryOptions(age=0)
        thread = SinkThread(writer, {"broken": (Broken(), options), "quick": (Quick(), options)})
        assert arrived.wait(10)
        wait_until(lambda: thread.statuses()[0].error == "failed unexpectedly: ZeroDivisionError")
        thread.close()
    assert "sink broken failed" in caplog.text


def test_sinks_that_are_closed_at_once_end_at_once(tmp_path: Path) -> None:
    with filled(tmp_path, 1) as writer:
        for _ in range(20):
            thread = SinkThread(writer, {"quick": (RecordingSink(), DeliveryOptions(age=0))})
            thread.close(timeout=5.0)
            assert not thread._thread.is_alive()


def test_names_and_options_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with filled(tmp_path, 1) as writer, pytest.raises(ConfigError, match="is no name of a sink"):
        SinkThread(writer, {"../x": (RecordingSink(), DeliveryOptions())})
    for wrong in ({"most": 0}, {"age": -1.0}, {"keep": 0.1}):
        with pytest.raises(ConfigError):
            DeliveryOptions(**wrong)  # type: ignore[arg-type]
