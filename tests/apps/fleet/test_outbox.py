"""The outbox against a stream in memory: at least once, in order, and again after whatever the stream loses."""

import asyncio
import itertools
import sqlite3
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from waiting import until

from busway.apps.collector.cancellation import end_tasks
from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.sinks.delivery import CLOCK_WAIT
from busway.apps.collector.store.committed_samples import CommitReader, CommittedSample
from busway.apps.collector.store.manifest import Manifest
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet import outbox as outbox_module
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import MOST_BYTES, SampleMessage, longest_head, longest_row
from busway.apps.fleet.outbox import AGAIN_AFTER, AGAIN_LIMIT, OUTBOX, Outbox, SinkPlace, StreamDown
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.apps.fleet.streams import SinkProgress

NOW = 1_800_000_000 * 10**9


class MemoryStream:
    """Keeps messages until a test takes them; may refuse."""

    def __init__(self) -> None:
        self.messages: list[SampleMessage] = []
        self.shards: list[str] = []
        self.sinks: dict[str, SinkPlace] = {}
        self.is_up = True
        self.start = 0
        self.longest = MOST_BYTES
        self.is_back = asyncio.Event()

    async def connected_again(self) -> None:
        await self.is_back.wait()

    def most_bytes(self) -> int:
        return self.longest

    async def publish(self, message: SampleMessage, shard: str) -> None:
        if not self.is_up:
            raise StreamDown("it is full")
        assert len(message.encode()) <= self.longest
        self.messages.append(message)
        self.shards.append(shard)
        self.start = message.chain.start

    def places(self, collector: str, store: str) -> dict[str, SinkPlace]:
        assert (collector, store) == ("one", "s")
        return {name: replace(each, start=self.start if each.commit else 0) for name, each in self.sinks.items()}

    def commits(self) -> list[int]:
        return [each.commit for message in self.messages for each in message.samples]


class Sending:
    """A store and its outbox, with a clock that a test sets."""

    def __init__(self, folder: Path) -> None:
        self.writer = StoreWriter(folder, now=NOW)
        self.stream = MemoryStream()
        self.time = 0.0
        self.gaps: list[OwnershipGap] = []
        self.outbox = self.opened()
        self.rows = 0

    def opened(self) -> Outbox:
        return Outbox(
            self.writer.folder,
            self.writer.manifest,
            self.stream,
            collector="one",
            store="s",
            link_of=lambda: {"meter": "hall", "pump": "roof"},
            shard_of=lambda link: f"shard of {link}",
            epoch_of=lambda link, commit: Epoch(1, 10 if commit <= 4 else 20),
            gaps_of=lambda after, last: [each for each in self.gaps if after < each.commit <= last],
            now=lambda: self.time,
        )

    def commit(self, *devices: str) -> int:
        self.rows += 1
        batches = [
            SampleBatch(PointGroup(device, ("power",)), NOW + self.rows * 10**9, 5, (float(self.rows),))
            for device in devices
        ]
        return self.writer.commit(batches, [], NOW + self.rows * 10**9).number


async def test_samples_from_before_the_clock_was_set_are_sent_once_with_their_right_time(tmp_path: Path) -> None:
    def early(second: int) -> SampleBatch:
        return SampleBatch(PointGroup("meter", ("power",)), second * 10**9, 5, (float(second),))

    sending = Sending(tmp_path / "mended")
    sending.writer.close(NOW)
    with StoreWriter(tmp_path / "mended", now=60 * 10**9) as sending.writer:
        sending.outbox = sending.opened()
        for second in (61, 62):
            sending.writer.commit([early(second)], [], second * 10**9)
        for sending.time in (0.0, 1.0, CLOCK_WAIT):
            assert not await sending.outbox.step()
            assert sending.stream.commits() == []
        sending.writer.begin_mending(ClockCorrection(NOW), sending.writer.newest_commit)
        while sending.writer.mend_next():
            pass
        await sending.outbox.step()
        times = [each.time for message in sending.stream.messages for each in message.samples]
        assert times == [NOW + 61 * 10**9, NOW + 62 * 10**9]
    sending = Sending(tmp_path / "never")
    sending.writer.close(NOW)
    with StoreWriter(tmp_path / "never", now=60 * 10**9) as sending.writer:
        sending.outbox = sending.opened()
        sending.writer.commit([early(61)], [], 61 * 10**9)
        for _ in range(2):  # the gap since the end of the store comes first
            await sending.outbox.step()
        assert sending.stream.commits() == []
        sending.time += CLOCK_WAIT
        await sending.outbox.step()
        assert len(sending.stream.commits()) == 1, "it does not wait for ever"


