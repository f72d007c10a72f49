"""Two collectors that share a table of keys: one of them takes a key, whatever the table answers, and how late."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable

import pytest
from waiting import until

from busway.apps.collector.commands.claims import KeysUnavailable
from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.apps.fleet.coordinator import (
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    CoordinatorDown,
    Entry,
    OutcomeUnknown,
    RevisionConflict,
)
from busway.apps.fleet.key_memory import decode_memory
from busway.apps.fleet.key_table import KeyTable, slot_of


class Shared:
    """The entries of a table in memory, and who watches them."""

    def __init__(self) -> None:
        self.entries: dict[str, Entry] = {}
        self.watches: list[asyncio.Queue[Entry]] = []
        self.revision = 0

    def become(self, entries: list[Entry]) -> None:
        """Be another table, with these entries: each watch reads it anew."""
        self.entries = {entry.key: entry for entry in entries}
        self.revision = max((entry.revision for entry in entries), default=0)
        for watch in self.watches:
            for entry in (SNAPSHOT_BEGINS, *entries, SNAPSHOT_ENDS):
                watch.put_nowait(entry)


class MemoryTable:
    """One collector's way to a shared table, which tests disturb.

    Attributes:
        before: called before each change.
        fails: raised by each change, before it is made or after.
        shows: set while watches show what changes.
    """

    def __init__(self, shared: Shared) -> None:
        self.shared = shared
        self.before: Callable[[], Awaitable[None]] | None = None
        self.fails: Exception | None = None
        self.is_made = True
        self.shows = asyncio.Event()
        self.shows.set()

    async def create(self, key: str, value: bytes) -> int:
        return await self.replace(key, value, 0)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        if self.before is not None:
            await self.before()
        if self.fails is not None and not self.is_made:
            raise self.fails
        present = self.shared.entries.get(key)
        if (present.revision if present else 0) != revision:
            raise RevisionConflict(key)
        self.shared.revision += 1
        entry = self.shared.entries[key] = Entry(key, value, self.shared.revision)
        for watch in self.shared.watches:
            watch.put_nowait(entry)
        if self.fails is not None:
            raise self.fails
        return entry.revision

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        queue: asyncio.Queue[Entry] = asyncio.Queue()
        self.shared.watches.append(queue)
        for entry in list(self.shared.entries.values()):
            yield entry
        yield SNAPSHOT_ENDS
        while True:
            entry = await queue.get()
            await self.shows.wait()
            if not entry.revision or entry.key.startswith(prefix):
                yield entry

    async def close(self) -> None:
        pass


def opened(key: str, value: int = 7) -> CommandResult:
    command = PointCommand(key, "boiler", "setpoint", value, "anna", "api", 1030.0)
    return CommandResult(command, CommandState.OPEN, 1000.0)


DONE = opened("k1").finished(CommandState.DONE)
SAME_ENTRY = [key for key in (f"k{number}" for number in range(2000)) if slot_of(key) == slot_of("k1")]


async def test_a_key_is_taken_by_one_and_its_end_is_what_the_other_gets() -> None:
    shared = Shared()
    async with KeyTable(MemoryTable(shared), "west") as west, KeyTable(MemoryTable(shared), "east") as east:
        assert await west.claim(opened("k1")) is None
        first = await east.claim(opened("k1"))
        assert first is not None
        assert (first.state, "west has begun it" in first.reason) == (CommandState.UNKNOWN, True)
        await west.finish(DONE)
        await until(lambda: east.known(opened("k1")) == DONE)
        assert await east.claim(opened("k1")) == DONE
        assert east.known(opened("k2")) is None
    async with KeyTable(MemoryTable(shared), "west") as again:
        assert await again.claim(opened("k1")) == DONE, "after a restart too"


async def test_of_many_claims_of_one_key_at_once_one_takes_it() -> None:
    shared = Shared()
    tables = [MemoryTable(shared) for _ in range(4)]
    for table in tables:
        table.before = lambda: asyncio.sleep(0)
    async with (
        KeyTable(tables[0], "a") as a,
        KeyTable(tables[1], "b") as b,
        KeyTable(tables[2], "c") as c,
        KeyTable(tables[3], "d") as d,
    ):
        for number in range(40):
            key = f"k{number}"
            found = await asyncio.gather(*(each.claim(opened(key)) for each in (a, b, c, d, a, b)))
            assert found.count(None) == 1


async def test_keys_of_one_entry_are_all_remembered_when_collectors_change_it_at_once() -> None:
    shared = Shared()
    keys = [key for key in (f"k{number}" for number in range(2000)) if slot_of(key) == slot_of("k0")]
    async with KeyTable(MemoryTable(shared), "west") as west, KeyTable(MemoryTable(shared), "east") as east:
        found = await asyncio.gather(*((west, east)[n % 2].claim(opened(key)) for n, key in enumerate(keys)))
        assert found == [None] * len(keys)
    (entry,) = shared.entries.values()
    assert set(decode_memory(entry.value).results) == set(keys)


async def test_a_watch_that_is_late_makes_a_claim_wait_and_one_that_is_dead_refuses_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shared = Shared()
    late = MemoryTable(shared)
    async with KeyTable(MemoryTable(shared), "west") as west, KeyTable(late, "east") as east:
        await asyncio.sleep(0)
        late.shows.clear()
        assert await west.claim(opened("k1")) is None
        waiting = asyncio.create_task(east.claim(opened("k1")))
        for _ in range(20):
            await asyncio.sleep(0)
        assert not waiting.done()
        late.shows.set()
        found = await waiting
        assert found is not None
        assert found.state is CommandState.UNKNOWN
        late.shows.clear()
        await west.finish(DONE)
        assert await west.claim(opened("k1")) == DONE
        monkeypatch.setattr("busway.apps.fleet.key_table.CLAIM_SECONDS", 0.05)
        other = next(key for key in (f"x{n}" for n in range(5000)) if slot_of(key) == slot_of("k1"))
        with pytest.raises(KeysUnavailable, match="does not confirm: no answer"):
            await east.claim(opened(other))


async def test_a_table_that_is_away_refuses_and_takes_no_key() -> None:
    shared = Shared()
    table = MemoryTable(shared)
    async with KeyTable(table, "west") as west:
        table.fails, table.is_made = CoordinatorDown("it is away"), False
        with pytest.raises(KeysUnavailable, match="does not answer: it is away"):
            await west.claim(opened("k1"))
        table.fails = None
        assert await west.claim(opened("k1")) is None


@pytest.mark.parametrize("is_made", [True, False])
async def test_a_claim_without_an_answer_is_refused_and_may_be_made_again_by_this_collector_alone(
    *, is_made: bool
) -> None:
    shared = Shared()
    table = MemoryTable(shared)
    async with KeyTable(table, "west") as west, KeyTable(MemoryTable(shared), "east") as east:
        table.fails, table.is_made = OutcomeUnknown("no answer"), is_made
        with pytest.raises(KeysUnavailable, match="does not confirm: no answer"):
            await west.claim(opened("k1"))
        table.fails = None
        if is_made:
            there = await east.claim(opened("k1"))
            assert there is not None
            assert there.state is CommandState.UNKNOWN
        assert await west.claim(opened("k1")) is None
        again = await west.claim(opened("k1"))
        assert again is not None
        assert again.state is CommandState.UNKNOWN
    async with KeyTable(MemoryTable(shared), "west") as restarted:
        later = await restarted.claim(opened("k1"))
        assert later is not None
        assert later.state is CommandState.UNKNOWN


async def test_an_end_that_cannot_be_recorded_is_tried_again_and_then_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.fleet.key_table.RECORD_AGAIN", (0.0, 0.0, 0.0))
    shared = Shared()
    table = MemoryTable(shared)
    tries: list[int] = []
    async with KeyTable(table, "west") as west:
        assert await west.claim(opened("k1")) is None

        async def second_time() -> None:
            tries.append(1)
            table.fails = None if len(tries) == 2 else CoordinatorDown("it is away")

        table.before, table.is_made = second_time, False
        await west.finish(DONE)
        assert len(tries) == 2
        assert west.known(opened("k1")) == DONE
        await west.finish(DONE)
        assert len(tries) == 5


async def test_a_table_with_an_entry_that_this_program_cannot_read_refuses() -> None:
    shared = Shared()
    shared.entries[slot_of("k1")] = Entry(slot_of("k1"), b"{}", 1)
    async with KeyTable(MemoryTable(shared), "west") as west:
        await asyncio.sleep(0)
        with pytest.raises(KeysUnavailable, match="cannot be read by this program"):
            await west.claim(opened("k1"))
        assert west.known(opened("k1")) is None


async def test_a_table_that_showed_revisions_too_high_and_is_read_anew_can_be_changed_again() -> None:
    """As where the watch of a server with another count was left for that of the server that leads."""
    shared, wrong = Shared(), Shared()
    table = MemoryTable(shared)
    first = await table.create(slot_of("k"), b"")
    wrong.entries[slot_of("k")] = Entry(slot_of("k"), b"", first + 15)

    class ReadAnew(MemoryTable):
        async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
            for entry in wrong.entries.values():
                yield entry
            yield SNAPSHOT_ENDS
            await asyncio.sleep(0.05)
            yield SNAPSHOT_BEGINS
            async for entry in super().watch(prefix):
                yield entry

    async with KeyTable(ReadAnew(shared), "west") as keys:
        await until(lambda: bool(keys._seen), 10)
        assert await keys.claim(opened("k")) is None
    assert shared.entries[slot_of("k")].revision == first + 1


@pytest.mark.parametrize("is_put_back", [False, True])
async def test_a_table_that_was_lost_or_put_back_takes_new_keys_and_used_ones_stay_used(is_put_back: bool) -> None:
    """`k1` was used before the backup, the next key after it; both are sent once."""
    shared = Shared()
    _, after, new, newer = SAME_ENTRY[:4]
    async with KeyTable(MemoryTable(shared), "west") as west:
        assert await west.claim(opened("k1")) is None
        backup = list(shared.entries.values())
        await west.finish(DONE)
        assert await west.claim(opened(after)) is None
        await until(lambda: bool(shared.watches))
        shared.become(backup if is_put_back else [])
        await until(lambda: bool(west._lost))
        assert west.known(opened("k1")) == DONE
        assert await west.claim(opened("k1")) == DONE
        assert await west.claim(opened(after)) is not None
        assert await west.claim(opened(new)) is None
        assert not west._lost
        assert await west.claim(opened(newer)) is None
    async with KeyTable(MemoryTable(shared), "east") as east:
        await until(lambda: bool(east._seen))
        assert await east.claim(opened("k1")) == DONE, "the table has it again"
        assert await east.claim(opened(after)) is not None


async def test_each_collector_adds_what_it_knows_to_a_table_that_was_lost() -> None:
    shared, late = Shared(), MemoryTable(Shared())
    late.shared = shared
    _, second, third, fourth = SAME_ENTRY[:4]
    async with KeyTable(late, "west") as west, KeyTable(MemoryTable(shared), "east") as east:
        assert await east.claim(opened("k1")) is None
        await until(lambda: bool(west._seen))
        late.shows.clear()
        assert await east.claim(opened(second)) is None, "west does not see it"
        for watch in shared.watches[:1]:
            while not watch.empty():
                watch.get_nowait()
        shared.become([])
        late.shows.set()
        await until(lambda: bool(west._lost and east._lost))
        assert await west.claim(opened(third)) is None
        await until(lambda: east.known(opened(third)) is not None)
        assert await east.claim(opened(second)) is not None
        assert await east.claim(opened(fourth)) is None
        await until(lambda: west.known(opened(second)) is not None)
    (entry,) = shared.entries.values()
    assert set(decode_memory(entry.value).results) == {"k1", second, third, fourth}


async def test_a_claim_that_waits_for_an_entry_goes_on_once_the_table_shows_that_it_is_lost() -> None:
    shared = Shared()
    async with KeyTable(MemoryTable(shared), "west") as west:
        assert await west.claim(opened("k1")) is None
        await until(lambda: bool(shared.watches))
        shared.entries.clear()
        claim = asyncio.create_task(west.claim(opened(SAME_ENTRY[1])))
        await asyncio.sleep(0.01)
        assert not claim.done(), "it conflicts with what is known"
        shared.become([])
        assert await claim is None


async def test_a_change_whose_answer_comes_after_the_table_was_lost_is_not_taken_for_its_entry() -> None:
    shared = Shared()
    table = MemoryTable(shared)

    class LateAnswer(MemoryTable):
        async def replace(self, key: str, value: bytes, revision: int) -> int:
            made = await super().replace(key, value, revision)
            if made == 1:
                shared.become([])
                await asyncio.sleep(0.05)
            return made

    async with KeyTable(LateAnswer(shared), "west") as west:
        await until(lambda: bool(shared.watches))
        shared.revision = 0
        assert await west.claim(opened("k1")) is None
        shared.revision = 5
        assert await west.claim(opened(SAME_ENTRY[1])) is None
        assert await west.claim(opened("k1")) is not None
    await table.close()


async def test_a_watch_that_ends_by_an_error_is_begun_again_and_shows_what_others_took_meanwhile(
    caplog: pytest.LogCaptureFixture,
) -> None:
    shared = Shared()

    class EndsOnce(MemoryTable):
        watched = 0

        async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
            self.watched += 1
            if self.watched == 1:
                yield SNAPSHOT_ENDS
                raise RuntimeError("the protocol is in a state that it cannot have")
            async for entry in super().watch(prefix):
                yield entry

    async with KeyTable(MemoryTable(shared), "west") as west, KeyTable(EndsOnce(shared), "east") as east:
        assert await west.claim(opened("k1")) is None
        found = await east.claim(opened("k1"))
        assert found is not None
        assert found.state is CommandState.UNKNOWN
    assert "the table of keys cannot be followed; it is read anew" in caplog.text
