"""The stream of a collector's page: values as they change, registers of what is shown, events, and its limits."""

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from page_collector import WatchedCollector, watched_collector
from waiting import wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.writer import Commit
from busway.apps.web import collector_stream, viewers
from busway.apps.web.collector_stream import CollectorStream
from busway.apps.web.live_values import LiveValues
from busway.apps.web.request_guard import Caller, Role


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WatchedCollector]:
    with watched_collector(tmp_path_factory.mktemp("plant"), more="[poll_class.rare]\nperiod = 3600\n") as running:
        yield running


def stream_of(plant: WatchedCollector) -> ClientConnection:
    return connect(plant.page.url.replace("http", "ws") + "stream", proxy=None)


def until(socket: ClientConnection, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    limit = time.monotonic() + 20
    while time.monotonic() < limit:
        message: dict[str, Any] = json.loads(socket.recv(timeout=20))
        if holds(message):
            return message
    raise AssertionError("nothing of that kind came")


def until_values(socket: ClientConnection, **wanted: Any) -> None:
    """Wait until points, by their place behind ``p``, have these values."""
    values: dict[str, Any] = {}

    def take(message: dict[str, Any]) -> bool:
        for first, found, _ in message.get("changed", ()):
            values.update({f"p{first + at}": value for at, value in enumerate(found)})
        return values | wanted == values

    until(socket, take)


def receive_all(socket: ClientConnection, into: list[str] | None = None) -> None:
    """Receive until the stream is closed, which raises."""
    while True:
        text = str(socket.recv(timeout=20))
        if into is not None:
            into.append(text)


def test_the_first_message_has_every_point_and_later_ones_what_changes(plant: WatchedCollector) -> None:
    with stream_of(plant) as socket:
        first = json.loads(socket.recv(timeout=20))
        assert sum(len(run[1]) for run in first["changed"]) == 3
        assert first["revision"] == plant.ask("/api/points")[1]["revision"]
        plant.device.holding_registers[1] = 321
        until_values(socket, p1=321)


def test_a_defect_while_values_are_told_is_logged_and_the_next_viewer_gets_them(
    plant: WatchedCollector, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def since(values: LiveValues, seen: int) -> str:
        raise ZeroDivisionError("of the test")

    with stream_of(plant):
        with monkeypatch.context() as patched:
            patched.setattr(LiveValues, "since", since)
            wait_until(lambda: "values are no longer sent to the page" in caplog.text)
        with stream_of(plant) as second:
            assert json.loads(second.recv(timeout=20))["changed"]


@pytest.mark.parametrize("when", ["start", "reload"])
def test_a_commit_while_the_last_values_are_taken_over_is_shown(when: str) -> None:
    """A collector of which only the parts exist that a stream looks at; one point is read while it begins."""
    told: list[Callable[[Commit], None]] = []
    group = PointGroup("meter", ("power",))

    class LastValuesOfBefore(LastValues):
        def reads(self) -> list[tuple[SampleBatch, float]]:
            found = super().reads()
            for each in (self.update, *told):
                each(Commit(1, 0, [SampleBatch(group, 1_000_000_000, 0, [7])], []))
            return found

    def configured(*points: str) -> SimpleNamespace:
        device = SimpleNamespace(name="meter", points=[SimpleNamespace(name=each) for each in points])
        return SimpleNamespace(devices={"meter": device})

    collector: Any = SimpleNamespace(
        configuration=configured("power"),
        values=LastValues() if when == "reload" else LastValuesOfBefore(),
        subscribe=told.append,
        commands=SimpleNamespace(subscribe=lambda told: None),
    )
    stream = CollectorStream(collector)
    if when == "reload":
        collector.configuration, collector.values = configured("power", "energy"), LastValuesOfBefore()
    assert stream.refresh().columns()[0][0] == 7


async def test_what_a_tick_of_another_caller_changes_while_values_are_told_is_told_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    group = PointGroup("meter", ("power",))
    device = SimpleNamespace(name="meter", points=[SimpleNamespace(name="power")])
    collector: Any = SimpleNamespace(
        configuration=SimpleNamespace(devices={"meter": device}),
        values=LastValues(),
        subscribe=lambda told: None,
        commands=SimpleNamespace(subscribe=lambda told: None),
        alarms=SimpleNamespace(counts=lambda: (0, 0)),
        loads=dict,
    )
    stream = CollectorStream(collector)
    values, told_since = stream.values, LiveValues.since

    def read(value: int) -> None:
        values.update(Commit(value, 0, [SampleBatch(group, value * 1_000_000_000, 0, [value])], []))

    def since(values: LiveValues, seen: int) -> str:
        text = told_since(values, seen)
        if values.values == [7]:
            read(8)
            values.columns()  # as GET /api/values does
        return text

    monkeypatch.setattr(LiveValues, "since", since)
    monkeypatch.setattr(collector_stream, "TICK", 0)
    read(7)
    viewer = collector_stream.Viewer(Caller("anna", Role.VIEW))
    stream._viewers.append(viewer)
    ticks = asyncio.create_task(stream._tick())
    told = []
    while len(told) < 2:
        async with asyncio.timeout(60):
            while not viewer.message:
                await viewer.wake.wait()
                viewer.wake.clear()
        told.append(json.loads(viewer.message)["changed"])
        viewer.message, viewer.is_sending = "", False
    ticks.cancel()
    await asyncio.gather(ticks, return_exceptions=True)
    assert told == [[[0, [7], 0]], [[0, [8], 0]]]


def test_registers_come_for_points_that_are_shown_and_only_as_they_change(plant: WatchedCollector) -> None:
    plant.device.holding_registers[0] = 0x0A0B
    with stream_of(plant) as socket:
        assert "raw" not in json.loads(socket.recv(timeout=20))
        socket.send('{"shown":[0,2]}')
        assert until(socket, lambda message: message.get("raw") == {"0": "0A0B"})
        assert "raw" not in json.loads(socket.recv(timeout=20))


def test_events_reach_all_viewers(plant: WatchedCollector) -> None:
    with stream_of(plant) as one, stream_of(plant) as other:
        for socket in (one, other):
            socket.recv(timeout=20)
        plant.loop.call_soon_threadsafe(plant.page.api.stream.queue_event, "command", {"key": "one", "state": "done"})
        for socket in (one, other):
            found = until(socket, lambda message: "command" in message)
            assert found == {"command": {"key": "one", "state": "done"}}


def test_commands_are_told_with_who_and_outcome(plant: WatchedCollector) -> None:
    with stream_of(plant) as socket:
        socket.recv(timeout=20)
        write = plant.collector.write("pump", "speed", 2.5, by="anna")
        asyncio.run_coroutine_threadsafe(write, plant.loop).result(20)
        told = until(socket, lambda message: "command" in message)["command"]
        assert (told["by"], told["device"], told["point"], told["value"]) == ("anna", "pump", "speed", 2.5)
        assert told["state"] == "done"


def test_the_number_of_alarms_is_told_as_it_changes_and_to_new_viewers(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with watched_collector(tmp_path_factory.mktemp("alarmed"), profile=ALARMED) as plant:
        with stream_of(plant) as socket:
            assert "alarms" not in json.loads(socket.recv(timeout=20))
            plant.device.holding_registers[1] = 90
            found = until(socket, lambda message: "alarms" in message)
            assert found["alarms"] == {"active": 1, "unacknowledged": 1}
        with stream_of(plant) as later:
            assert until(later, lambda message: "alarms" in message) == found


@pytest.mark.parametrize("text", ["", "[]", '{"shown":[-1]}', '{"shown":"all"}', '{"shown":[0],"x":1}', "no json"])
def test_a_wish_that_cannot_be_closes_the_stream_with_a_sentence(plant: WatchedCollector, text: str) -> None:
    with stream_of(plant) as socket:
        socket.send(text)
        with pytest.raises(ConnectionClosed) as caught:
            receive_all(socket)
        assert "shown" in str(caught.value)


def test_places_beyond_the_last_point_are_left_out(plant: WatchedCollector) -> None:
    with stream_of(plant) as socket:
        socket.send('{"shown":[0,3,100000]}')
        assert json.loads(socket.recv(timeout=20))


def test_more_points_than_fit_on_a_screen_are_refused(plant: WatchedCollector) -> None:
    with stream_of(plant) as socket:
        socket.send(json.dumps({"shown": list(range(collector_stream.MOST_SHOWN + 1))}))
        with pytest.raises(ConnectionClosed):
            receive_all(socket)


def test_there_is_a_limit_to_viewers(plant: WatchedCollector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewers, "MOST_VIEWERS", 1)
    with stream_of(plant) as socket:
        socket.recv(timeout=20)
        with pytest.raises((InvalidStatus, ConnectionClosed)), stream_of(plant) as other:
            other.recv(timeout=20)


@pytest.mark.parametrize(
    "later", ["", "view a-token-of-many-letters anna\n", "operate a-token-of-many-letters berta\n", None]
)
def test_a_viewer_whose_token_is_removed_or_permits_something_else_is_closed_and_others_stay(
    plant: WatchedCollector, later: str | None
) -> None:
    path = plant.page.token_path
    first = path.read_text()
    offered: Any = ["busway", "bearer.a-token-of-many-letters"]
    try:
        path.write_text(first + "operate a-token-of-many-letters anna\n")
        with (
            stream_of(plant) as without,
            connect(plant.page.url.replace("http", "ws") + "stream", subprotocols=offered, proxy=None) as socket,
        ):
            socket.send('{"shown":[1]}')
            until(socket, lambda message: "raw" in message)
            if later is None:
                path.unlink()
            else:
                path.write_text(first + later)
            with pytest.raises(ConnectionClosed) as caught:
                receive_all(socket)
            assert caught.value.rcvd is not None
            assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, "what its token permits has changed")
            wait_until(lambda: len(plant.page.api.stream) == 1)
            plant.loop.call_soon_threadsafe(plant.page.api.stream.queue_event, "command", {"key": "later"})
            until(without, lambda message: message.get("command") == {"key": "later"})
    finally:
        path.write_text(first)
        path.chmod(0o600)


def test_an_event_that_waits_for_a_viewer_is_not_sent_once_its_token_is_removed(
    plant: WatchedCollector, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = plant.page.api.stream
    with stream_of(plant) as socket:
        socket.recv(timeout=20)

        def at_once() -> None:  # before any tick
            monkeypatch.setattr(viewers, "current_caller", lambda scope: None)
            stream.queue_event("command", {"key": "secret"})

        plant.loop.call_soon_threadsafe(at_once)
        told: list[str] = []
        with pytest.raises(ConnectionClosed):
            receive_all(socket, told)
    assert "secret" not in "".join(told)


def test_nothing_ticks_without_viewers(plant: WatchedCollector) -> None:
    with stream_of(plant) as socket:
        socket.recv(timeout=20)
    limit = time.monotonic() + 20
    while len(plant.page.api.stream):
        assert time.monotonic() < limit
        time.sleep(0.02)
    assert plant.page.api.stream._ticker is None


ALARMED = """\
[[unit]]
unit = 1
point = [
    { name = "level", address = "4x2", alarm = [{ kind = "H", limit = 80, acknowledge = true }] },
]
"""
RARE = """\
[[unit]]
unit = 1
point = [
    { name = "speed", address = "4x1", scale = 0.1 },
    { name = "level", address = "4x2", poll_class = "rare" },
]
"""


def test_a_point_that_is_read_rarely_is_read_every_second_while_it_is_shown(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("rare")
    with (
        watched_collector(folder, more="[poll_class.rare]\nperiod = 3600\n", profile=RARE) as plant,
        stream_of(plant) as socket,
    ):
        until_values(socket, p0=1.5, p1=7)  # each is read once at the start
        socket.send('{"shown":[1]}')
        plant.device.holding_registers[1] = 55
        until_values(socket, p1=55)