async def test_commits_are_sent_once_by_link_and_epoch(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        numbers = [sending.commit("meter", "pump") for _ in range(5)]
        assert numbers == [2, 3, 4, 5, 6]
        assert not await sending.outbox.step()
        assert not await sending.outbox.step()
        assert not await sending.outbox.step()
        found = [
            (each.link, each.epoch, [sample.commit for sample in each.samples]) for each in sending.stream.messages
        ]
        assert found == [
            ("hall", Epoch(1, 10), [2, 3, 4]),
            ("hall", Epoch(1, 20), [5, 6]),
            ("roof", Epoch(1, 10), [2, 3, 4]),
            ("roof", Epoch(1, 20), [5, 6]),
            ("", None, []),
        ]
        assert [each.complete for each in sending.stream.messages] == [0, 0, 0, 0, 6]
        assert sending.stream.shards == [*["shard of hall"] * 2, *["shard of roof"] * 2, "none"]


async def test_the_cursor_moves_only_by_what_sinks_keep_and_a_restart_begins_there(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        for _ in range(4):
            sending.commit("meter")
        await sending.outbox.step()
        assert sending.writer.manifest.cursors()[OUTBOX] == (0, 0)
        sending.stream.sinks = {"broker": SinkPlace(3, 1), "archive": SinkPlace(5, 2)}
        await sending.outbox.step()
        assert sending.writer.manifest.cursors()[OUTBOX] == (3, 0)
        sending.outbox = sending.opened()
        sending.stream.messages.clear()
        await sending.outbox.step()
        assert sending.stream.commits() == [4, 5]


async def again(sending: Sending, seconds: float) -> list[int]:
    """The commits that are sent when so much time has passed."""
    sending.time += seconds
    sending.stream.messages.clear()
    await sending.outbox.step()
    return sending.stream.commits()


async def test_what_a_sink_that_takes_messages_does_not_come_to_keep_is_sent_again_after_ever_longer_times(
    tmp_path: Path,
) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.sinks = {"broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        for wait in (AGAIN_AFTER, 2 * AGAIN_AFTER, 4 * AGAIN_AFTER):
            sending.stream.sinks = {"broker": SinkPlace(0, sending.stream.sinks["broker"].sequence + 1)}
            assert await again(sending, 0.0) == []
            assert await again(sending, wait - 0.1) == []
            assert await again(sending, 0.1) == [2]
        sending.stream.sinks = {"broker": SinkPlace(2, 9)}
        assert await again(sending, 3600.0) == []


async def test_what_a_sink_that_is_away_has_not_taken_is_not_sent_again_and_again(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.sinks = {"away": SinkPlace(0, 0), "broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        sent = sending.outbox.status().messages
        for number in range(100):
            newest = sending.commit("meter")
            assert await again(sending, AGAIN_AFTER) == [newest], "what is new, and nothing else"
            sending.stream.sinks["broker"] = SinkPlace(newest, 1 + number)
        assert sending.outbox.status().messages == sent + 100
        sending.stream.sinks["away"] = SinkPlace(0, 5)  # it is back: the stream has what it needs, or not
        assert await again(sending, 0.0) == []
        assert (await again(sending, AGAIN_AFTER))[0] == 2


async def test_what_one_sink_lacks_is_sent_again_from_there_although_another_is_away(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        for _ in range(5):
            sending.commit("meter")
        sending.stream.sinks = {"away": SinkPlace(0, 0), "broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        sending.stream.sinks["broker"] = SinkPlace(4, 3)
        assert await again(sending, 0.0) == []
        sending.stream.sinks["broker"] = SinkPlace(4, 7)
        assert await again(sending, 0.0) == []
        assert await again(sending, AGAIN_AFTER) == [5, 6]


async def test_of_two_sinks_that_lack_samples_the_one_that_has_less_says_from_where_they_are_sent_again(
    tmp_path: Path,
) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        for _ in range(5):
            sending.commit("meter")
        sending.stream.sinks = {"archive": SinkPlace(0, 0), "broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        sending.stream.sinks = {"archive": SinkPlace(2, 3), "broker": SinkPlace(4, 3)}
        assert await again(sending, 0.0) == []
        sending.stream.sinks = {"archive": SinkPlace(2, 7), "broker": SinkPlace(4, 7)}
        assert await again(sending, 0.0) == []
        assert await again(sending, AGAIN_AFTER) == [3, 4, 5, 6]
        await sending.outbox.step()
        assert sending.stream.messages[-1].complete == 6, "it is told once more that this is all"


async def test_a_gap_has_the_revision_of_the_commit_after_it(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    sending.gaps = [OwnershipGap("hall", Epoch(1, 20), 5, ("meter",), 1, 2)]
    with sending.writer:
        for _ in range(4):
            sending.commit("meter")
        sending.outbox._revision_of = lambda commit: 100 + commit
        await sending.outbox.step()
        assert [each.revision for each in sending.stream.messages if each.gap] == [105]


async def test_what_a_sink_has_counts_only_if_messages_of_this_start_have_proved_it(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        for _ in range(5):
            sending.commit("meter")
        sending.stream.sinks = {"broker": SinkPlace(5, 9)}
        sending.stream.start = 7  # as after an older copy of the store was put back: these are other commits
        await sending.outbox.step()
        assert sending.stream.commits() == [2, 3, 4, 5, 6]
        sending.stream.start = 7
        assert await again(sending, 0.0) == []
        assert sending.outbox.status().kept == 0
        sending.stream.start, sending.stream.sinks["broker"] = 7, SinkPlace(5, 12)
        assert await again(sending, 0.0) == []
        sending.stream.start = 7
        assert await again(sending, AGAIN_AFTER) == [2, 3, 4, 5, 6], "it has none of this start"
        await sending.outbox.step()
        assert sending.outbox.status().kept == 5


async def test_where_nothing_is_sent_any_more_it_is_sent_again_after_the_longest_time(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.sinks = {"broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        await sending.outbox.step()
        assert await again(sending, AGAIN_LIMIT - 0.1) == []
        assert await again(sending, 0.1) == [2]


class UnansweringStream(MemoryStream):
    """Acknowledges the third message that it gets, and not those before."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers: list[int] = []

    async def publish(self, message: SampleMessage, shard: str) -> None:
        self.numbers.append(message.chain.number)
        if len(self.numbers) < 3:
            raise StreamDown("no answer, but the stream may have it")
        await super().publish(message, shard)


async def test_no_number_of_a_message_is_used_again_after_an_attempt_that_was_not_acknowledged(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    sending.stream = stream = UnansweringStream()
    sending.outbox = sending.opened()
    with sending.writer:
        sending.commit("meter")
        for _ in range(2):
            with pytest.raises(StreamDown):
                await sending.outbox.step()
        await sending.outbox.step()
    assert stream.numbers == [1, 2, 3]
    assert stream.messages[0].chain.after == 0


async def test_a_stream_that_is_full_loses_nothing(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.is_up = False
        for _ in range(3):
            try:
                await sending.outbox.step()
            except StreamDown:
                sending.commit("meter")
        sending.stream.is_up = True
        await sending.outbox.step()
        assert sending.stream.commits() == [2, 3, 4, 5]
        assert sending.outbox.status().sent == 5


class DroppingStream(MemoryStream):
    """Takes each name once, as a server does in its window of duplicates, and drops what it has when it is full."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.refused = ""
        self.first = self.next = 1

    async def publish(self, message: SampleMessage, shard: str) -> None:
        if message.link and message.link == self.refused:
            raise StreamDown("away")
        if message.name not in self.names:
            self.names.add(message.name)
            await super().publish(message, shard)
            self.next += 1

    def drop(self) -> None:
        self.messages.clear()
        self.first = self.next

    def believed(self) -> tuple[int, set[tuple[str, int]]]:
        """Up to which commit a sink that reads now believes to have all, and what it has."""
        progress = SinkProgress(None)
        for sequence, message in enumerate(self.messages, self.first):
            progress.take(sequence, message)
        taken = {(each.device, each.commit) for message in self.messages for each in message.samples}
        return progress.cursors.commits.get("one/s", 0), taken


def over_dropping_stream(tmp_path: Path) -> tuple[Sending, DroppingStream]:
    sending, stream = Sending(tmp_path), DroppingStream()
    sending.stream = stream
    sending.outbox = sending.opened()
    return sending, stream


@pytest.mark.parametrize("begins_again", ["after a restart", "after a refusal"])
async def test_what_a_full_stream_drops_is_never_believed_to_be_kept_where_the_sender_begins_again(
    tmp_path: Path, begins_again: str
) -> None:
    sending, stream = over_dropping_stream(tmp_path)
    with sending.writer:
        if begins_again == "after a restart":
            sending.commit("meter")
            await sending.outbox.step()
            sending.commit("meter", "pump")
            await sending.outbox.step()
            stream.drop()
            sending.outbox = sending.opened()
        else:
            sending.commit("meter", "pump")
            stream.refused = "roof"
            with pytest.raises(StreamDown):
                await sending.outbox.step()
            stream.refused = ""
            stream.drop()
            sending.commit("pump")
        await sending.outbox.step()
        sending.commit("meter")
        await sending.outbox.step()
    commit, taken = stream.believed()
    assert commit >= 3
    wanted = {("meter", 2), ("meter", 3), ("pump", 3)}
    assert taken >= (wanted if begins_again == "after a restart" else {("meter", 2), ("pump", 2), ("pump", 3)})


@pytest.mark.parametrize("link", ["meter", "pump"])
async def test_what_a_stream_loses_after_it_has_acknowledged_it_is_never_believed_to_be_kept(
    tmp_path: Path, link: str
) -> None:
    sending, stream = over_dropping_stream(tmp_path)
    with sending.writer:
        for _ in range(4):
            sending.commit("meter", "pump")
            await sending.outbox.step()
    of_link = [each for each in stream.messages if each.samples[0].device == link]
    stream.messages.remove(of_link[1])  # as when the server ends before it has written; the number is used again
    assert stream.believed()[0] < of_link[1].samples[0].commit


def commit_texts(sending: Sending, *texts: str | float) -> int:
    """One commit with a sample of `name` for each value."""
    batches = []
    for text in texts:
        sending.rows += 1
        batches.append(SampleBatch(PointGroup("meter", ("name",)), NOW + sending.rows * 10**9, 5, (text,)))
    return sending.writer.commit(batches, [], NOW + sending.rows * 10**9).number


async def test_long_texts_are_sent_in_messages_that_are_not_too_long(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        texts = [chr(0x20AC) * length for length in (1000, 20_000, 21_000, 21_700, 5, 21_000, 21_000)]
        commit_texts(sending, *texts)
        assert not await sending.outbox.step()
        found = [sample.value for message in sending.stream.messages for sample in message.samples]
        assert found == texts
        assert len(sending.stream.messages) == 5
        assert all(len(each.encode()) <= MOST_BYTES for each in sending.stream.messages)
        assert sending.outbox.status().set_aside == 0


async def test_messages_are_as_long_as_a_server_with_a_low_limit_takes(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    sending.stream.longest = 1000
    with sending.writer:
        commit_texts(sending, *("x" * 20 for _ in range(30)))
        assert not await sending.outbox.step()
        assert len(sending.stream.commits()) == 30
        assert max(len(each.encode()) for each in sending.stream.messages) > 300


async def test_what_a_commit_has_of_a_device_is_cut_at_the_same_places_wherever_it_is_sent_again_from(
    tmp_path: Path,
) -> None:
    """So documents of sinks have the same keys: each is made of what a commit has of a device."""
    sending = Sending(tmp_path)
    sending.stream.longest = 1000
    parts: list[list[list[object]]] = []
    with sending.writer:
        numbers = [commit_texts(sending, *("x" * 20 for _ in range(count))) for count in (1, 3, 2, 4, 30, 2, 1, 5, 3)]
        for kept in (0, *numbers[:-1]):
            sending.stream.sinks = {"broker": SinkPlace(kept, 0)}
            sending.outbox = sending.opened()
            for _ in range(2):  # the second one moves the cursor, by what messages of this start have proved
                await sending.outbox.step()
            sending.stream.messages.clear()
            sending.outbox = sending.opened()
            await sending.outbox.step()
            found: dict[int, list[list[object]]] = {}
            for message in sending.stream.messages:
                for commit in dict.fromkeys(each.commit for each in message.samples):
                    rows: list[object] = [each.time for each in message.samples if each.commit == commit]
                    found.setdefault(commit, []).append(rows)
            parts = parts or [found[number] for number in numbers]
            assert found == {number: rows for number, rows in zip(numbers, parts, strict=True) if number > kept}
    assert [len(each) > 1 for each in parts] == [count == 30 for count in (1, 3, 2, 4, 30, 2, 1, 5, 3)]


async def test_a_sample_that_is_too_long_for_a_message_is_told_and_set_aside_and_others_are_sent(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        commit_texts(sending, "one", "x" * MOST_BYTES, "two", "y" * MOST_BYTES)
        last = commit_texts(sending, "z" * MOST_BYTES)
        assert not await sending.outbox.step()
        await sending.outbox.step()
        found = [sample.value for message in sending.stream.messages for sample in message.samples]
        assert found == ["one", "two"]
        assert sending.stream.messages[-1].complete == last
        assert sending.outbox.status().set_aside == 3
        told = [each.message for each in caplog.records if "no sink gets it" in each.message]
        assert len(told) == 1
        assert "meter/name" in told[0]
        sending.outbox = sending.opened()
        assert not await sending.outbox.step()
        assert sending.outbox.status().set_aside == 3, "it is not sent after a start either"


async def test_a_sample_that_is_too_long_is_counted_once_although_its_commit_is_sent_again(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        last = commit_texts(sending, "one", "x" * MOST_BYTES, "two")
        sending.stream.sinks = {"broker": SinkPlace(0, 0)}
        await sending.outbox.step()
        for wait in (AGAIN_AFTER, 2 * AGAIN_AFTER):
            sending.stream.sinks = {"broker": SinkPlace(0, sending.stream.sinks["broker"].sequence + 1)}
            assert await again(sending, 0.0) == []
            assert last in await again(sending, wait)
        assert sending.outbox.status().set_aside == 1
        commit_texts(sending, "x" * MOST_BYTES)
        await sending.outbox.step()
        assert sending.outbox.status().set_aside == 2


async def test_a_commit_with_nothing_but_a_sample_that_is_too_long_holds_nothing_up(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        commit_texts(sending, "x" * MOST_BYTES)
        last = sending.commit("meter")
        await sending.outbox.step()
        await sending.outbox.step()
        assert sending.stream.commits() == [last]
        sending.stream.sinks = {"broker": SinkPlace(last, 9)}
        await sending.outbox.step()
        assert sending.outbox.status().kept == last


async def test_a_gap_is_sent_between_the_samples_of_the_epochs_that_it_parts_and_again_with_them(
    tmp_path: Path,
) -> None:
    sending = Sending(tmp_path)
    sending.stream.longest = 800
    devices = tuple(f"meter {number} of the hall" for number in range(60))
    sending.gaps = [
        OwnershipGap("hall", Epoch(1, 20), 5, devices, 1, 2),
        OwnershipGap("shed", Epoch(1, 9), 3, ("fan",), 1, 2),
        OwnershipGap("shed", Epoch(1, 30), 9, ("fan",), 3, 4),
    ]
    with sending.writer:
        for _ in range(5):
            sending.commit("meter", "pump")
        for _ in range(2):
            await sending.outbox.step()
            found = [
                (each.link, each.epoch, [sample.commit for sample in each.samples])
                for each in sending.stream.messages
                if each.gap is None or each.gap.devices[0] in ("fan", devices[0])
            ]
            assert found == [
                ("hall", Epoch(1, 10), [2, 3, 4]),
                ("hall", Epoch(1, 20), []),
                ("hall", Epoch(1, 20), [5, 6]),
                ("roof", Epoch(1, 10), [2, 3, 4]),
                ("roof", Epoch(1, 20), [5, 6]),
                ("shed", Epoch(1, 9), []),
            ]
            parts = [each.gap for each in sending.stream.messages if each.gap is not None]
            assert sum((each.devices for each in parts if each.link == "hall"), ()) == devices
            assert len(parts) > 3
            assert {(each.commit, each.begin, each.end) for each in parts} == {(5, 1, 2), (3, 1, 2)}
            sending.stream.messages.clear()
            sending.outbox = sending.opened()


async def test_a_stream_that_is_connected_again_is_tried_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox_module, "PAUSE", 1000.0)
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.is_up = False
        task = asyncio.create_task(sending.outbox.run())
        await until(lambda: sending.outbox.status().error is not None)
        assert sending.stream.messages == []
        sending.stream.is_up = True
        sending.stream.is_back.set()
        await until(lambda: sending.stream.commits() == [2])
        await end_tasks([task])


async def test_a_stream_that_refuses_over_the_same_connection_is_tried_after_pauses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox_module, "PAUSE", 0.01)
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.is_up = False
        task = asyncio.create_task(sending.outbox.run())
        await until(lambda: sending.outbox.status().error is not None)
        sending.stream.is_up = True
        await until(lambda: sending.stream.commits() == [2])
        await end_tasks([task])


@pytest.mark.parametrize(
    ("part", "name", "problem"),
    [
        (CommitReader, "read", sqlite3.OperationalError("database is locked")),
        (CommitReader, "read", sqlite3.DatabaseError("file is not a database")),
        (CommitReader, "read", FileNotFoundError("no such segment")),
        (Manifest, "cursors", sqlite3.OperationalError("disk I/O error")),
        (Manifest, "set_cursor", sqlite3.OperationalError("database or disk is full")),
    ],
)
async def test_while_the_store_cannot_be_used_nothing_is_sent_or_lost_and_then_sending_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: type, name: str, problem: Exception
) -> None:
    def failing(*arguments: object) -> None:
        raise problem

    monkeypatch.setattr(outbox_module, "PAUSE", 0.01)
    monkeypatch.setattr(outbox_module, "IDLE", 0.01)
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        assert not await sending.outbox.step()
        sending.stream.sinks["a"] = SinkPlace(2, 1)
        sending.commit("meter")
        with monkeypatch.context() as broken:
            broken.setattr(part, name, failing)
            task = asyncio.create_task(sending.outbox.run())
            await until(lambda: sending.outbox.status().error is not None)
            assert sending.outbox.status().error == f"the store cannot be used now: {problem}"
            assert (sending.outbox.status().sent, sending.stream.commits()) == (2, [2])
        await until(lambda: sending.outbox.status().error is None)
        await until(lambda: sending.stream.commits() == [2, 3])
        assert sending.writer.manifest.cursors()[OUTBOX] == (2, 0)
        await end_tasks([task])


def test_messages_of_any_limit_have_each_sample_once_in_order_and_each_commit_whole_if_it_fits(tmp_path: Path) -> None:
    """Whatever is first, last or alone too long; with each limit, so that some are met exactly, or with a byte left."""
    sending = Sending(tmp_path)
    lengths = [(5,), (900,), (30, 40, 50), (700, 1, 900), (1, 700), (900, 900), (10,) * 12, (2,), (1, 900)]
    samples = [
        CommittedSample(commit, "meter", f"p{place}", 1000 * commit + place, 0, "x" * length, 0)
        for commit, texts in enumerate(lengths, 1)
        for place, length in enumerate(texts)
    ]
    gaps = [OwnershipGap("hall", Epoch(1, 20), 5, ("meter", "pump", "m" * 200, "fan"), 1, 2)]
    counts: set[tuple[int, int]] = set()
    with sending.writer:
        for limit in (6000, *range(1700, 500, -1)):  # what was set aside once stays so
            sending.stream.longest = limit
            messages = sending.outbox._messages_of(samples, gaps)
            lengths_sent = [len(each.encode()) for each in messages]
            assert max(lengths_sent) <= limit
            sent = [each for message in messages for each in message.samples]
            aside = [each for each in samples if each not in sent]
            assert sent == [each for each in samples if each not in aside]
            assert len(aside) == sending.outbox.status().set_aside
            assert all(len(str(each.value)) > limit - 400 for each in aside)
            assert [device for each in messages if each.gap for device in each.gap.devices] == list(gaps[0].devices)
            first = next(place for place, each in enumerate(messages) if each.gap)
            assert all(each.commit < 5 for message in messages[:first] for each in message.samples)
            assert all(each.commit >= 5 for message in messages[first:] for each in message.samples)
            for before, after in itertools.pairwise(each for each in messages if each.samples):
                if before.samples[-1].commit == after.samples[0].commit:
                    assert len({each.commit for each in (*before.samples, *after.samples)}) == 1
            counts.add((len(messages), len(aside)))
    assert (3, 0) in counts, "those before the gap, the gap, and those after it"
    assert len(counts) > 8


def test_messages_with_long_names_are_not_too_long_wherever_they_are_cut(tmp_path: Path) -> None:
    """Names take most of a message, and a commit begins a message with names that the one before had already."""
    sending, chance = Sending(tmp_path), Random(1)
    names = [letter * 300 for letter in "abc"]
    with sending.writer:
        for limit in range(1300, 3300, 40):
            sending.stream.longest = limit
            samples = [
                CommittedSample(
                    commit, chance.choice(names), chance.choice(names), place, 0, "x", 0, chance.choice(names)
                )
                for commit in range(1, 30)
                for place in range(chance.randrange(1, 6))
            ]
            messages = sending.outbox._messages_of(samples, [])
            assert [each for message in messages for each in message.samples] == samples
            for message in messages:
                known = set[str]()
                bound = longest_head("one", "s", "") + sum(longest_row(each, known) for each in message.samples)
                assert len(message.encode()) <= bound <= limit


def test_a_message_that_has_exactly_the_most_bytes_is_not_cut(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    samples = [CommittedSample(commit, "meter", "p", commit, 0, "x" * 50, 0) for commit in (1, 1, 2, 2)]
    known = set[str]()
    head = longest_head("one", "s", "hall")
    whole = head + sum(longest_row(each, known) for each in samples)
    alone = head + longest_row(samples[0], set())
    with sending.writer:
        for limit, lengths in ((whole, [4]), (whole - 1, [2, 2]), (alone, [1, 1, 1, 1]), (alone - 1, [])):
            sending.stream.longest = limit
            sending.outbox = sending.opened()
            messages = sending.outbox._messages_of(samples, [])
            assert [len(each.samples) for each in messages] == lengths
            assert (sending.outbox.status().set_aside > 0) == (not lengths)


async def test_samples_that_retention_deletes_before_all_sinks_have_them_are_told_as_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sending = Sending(tmp_path)
    with sending.writer as writer:
        first = sending.commit("meter", "pump")
        writer.roll()
        second = sending.commit("meter", "pump")
        writer.roll()
        sending.commit("meter")
        await sending.outbox.step()
        sending.stream.sinks = {"history": SinkPlace(second, 9), "broker": SinkPlace(first, 9)}
        writer.keep(Retention(age=1.0))
        assert len(writer.apply_retention(NOW + 1000 * 10**9)) == 2
        for _ in range(2):
            await sending.outbox.step()
        assert sending.outbox.status().lost == 4, "both sinks had told nothing when the files went"
        assert [each.message for each in caplog.records] == [
            "4 samples were deleted before all sinks of the stream had them"
        ]
        assert sending.opened().status().lost == 4
