"""The WebSocket: a snapshot of what was asked for, then what changes, never more than a client can take."""

import contextlib
import json

import pytest
from page_plant import watched, watching
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import busway
from busway.apps.web.connections import MOST_VIEWERS
from busway.apps.web.simulation_messages import SimulationAnswer, TrafficQuery
from busway.apps.web.simulation_stream import FRAMES_AT_ONCE, MOST_POINTS, SimulationViewer, Wish

MANY = "\n".join(f'[[unit.point]]\nname = "p{number}"\naddress = "holding:{number}"' for number in range(60))
BUSY = f"[[unit]]\nunit = 1\n{MANY}\n"


@pytest.fixture(scope="module")
def plant():
    with watched() as running:
        yield running


def stream_of(plant, **options):
    return connect(f"ws://{plant.host}/stream", proxy=None, **options)


def collect(socket, enough):
    """Messages put together until ``enough`` says so."""
    found = {"points": {}, "traffic": [], "faults": None, "status": None, "skipped": 0}
    while not enough(found):
        message = json.loads(socket.recv(timeout=10))
        found["points"] |= {point[0]: point for point in message.get("points", ())}
        found["traffic"] += message.get("traffic", ())
        for key in ("faults", "status", "skipped"):
            found[key] = message.get(key, found[key])
    return found


def test_the_first_message_says_how_the_server_stands(plant):
    with stream_of(plant) as socket:
        found = collect(socket, lambda found: found["status"])
    SimulationAnswer.model_validate(found["status"]["simulation"])
    assert found["faults"] == []
    assert found["status"]["lines"][0]["indicators"]["device_status"] == "on"


def test_asking_for_points_gives_how_they_stand(plant):
    with stream_of(plant) as socket:
        socket.send(json.dumps({"points": "all"}))
        found = collect(socket, lambda found: len(found["points"]) == 6)
    index, value, raw, at, writer, held = found["points"][3]
    assert (index, value, raw, writer, held) == (3, True, "1", "simulation", False)
    assert at >= 0


def test_only_the_points_that_were_asked_for_come(plant):
    with stream_of(plant) as socket:
        socket.send(json.dumps({"points": [3]}))
        found = collect(socket, lambda found: found["points"])
        socket.send(json.dumps({"points": [4]}))
        more = collect(socket, lambda found: found["points"])
    assert set(found["points"]) == {3}
    assert set(more["points"]) == {4}


def test_a_write_by_modbus_comes_with_its_writer(plant):
    with stream_of(plant) as socket, busway.connect(plant.endpoints[0]) as link:
        socket.send(json.dumps({"points": [1]}))
        collect(socket, lambda found: found["points"])
        link.unit(1).write("4x1", 3.25, "float32")
        found = collect(socket, lambda found: found["points"])
    assert found["points"][1][1:3] == [3.25, "4050 0000"]
    assert found["points"][1][4].startswith("127.0.0.1:")


def test_a_fault_that_is_switched_comes_at_once(plant):
    with stream_of(plant) as socket:
        collect(socket, lambda found: found["status"])
        name = plant.simulation.switchboard.add("busy")
        try:
            found = collect(socket, lambda found: found["faults"])
        finally:
            plant.simulation.switchboard.remove(name)
    assert found["faults"][0]["name"] == "busy"


def test_frames_come_only_to_viewers_that_asked(plant):
    with stream_of(plant) as silent, stream_of(plant) as told, busway.connect(plant.endpoints[0]) as link:
        told.send(json.dumps({"traffic": True, "after": plant.page.traffic.last}))
        link.unit(1).read("4x1", "float32")
        found = collect(told, lambda found: len(found["traffic"]) >= 2)
        assert [frame["direction"] for frame in found["traffic"]] == ["request", "reply"]
        assert not collect(silent, lambda found: found["status"])["traffic"]


def test_coming_back_gives_the_frames_since_and_says_how_many_are_missing(plant):
    with busway.connect(plant.endpoints[0]) as link:
        unit = link.unit(1)
        before = plant.page.traffic.last
        for _ in range(FRAMES_AT_ONCE):
            unit.read("4x1", "float32")
    with stream_of(plant) as socket:
        socket.send(json.dumps({"traffic": True, "after": before}))
        found = collect(socket, lambda found: found["traffic"])
    assert len(found["traffic"]) == FRAMES_AT_ONCE
    assert found["traffic"][-1]["number"] == plant.page.traffic.last
    assert found["skipped"] == FRAMES_AT_ONCE  # two frames a read, and half of them are too much at once


@pytest.mark.parametrize(
    "wish", ["nonsense", '{"points": "some"}', '{"points": [99]}', '{"other": 1}', '{"points": [-1]}']
)
def test_a_wish_that_cannot_be_ends_with_a_reason(plant, wish):
    with stream_of(plant) as socket:
        socket.send(wish)
        with pytest.raises(ConnectionClosed) as closed:
            collect(socket, lambda found: False)
    assert closed.value.rcvd.reason


