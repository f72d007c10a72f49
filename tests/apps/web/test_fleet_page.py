"""The fleet over HTTP: how far sinks are behind; the stream is asked once in `NEWEST_SECONDS`, not for each page."""

import json

import pytest

from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.stream_head import newest_message
from busway.apps.fleet.zone_watch import ZoneWatch
from busway.apps.web import fleet_page
from busway.apps.web.fleet_page import FleetApi


def unused_coordinator() -> LocalCoordinator:
    """A coordinator without a file: these tests do not use it."""
    return LocalCoordinator.__new__(LocalCoordinator)


def watch_with_sinks(**taken: int) -> ZoneWatch:
    watch = ZoneWatch(unused_coordinator())
    for number, (name, sequence) in enumerate(taken.items(), 1):
        watch.take(Entry(f"cursor.{name}", json.dumps([sequence]).encode(), number))
    return watch


class Stream:
    """A stream whose newest message is known, or not."""

    def __init__(self, newest: int | None) -> None:
        self.newest = newest
        self.asked = 0

    async def __call__(self) -> int | None:
        self.asked += 1
        return self.newest


async def behind(api: FleetApi) -> dict[str, int | None]:
    return {each.name: each.behind for each in (await api.get_fleet()).sinks}


async def test_a_sink_is_behind_by_the_messages_that_it_has_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream(100)
    api = FleetApi(watch_with_sinks(archive=97, lines=100, ahead=103), stream)
    assert await behind(api) == {"archive": 3, "lines": 0, "ahead": 0}
    stream.newest = 110
    assert await behind(api) == {"archive": 3, "lines": 0, "ahead": 0}  # as it was known just now
    assert stream.asked == 1
    monkeypatch.setattr(fleet_page, "NEWEST_SECONDS", 0.0)
    assert await behind(api) == {"archive": 13, "lines": 10, "ahead": 7}


async def test_where_the_stream_is_not_known_no_lag_is_told() -> None:
    assert await behind(FleetApi(watch_with_sinks(archive=97), Stream(None))) == {"archive": None}
    assert await behind(FleetApi(watch_with_sinks(archive=97))) == {"archive": None}


async def test_a_zone_without_nats_has_no_stream() -> None:
    assert await newest_message(unused_coordinator(), "hall") is None
