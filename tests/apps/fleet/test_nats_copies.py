"""A table of which the servers of a cluster have different copies, as nats-server 2.9 leaves them after a kill.

The cluster is a fake: real servers come into this state by chance only.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import aclosing, asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest

nats = pytest.importorskip("nats")
errors = pytest.importorskip("nats.js.errors")

from busway.apps.fleet.coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Entry, RevisionConflict  # noqa: E402
from busway.apps.fleet.coordinators import nats as nats_coordinator  # noqa: E402
from busway.apps.fleet.coordinators.nats import NatsCoordinator  # noqa: E402

BUCKET = "busway-hall"


class Copy:
    """The copy of one server: it numbers changes in its own way, or does not get them any more."""

    def __init__(self, lead: int, *, is_frozen: bool = False) -> None:
        self.lead, self.is_frozen = lead, is_frozen
        self.entries: dict[str, tuple[int, bytes]] = {}
        self.consumers: dict[str, Any] = {}

    def take(self, key: str, sequence: int, value: bytes) -> None:
        if not self.is_frozen:
            self.entries[key] = sequence + self.lead, value


class Cluster:
    """Servers of a cluster, as one client of nats-py sees them; the first leads.

    Attributes:
        places: the server of each consumer that is made, in order; the leader after these.
        miscounted: by how much the count of what is pending is too high.
    """

    is_connected, cause = True, ""

    def __init__(self, *copies: Copy, places: list[int], miscounted: int = 0) -> None:
        self.copies, self.places, self.miscounted = copies, places, miscounted
        self.sequence = 100
        self._inboxes = 0
        self._callbacks: dict[str, Any] = {}
        self._delivered: dict[str, int] = {}

    def words(self, error: object) -> str:
        return str(error)

    def jetstream(self, timeout: float, domain: str | None = None) -> "Cluster":
        return self

    def new_inbox(self) -> str:
        self._inboxes += 1
        return f"inbox.{self._inboxes}"

    async def subscribe(self, inbox: str, cb: Any) -> Any:
        self._callbacks[inbox] = cb

        async def unsubscribe() -> None:
            del self._callbacks[inbox]

        return SimpleNamespace(unsubscribe=unsubscribe)

    async def stream_info(self, stream: str) -> Any:
        return SimpleNamespace(cluster=SimpleNamespace(leader="n0"))

    async def add_consumer(self, stream: str, config: Any) -> Any:
        number = self.places.pop(0) if self.places else 0
        copy = self.copies[number]
        copy.consumers[config.deliver_subject] = config
        self._delivered[config.deliver_subject] = 0
        entries = sorted((sequence, key, value) for key, (sequence, value) in copy.entries.items())
        for left, (sequence, key, value) in zip(range(len(entries) - 1, -1, -1), entries, strict=True):
            await self._deliver(config.deliver_subject, key, sequence, value, left + self.miscounted)
        return SimpleNamespace(num_pending=len(entries), delivered=None, cluster=SimpleNamespace(leader=f"n{number}"))

    async def publish(self, subject: str, value: bytes, headers: dict[str, str]) -> Any:
        key = subject.removeprefix(f"$KV.{BUCKET}.")
        actual = self.copies[0].entries.get(key, (0, b""))[0]
        if int(headers["Nats-Expected-Last-Subject-Sequence"]) != actual:
            raise errors.APIError(code=400, err_code=10071, description=f"wrong last sequence: {actual}")
        await self.change(key, value)
        return SimpleNamespace(seq=self.copies[0].entries[key][0])

    async def change(self, key: str, value: bytes) -> None:
        self.sequence += 1
        for copy in self.copies:
            copy.take(key, self.sequence, value)
            for inbox in copy.consumers:
                if not copy.is_frozen:
                    await self._deliver(inbox, key, copy.entries[key][0], value, self.miscounted)

    async def beat(self) -> None:
        for inbox in list(self._callbacks):
            await self._callbacks[inbox](SimpleNamespace(headers={"Status": "100"}))

    async def _deliver(self, inbox: str, key: str, sequence: int, value: bytes, left: int) -> None:
        self._delivered[inbox] += 1
        if inbox in self._callbacks:
            moment = SimpleNamespace(timestamp=lambda: 1000.0)
            order = SimpleNamespace(consumer=self._delivered[inbox], stream=sequence)
            data = SimpleNamespace(sequence=order, num_pending=left, timestamp=moment)
            message = SimpleNamespace(headers=None, subject=f"$KV.{BUCKET}.{key}", data=value, metadata=data)
            await self._callbacks[inbox](message)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_coordinator, "LATE", 0.05)


@asynccontextmanager
async def beating(cluster: Cluster) -> AsyncIterator[NatsCoordinator]:
    """A coordinator on these servers, which send heartbeats."""

    async def beat() -> None:
        while True:
            await cluster.beat()
            await asyncio.sleep(0.01)

    task = asyncio.create_task(beat())
    try:
        yield NatsCoordinator(cluster, BUCKET, 1.0)
    finally:
        task.cancel()


async def until(entries: Any, mark: Entry) -> list[Entry]:
    found: list[Entry] = []
    async with asyncio.timeout(10):
        async for entry in entries:
            if entry is mark:
                return found
            found.append(entry)
    raise AssertionError("the watch has ended")


@pytest.mark.parametrize(
    "other", [Copy(-15), Copy(+15), Copy(0, is_frozen=True)], ids=["behind", "ahead", "without changes"]
)
async def test_a_watch_of_a_copy_that_differs_from_the_leaders_is_begun_anew_at_the_leader(
    other: Copy, caplog: pytest.LogCaptureFixture
) -> None:
    cluster = Cluster(Copy(0), other, Copy(-15), places=[1, 2, 1])
    other.entries["lease.1"] = 1, b"old"  # what a frozen copy had before
    await cluster.change("lease.1", b"west")
    async with beating(cluster) as coordinator, aclosing(coordinator.watch()) as entries:
        (shown,) = await until(entries, SNAPSHOT_ENDS)
        with pytest.raises(RevisionConflict):
            await coordinator.replace("lease.1", b"east", shown.revision)
        await until(entries, SNAPSHOT_BEGINS)
        (shown,) = await until(entries, SNAPSHOT_ENDS)
        assert (shown.revision, shown.value) == (101, b"west")
        assert await coordinator.replace("lease.1", b"east", shown.revision) == 102
    assert "do not agree on the table of the zone (lease.1 has revision 101" in caplog.text
    assert not cluster.places, "consumers on other servers are left until one is at the leader"


@pytest.mark.parametrize("other", [Copy(+15), Copy(0, is_frozen=True)], ids=["ahead", "without changes"])
async def test_a_confirmed_change_that_a_watch_does_not_show_as_it_was_confirmed_begins_the_watch_anew(
    other: Copy,
) -> None:
    cluster = Cluster(Copy(0), other, places=[1])
    async with beating(cluster) as coordinator, aclosing(coordinator.watch("member.")) as entries:
        assert await until(entries, SNAPSHOT_ENDS) == []
        assert await coordinator.create("member.west", b"1") == 101
        await until(entries, SNAPSHOT_BEGINS)
        assert [(each.key, each.revision) for each in await until(entries, SNAPSHOT_ENDS)] == [("member.west", 101)]


async def test_a_watch_that_agrees_is_not_begun_anew_whatever_is_changed_by_whom() -> None:
    cluster = Cluster(Copy(0), Copy(0), places=[1])
    shown: list[Entry] = []
    async with beating(cluster) as coordinator, aclosing(coordinator.watch()) as entries:
        await until(entries, SNAPSHOT_ENDS)
        revision = await coordinator.create("member.west", b"same")
        for number in range(30):
            revision = await coordinator.replace("member.west", b"same", revision)
            await cluster.change("member.east", b"%d" % number)
            with pytest.raises(RevisionConflict):
                await coordinator.create("member.east", b"x")
            async with asyncio.timeout(10):
                async for entry in entries:
                    shown.append(entry)
                    if entry.value == b"%d" % number:
                        break
            await asyncio.sleep(0.01)
    assert SNAPSHOT_BEGINS not in shown
    assert [each.revision for each in shown] == sorted(each.revision for each in shown)


async def test_a_watch_is_complete_when_it_has_shown_all_keys_though_the_server_counts_more() -> None:
    cluster = Cluster(Copy(0), places=[], miscounted=1)
    for key in ("a", "b", "c"):
        await cluster.change(key, b"x")
    async with beating(cluster) as coordinator, aclosing(coordinator.watch()) as entries:
        assert [each.key for each in await until(entries, SNAPSHOT_ENDS)] == ["a", "b", "c"]


async def test_a_watch_is_complete_after_some_seconds_whatever_the_server_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nats_coordinator, "QUIET", 0.1)
    cluster = Cluster(Copy(0), places=[], miscounted=1)
    await cluster.change("a", b"x")
    one_more = cluster.add_consumer

    async def add_consumer(stream: str, config: Any) -> Any:
        info = await one_more(stream, config)
        info.num_pending += 1
        return info

    monkeypatch.setattr(cluster, "add_consumer", add_consumer)
    async with beating(cluster) as coordinator, aclosing(coordinator.watch()) as entries:
        assert [each.key for each in await until(entries, SNAPSHOT_ENDS)] == ["a"]
