"""The outbox against a stream in memory: at least once, in order, and again after whatever the stream loses."""

from pathlib import Path

import pytest

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet.lease_times import Epoch
from busway.apps.fleet.messages import SampleMessage
from busway.apps.fleet.outbox import AGAIN_AFTER, OUTBOX, Outbox, StreamDown
from busway.apps.fleet.streams import SinkProgress

NOW = 1_800_000_000 * 10**9


class MemoryStream:
    """Keeps messages until a test takes them; may refuse."""

    def __init__(self) -> None:
        self.messages: list[SampleMessage] = []
        self.cursor: int | None = None
        self.is_up = True

    async def publish(self, message: SampleMessage) -> None:
        if not self.is_up:
            raise StreamDown("it is full")
        self.messages.append(message)

    def kept(self, collector: str, store: str) -> int | None:
        assert (collector, store) == ("one", "s")
        return self.cursor

    def commits(self) -> list[int]:
        return [each.commit for message in self.messages for each in message.samples]


class Sending:
    """A store and its outbox, with a clock that a test sets."""

    def __init__(self, folder: Path) -> None:
        self.writer = StoreWriter(folder, now=NOW)
        self.stream = MemoryStream()
        self.time = 0.0
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
            epoch_of=lambda link, commit: Epoch(1, 10 if commit <= 4 else 20),
            now=lambda: self.time,
        )

    def commit(self, *devices: str) -> int:
        self.rows += 1
        batches = [
            SampleBatch(PointGroup(device, ("power",)), NOW + self.rows * 10**9, 5, (float(self.rows),))
            for device in devices
        ]
        return self.writer.commit(batches, [], NOW + self.rows * 10**9).number


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


async def test_the_cursor_moves_only_by_what_sinks_keep_and_a_restart_begins_there(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        for _ in range(4):
            sending.commit("meter")
        await sending.outbox.step()
        assert sending.writer.manifest.cursors()[OUTBOX] == (0, 0)
        sending.stream.cursor = 3
        await sending.outbox.step()
        assert sending.writer.manifest.cursors()[OUTBOX] == (3, 0)
        sending.outbox = sending.opened()
        sending.stream.messages.clear()
        await sending.outbox.step()
        assert sending.stream.commits() == [4, 5]


async def test_what_no_sink_comes_to_keep_is_sent_again(tmp_path: Path) -> None:
    sending = Sending(tmp_path)
    with sending.writer:
        sending.commit("meter")
        sending.stream.cursor = 0
        await sending.outbox.step()
        sending.stream.messages.clear()
        sending.time = AGAIN_AFTER - 0.1
        await sending.outbox.step()
        assert sending.stream.commits() == []
        sending.time = AGAIN_AFTER
        await sending.outbox.step()
        assert sending.stream.commits() == [2]


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

    async def publish(self, message: SampleMessage) -> None:
        if message.link and message.link == self.refused:
            raise StreamDown("away")
        if message.name not in self.names:
            self.names.add(message.name)
            await super().publish(message)
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


@pytest.mark.parametrize("begins_again", ["after a restart", "after a refusal"])
async def test_what_a_full_stream_drops_is_never_believed_to_be_kept_where_the_sender_begins_again(
    tmp_path: Path, begins_again: str
) -> None:
    sending = Sending(tmp_path)
    sending.stream = stream = DroppingStream()
    sending.outbox = sending.opened()
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
