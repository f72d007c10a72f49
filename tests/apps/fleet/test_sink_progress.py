"""A sink says that it keeps a commit only if it has every sample up to it, whatever a stream loses."""

import asyncio
import random
from collections.abc import AsyncGenerator, Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import until

from busway.apps.collector.sinks.documents import documents
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.coordinator import SNAPSHOT_ENDS, Entry
from busway.apps.fleet.messages import Chain, SampleMessage
from busway.apps.fleet.outbox import SinkPlace
from busway.apps.fleet.streams import MISSING_SECONDS, CursorBook, SinkCursors, SinkProgress, StreamSink


def message(sender: "Sender", link: str, commits: list[int], complete: int, *, is_first: bool) -> SampleMessage:
    samples = [CommittedSample(commit, link, "p", commit, 0, commit, 0) for commit in commits]
    sender.number += 1
    chain = Chain(1, sender.number, sender.acknowledged, is_first)
    return SampleMessage(sender.name, "s", link, None, 0, complete, sender.kept, samples, chain)


LINKS = ("hall", "roof")


class Sender:
    """An outbox in a few lines: sends commits in order, and again from what is kept."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.made = self.sent = self.kept = self.number = self.acknowledged = 0

    def send(self, most: int, publish: Callable[[SampleMessage], bool]) -> None:
        """Send a batch, a message for each link, until one is not acknowledged; it may be in the stream even so."""
        commits = list(range(self.sent + 1, min(self.made, self.sent + most) + 1))
        for link in LINKS:
            found = message(self, link, commits, self.sent, is_first=link == LINKS[0])
            if not publish(found):
                return
            self.acknowledged = found.chain.number
        self.sent += len(commits)


@pytest.mark.parametrize("seed", range(60))
def test_what_a_sink_says_that_it_keeps_it_has(seed: int) -> None:
    chance = random.Random(seed)
    senders = [Sender("one"), Sender("two")]
    stream: list[tuple[int, SampleMessage]] = []
    sequence = 0
    progress = SinkProgress(None)
    has: dict[str, set[tuple[str, int]]] = {"one": set(), "two": set()}

    def publish(found: SampleMessage) -> bool:
        nonlocal sequence
        is_answered = chance.random() < 0.9
        if is_answered or chance.random() < 0.5:
            sequence += 1
            stream.append((sequence, found))
        return is_answered

    def at_once(found: SampleMessage) -> bool:
        progress.take(sequence + 1, found)
        return True

    actions = ["make", "make", "send", "send", "take", "take", "drop", "lose", "again", "restart", "repeat"]
    for _ in range(600):
        sender = chance.choice(senders)
        match chance.choice(actions):
            case "make":
                sender.made += chance.randrange(4)
            case "send":
                sender.send(3, publish)
            case "take" if stream:
                number, found = stream.pop(0)
                if chance.random() < 0.97:
                    has[found.collector] |= {(found.link, each.commit) for each in found.samples}
                    progress.take(number, found)
                else:
                    progress.take(number, None)
            case "drop":
                del stream[: chance.randrange(3)]
            case "lose":  # a server that ends loses what it had acknowledged, and uses the numbers again
                sequence -= min(sequence, chance.randrange(3))
                stream = [each for each in stream if each[0] <= sequence]
            case "again":
                sender.sent = sender.kept
            case "restart":
                progress = SinkProgress(progress.cursors)
            case "repeat" if stream:
                number, found = stream[0]
                has[found.collector] |= {(found.link, each.commit) for each in found.samples}
                progress.take(number, found)
        for each in senders:
            cursor = progress.cursors.commits.get(f"{each.name}/s", 0)
            wanted = {(link, commit) for link in LINKS for commit in range(1, cursor + 1)}
            assert has[each.name] >= wanted, "it says that it keeps what it never had"
            each.kept = max(each.kept, cursor)
    for each in senders:
        each.sent = each.kept
        for _ in range(2):  # the second says that the first is complete
            each.send(each.made, at_once)
        assert progress.cursors.commits[f"{each.name}/s"] == each.made, "what is sent again is believed"


def test_cursors_that_are_shown_with_lower_revisions_are_taken_when_the_table_is_read_anew() -> None:
    book = CursorBook()
    book.take(Entry("cursor.history", SinkCursors(7, {"one/s": 5}).encode(), 65))
    book.take(Entry("cursor.history", SinkCursors(6, {"one/s": 4}).encode(), 50))
    assert book.of("history") == (SinkCursors(7, {"one/s": 5}), 65)
    book.begin_snapshot()
    book.take(Entry("cursor.history", SinkCursors(7, {"one/s": 5}).encode(), 50))
    assert book.of("history") == (SinkCursors(7, {"one/s": 5}), 50)


def test_no_sink_counts_before_the_table_has_been_read_to_its_end_once() -> None:
    book = CursorBook()
    book.take(Entry("cursor.archive", SinkCursors(7, {"one/s": 5}, {"one/s": (3, 9)}).encode(), 1))
    assert book.places("one", "s") == {}, "a sink with less may be shown next"
    book.take(Entry("cursor.broker", SinkCursors(0, {}).encode(), 2))
    book.end_snapshot()
    assert book.places("one", "s") == {"archive": SinkPlace(5, 7, 3), "broker": SinkPlace(0, 0)}
    book.begin_snapshot()
    assert len(book.places("one", "s")) == 2, "what was known holds while the table is read again"


@pytest.mark.parametrize("value", [b"{", b"[" * 100_000, b"[1e999,{},{}]", b'[7,{"one/s":1e999},{}]'])
def test_a_sink_whose_entry_cannot_be_decoded_counts_as_one_that_has_nothing(value: bytes) -> None:
    book = CursorBook()
    book.end_snapshot()
    book.take(Entry("cursor.broker", SinkCursors(7, {"one/s": 5}, {"one/s": (3, 9)}).encode(), 1))
    book.take(Entry("cursor.broker", value, 2))
    assert book.places("one", "s") == {"broker": SinkPlace(0, 0)}


def test_what_was_known_of_a_sink_holds_where_the_table_has_lost_its_entry_which_is_made_anew() -> None:
    book = CursorBook()
    book.take(Entry("cursor.broker", SinkCursors(7, {"one/s": 5}, {"one/s": (3, 9)}).encode(), 65))
    book.end_snapshot()
    book.begin_snapshot()
    assert book.of("broker")[1] == 65
    book.end_snapshot()
    assert book.of("broker") == (SinkCursors(7, {"one/s": 5}, {"one/s": (3, 9)}), 0)
    assert book.places("one", "s") == {"broker": SinkPlace(5, 7, 3)}
    book.take(Entry("cursor.broker", SinkCursors(2, {"one/s": 6}, {"one/s": (3, 9)}).encode(), 1))
    assert book.of("broker")[1] == 1


class Stream:
    """What JetStream says of a stream: ``first`` is the number of its oldest message."""

    def __init__(self, first: int) -> None:
        self.first = first

    async def stream_info(self, name: str) -> Any:
        return SimpleNamespace(state=SimpleNamespace(first_seq=self.first))


def given(sequence: int) -> Any:
    """A message of a stream, by its number."""
    return SimpleNamespace(metadata=SimpleNamespace(sequence=SimpleNamespace(stream=sequence)))


async def test_a_message_that_the_stream_does_not_give_is_left_out_after_some_time_and_proves_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr("busway.apps.fleet.streams.time.monotonic", lambda: now)
    sink = StreamSink(None, None, "hall", "history", None)  # type: ignore[arg-type]
    sender = Sender("one")
    sender.made = 9
    sent: list[SampleMessage] = []

    def keep(found: SampleMessage) -> bool:
        sent.append(found)
        return True

    for _ in range(3):
        sender.send(1, keep)
    sink._progress.take(1, sent[0])
    later = [given(3), given(4)]
    for first in (1, 2):  # the stream has it, if only as its oldest
        assert await sink._following(Stream(first), "s", later) == []
        assert sink.dropped == 0
    now += MISSING_SECONDS - 1.0
    assert await sink._following(Stream(2), "s", later) == []
    now += 2.0
    assert await sink._following(Stream(2), "s", later) == later
    assert await sink._following(Stream(2), "s", [given(2), *later]) == [given(2), *later]
    sink._progress.take(3, sent[2])
    assert sink._progress.cursors.commits == {"one/s": 0}


async def test_messages_that_a_stream_has_dropped_are_left_out_and_those_behind_them_are_waited_for() -> None:
    """The oldest that the stream has is 5: it comes, although a later one came before it."""
    sink = StreamSink(None, None, "hall", "history", None)  # type: ignore[arg-type]
    sink._progress.take(2, None)
    for _ in range(2):
        assert await sink._following(Stream(5), "s", [given(6), given(9)]) == []
        assert sink.dropped == 2, "counted once"
    later = [given(5), given(6), given(9)]
    assert await sink._following(Stream(5), "s", later) == later[:2]
    assert sink.dropped == 2


async def test_after_a_message_that_is_left_out_the_next_one_that_is_missing_is_waited_for_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr("busway.apps.fleet.streams.time.monotonic", lambda: now)
    sink = StreamSink(None, None, "hall", "history", None)  # type: ignore[arg-type]
    sink._progress.take(2, None)
    assert await sink._following(Stream(1), "s", [given(6), given(9)]) == []
    assert await sink._following(Stream(1), "s", [given(5), given(6), given(9)]) == []
    now += MISSING_SECONDS + 1.0
    assert await sink._following(Stream(1), "s", [given(6), given(9)]) == [], "5 came once, and comes again"
    assert await sink._following(Stream(1), "s", [given(5), given(6), given(9)]) == [given(5), given(6)]
    sink._progress.take(6, None)
    assert await sink._following(Stream(1), "s", [given(9)]) == [given(9)], "7 was missing as long as 3"
    sink._progress.take(9, None)
    assert await sink._following(Stream(1), "s", [given(11), given(12)]) == []
    assert await sink._following(Stream(1), "s", [given(12)]) == []
    now += MISSING_SECONDS + 1.0
    assert await sink._following(Stream(1), "s", [given(12)]) == [], "11 has come, and is not given any more"
    now += MISSING_SECONDS + 1.0
    assert await sink._following(Stream(1), "s", [given(12)]) == [given(12)]


async def test_cursors_are_followed_anew_after_a_defect_of_the_coordinator(caplog: pytest.LogCaptureFixture) -> None:
    class Broken:
        begun = 0

        async def watch(self, prefix: str) -> AsyncGenerator[Entry, None]:
            self.begun += 1
            yield Entry("cursor.history", SinkCursors(self.begun, {"one/s": self.begun}).encode(), 1)
            yield SNAPSHOT_ENDS
            if self.begun == 1:
                raise RuntimeError("a state that it cannot have")
            await asyncio.sleep(3600)

    book = CursorBook()
    task = asyncio.create_task(book.watch(Broken()))  # type: ignore[arg-type]
    await until(lambda: book.places("one", "s").get("history") == SinkPlace(2, 2))
    assert "the table of cursors cannot be followed; it is read anew" in caplog.text
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()


class Documents:
    """Keeps the keys of the documents that a sink makes of samples, in order."""

    def __init__(self) -> None:
        self.keys: list[str] = []
        self.batches = 0

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        self.batches += 1
        self.keys += [each.key for each in documents(samples)]

    async def close(self) -> None:
        pass


def samples_of(number: int, sender: str, commits: Sequence[int], times: Sequence[int]) -> SampleMessage:
    samples = [CommittedSample(commit, "meter", "p", time, 0, time, 0) for commit in commits for time in times]
    return SampleMessage(sender, "s", "hall", None, 0, 0, 0, samples, Chain(1, number, number - 1))


@pytest.mark.parametrize(
    ("messages", "batches"),
    [
        ([samples_of(1, "one", [4, 5], [1, 2]), samples_of(2, "one", [6, 7], [3, 4])], 1),
        ([samples_of(1, "one", [5], [1, 2]), samples_of(2, "one", [5], [3, 4])], 2),  # a commit too long for one
        ([samples_of(1, "one", [4, 5], [1]), samples_of(2, "two", [5, 6], [2])], 2),  # the numbers of two collectors
        ([samples_of(1, "one", [5], [1]), samples_of(2, "two", [5], [1])], 2),
        ([samples_of(number, "one", [5], [1, 2]) for number in (1, 2)], 2),  # sent again
        ([samples_of(1, "one", [8, 9], [1]), samples_of(2, "one", [5, 6], [1])], 2),  # sent again from an earlier one
        ([samples_of(1, "one", [900], [1]), samples_of(2, "two", [5], [2])], 2),  # its new owner has a younger store
        ([samples_of(1, "one", [5], [1]), samples_of(2, "two", [900], [2])], 1),
    ],
)
async def test_documents_have_the_same_keys_whether_messages_come_together_or_one_by_one(
    messages: list[SampleMessage], batches: int
) -> None:
    one_by_one, together = Documents(), Documents()
    sink = StreamSink(None, None, "hall", "history", one_by_one)  # type: ignore[arg-type]
    for each in messages:
        await sink._send_all([each])
    await StreamSink(None, None, "hall", "history", together)._send_all(messages)  # type: ignore[arg-type]
    assert together.keys == one_by_one.keys
    assert together.batches == batches