def test_message_that_is_no_text_ends_with_1003_and_without_a_traceback(plant, caplog):
    with stream_of(plant) as socket:
        socket.send(b"\x00\x01")
        with contextlib.suppress(ConnectionClosed):
            for _ in socket:  # what was on its way, until it is closed
                pass
        assert socket.close_code == 1003
    assert "Traceback" not in caplog.text


def test_no_more_than_so_many_streams_are_served(plant):
    import contextlib

    from websockets.exceptions import InvalidStatus

    with contextlib.ExitStack() as stack:
        for _ in range(MOST_VIEWERS):
            collect(stack.enter_context(stream_of(plant)), lambda found: found["status"])
        with pytest.raises(InvalidStatus):
            stack.enter_context(stream_of(plant))


async def test_the_simulation_is_watched_only_while_a_page_is_open():
    async with watching() as plant:
        watchers = plant.simulation._watchers
        async with _client(plant) as socket:
            await socket.recv()
            assert len(plant.simulation._watchers) == len(watchers) + 1
        await plant.page.stop()
        assert plant.simulation._watchers == watchers
        assert len(plant.page.streams) == 0


def _client(plant):
    from websockets.asyncio.client import connect as connect_async

    return connect_async(f"ws://{plant.host}/stream", proxy=None)


# A client by itself: what it keeps until it is taken.


async def test_a_point_that_changes_often_is_sent_once_as_it_is_now():
    async with watching(BUSY) as plant:
        client = SimulationViewer(plant.page.api)
        assert client.wish(Wish(points="all")) == ""
        assert len((await client.next())["points"]) == 60
        for value in range(1000):
            plant.simulation.set("1/p5", value)
            client.changed([5])
        message = await client.next()
        assert [point[:2] for point in message["points"]] == [[5, 999]]


async def test_a_client_that_takes_nothing_keeps_no_more_than_one_mark_per_point():
    async with watching(BUSY) as plant:
        client = SimulationViewer(plant.page.api)
        client.wish(Wish(points="all", traffic=True))
        connection = plant.page.traffic.line("rtu:///dev/none")
        for number in range(5000):
            client.changed([number % 60])
            plant.page.traffic.add("tcp://127.0.0.1:502", b"\x03\x00\x00\x00\x01", is_reply=False, unit=1)
        del connection
        assert len(client._changed) == 60
        message = await client.next()
        assert len(message["points"]) == 60
        assert len(message["traffic"]) == FRAMES_AT_ONCE
        assert message["skipped"] == 5000 - FRAMES_AT_ONCE


def record_another_meanwhile(tail, monkeypatch):
    """Record a frame, and a second one while the first is read: as a line's timer does, in its thread."""
    kept_after = tail.after

    def after(number, limit):
        found = kept_after(number, limit)
        if tail.last == 1:
            tail.add("another", b"\x03\x00\x00\x00\x01", is_reply=False, unit=1)
        return found

    monkeypatch.setattr(tail, "after", after)
    tail.add("tcp://127.0.0.1:502", b"\x03\x00\x00\x00\x01", is_reply=False, unit=1)


async def test_a_frame_that_is_recorded_while_others_are_listed_is_listed_next(monkeypatch):
    async with watching(BUSY) as plant:
        record_another_meanwhile(plant.page.traffic, monkeypatch)
        first = await plant.page.api.list_traffic(TrafficQuery(after=0))
        second = await plant.page.api.list_traffic(TrafficQuery(after=first.last))
        assert [[frame.number for frame in each.frames] for each in (first, second)] == [[1], [2]]
        assert (first.lost, second.lost, second.last) == (0, 0, 2)


async def test_a_frame_that_is_recorded_while_others_are_told_is_told_next(monkeypatch):
    async with watching(BUSY) as plant:
        client = SimulationViewer(plant.page.api)
        client.wish(Wish(traffic=True))
        record_another_meanwhile(plant.page.traffic, monkeypatch)
        messages = []
        for _ in range(2):
            client.passed()
            messages.append(await client.next())
        assert [[frame["number"] for frame in message["traffic"]] for message in messages] == [[1], [2]]
        assert messages[-1]["skipped"] == 0


async def test_more_points_than_a_page_shows_cannot_all_be_followed():
    async with watching(BUSY) as plant:
        client = SimulationViewer(plant.page.api)
        plant.page.api.order = plant.page.api.order * (MOST_POINTS // 60 + 1)
        assert str(MOST_POINTS) in client.wish(Wish(points="all"))
        assert client.wish(Wish(points=[0, MOST_POINTS])) == ""
