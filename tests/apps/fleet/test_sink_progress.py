"""A sink says that it keeps a commit only if it has every sample up to it, whatever a stream loses."""

import asyncio
import random
from collections.abc import AsyncGenerator
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import until

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.messages import SampleMessage
from busway.apps.fleet.outbox import SinkPlace
from busway.apps.fleet.streams import MISSING_SECONDS, CursorBook, SinkCursors, SinkProgress, StreamSink


def message(collector: str, commits: list[int], complete: int, kept: int) -> SampleMessage:
    samples = [CommittedSample(commit, "d", "p", commit, 0, commit, 0) for commit in commits]
    return SampleMessage(collector, "s", "hall", None, 0, complete, kept, 0, 0, samples)


class Sender:
    """An outbox in a few lines: sends commits in order, and again from what is kept."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.made = self.sent = self.kept = 0


@pytest.mark.parametrize("seed", range(60))
def test_what_a_sink_says_that_it_keeps_it_has(seed: int) -> None:
    chance = random.Random(seed)
    senders = [Sender("one"), Sender("two")]
    stream: list[tuple[int, SampleMessage]] = []
    sequence = 0
    progress = SinkProgress(None)
    has: dict[str, set[int]] = {"one": set(), "two": set()}
    for _ in range(400):
        sender = chance.choice(senders)
        match chance.choice(["make", "make", "send", "send", "take", "take", "drop", "again", "restart", "repeat"]):
            case "make":
                sender.made += chance.randrange(4)
            case "send":
                commits = list(range(sender.sent + 1, min(sender.made, sender.sent + 3) + 1))
                sequence += 1
                stream.append((sequence, message(sender.name, commits, sender.sent, sender.kept)))
                sender.sent += len(commits)
            case "take" if stream:
                number, found = stream.pop(0)
                has[found.collector] |= {each.commit for each in found.samples}
                progress.take(number, found if chance.random() < 0.97 else None)
            case "drop":
                del stream[: chance.randrange(3)]
            case "again":
                sender.sent = sender.kept
            case "restart":
                progress = SinkProgress(progress.cursors)
            case "repeat" if stream:
                number, found = stream[0]
                has[found.collector] |= {each.commit for each in found.samples}
                progress.take(number, found)
        for each in senders:
            cursor = progress.cursors.commits.get(f"{each.name}/s", 0)
            assert has[each.name] >= set(range(1, cursor + 1)), "it says that it keeps what it never had"
            each.kept = max(each.kept, cursor)
    for each in senders:
        for begins in (each.kept, each.made):
            sequence += 1
            commits = list(range(begins + 1, each.made + 1))
            found = message(each.name, commits, begins, each.kept)
            progress.take(sequence + len(stream), found)
        assert progress.cursors.commits[f"{each.name}/s"] == each.made, "what is sent again is believed"


def test_cursors_that_are_shown_with_lower_revisions_are_taken_when_the_table_is_read_anew() -> None:
    book = CursorBook()
    book.take(Entry("cursor.history", SinkCursors(7, {"one/s": 5}).encode(), 65))
    book.take(Entry("cursor.history", SinkCursors(6, {"one/s": 4}).encode(), 50))
    assert book.of("history") == (SinkCursors(7, {"one/s": 5}), 65)
    book.begin_snapshot()
    book.take(Entry("cursor.history", SinkCursors(7, {"one/s": 5}).encode(), 50))
    assert book.of("history") == (SinkCursors(7, {"one/s": 5}), 50)


async def test_a_message_that_the_stream_does_not_give_is_left_out_after_some_time_and_proves_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Stream:
        async def stream_info(self, name: str) -> Any:
            return SimpleNamespace(state=SimpleNamespace(first_seq=1))

    def given(sequence: int) -> Any:
        return SimpleNamespace(metadata=SimpleNamespace(sequence=SimpleNamespace(stream=sequence)))

    now = 100.0
    monkeypatch.setattr("busway.apps.fleet.streams.time.monotonic", lambda: now)
    sink = StreamSink(None, None, "hall", "history", None)  # type: ignore[arg-type]
    sink._progress.take(1, message("one", [1], 0, 0))
    later = [given(3), given(4)]
    assert await sink._following(Stream(), "s", later) == []
    now += MISSING_SECONDS - 1.0
    assert await sink._following(Stream(), "s", later) == []
    now += 2.0
    assert await sink._following(Stream(), "s", later) == later
    assert await sink._following(Stream(), "s", [given(2), *later]) == [given(2), *later]
    sink._progress.take(3, message("one", [3], 2, 0))
    assert sink._progress.cursors.commits == {"one/s": 0}


async def test_cursors_are_followed_anew_after_a_defect_of_the_coordinator(caplog: pytest.LogCaptureFixture) -> None:
    class Broken:
        begun = 0

        async def watch(self, prefix: str) -> AsyncGenerator[Entry, None]:
            self.begun += 1
            yield Entry("cursor.history", SinkCursors(self.begun, {"one/s": self.begun}).encode(), 1)
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
