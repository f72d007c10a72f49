"""The API of the collector's page: committed values, history with gaps, links, devices, sinks."""

import math
import re
import time
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from page_collector import MUTE, WatchedCollector, watched_collector
from waiting import wait_until

import busway
from busway.apps.collector.store.query_results import BucketTable
from busway.apps.web.collector_page import _held_trend, _trend


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with watched_collector(tmp_path_factory.mktemp("plant")) as running:
        wait_until(lambda: all(running.ask("/api/values")[1]["quality"]), 30)
        yield running


def test_values_stand_in_the_order_of_the_points_with_quality_and_reason(plant: WatchedCollector) -> None:
    points = plant.ask("/api/points")[1]["points"]
    assert [each["point"] for each in points] == ["speed", "level", "gone"]
    assert points[0]["unit_of_measure"] == "rpm"
    values = plant.ask("/api/values")[1]
    assert values["value"] == [1.5, 7, None]
    assert values["quality"] == ["good", "good", "bad"]
    assert "address" in values["reason"][2]
    assert 0 <= values["now"] - values["time"][0] < 20_000


def test_a_value_that_is_shown_is_in_the_store(plant: WatchedCollector) -> None:
    plant.device.holding_registers[1] = 4711
    wait_until(lambda: plant.ask("/api/values")[1]["value"][1] == 4711, 30)
    assert 4711 in busway.Store(plant.collector.configuration.store).read("pump/level", since="1m").value


def test_a_trend_has_at_most_the_buckets_that_were_asked_for(plant: WatchedCollector) -> None:
    status, found = plant.ask("/api/trend", device="pump", point="speed", seconds=60, buckets=10)
    assert status == 200
    assert 1 <= len(found["time"]) <= 11
    assert found["minimum"][-1] == found["maximum"][-1] == found["mean"][-1] == 1.5
    assert found["end"] - found["begin"] == pytest.approx(60)


def test_a_trend_of_no_point_is_refused_with_a_sentence(plant: WatchedCollector) -> None:
    assert plant.ask("/api/trend", device="pump", point="*") == (404, {"error": "there is no point pump/*"})
    assert plant.ask("/api/trend", device="pump", point="speed", buckets=100_000)[0] == 422


def test_links_have_their_load_and_reads_with_their_cost(plant: WatchedCollector) -> None:
    found = plant.ask("/api/links")[1]
    assert [each["name"] for each in found["links"]] == ["hall"]
    assert found["links"][0]["planned"] > 0
    assert found["links"][0]["busy"] > 0
    assert found["reads"][0]["first"] == "4x1"
    assert found["reads"][0]["seconds"] > 0


def test_devices_say_how_they_do(plant: WatchedCollector) -> None:
    (device,) = plant.ask("/api/devices")[1]["devices"]
    assert (device["name"], device["state"], device["silent_since"]) == ("pump", "polled", None)
    assert device["reads"] > 0


def test_devices_and_links_say_who_is_silent_since_when_and_what_was_learnt(tmp_path: Path) -> None:
    with watched_collector(tmp_path, more=MUTE) as running:

        def devices() -> dict[str, Any]:
            return {each["name"]: each for each in running.ask("/api/devices")[1]["devices"]}

        begun = time.time_ns() // 1_000_000
        wait_until(lambda: devices()["mute"]["silent_since"] is not None and devices()["pump"]["learnt"], 60)
        now = time.time_ns() // 1_000_000
        found = devices()
        assert (found["mute"]["state"], found["mute"]["learnt"]) == ("silent", [])
        assert begun - 60_000 < found["mute"]["silent_since"] <= now
        assert (found["pump"]["state"], found["pump"]["silent_since"]) == ("polled", None)
        assert found["pump"]["learnt"] == ["holding register 4999: exception 02"]
        (link,) = running.ask("/api/links")[1]["links"]
        assert link["silent"] == [{"device": "mute", "since": found["mute"]["silent_since"]}]


def test_sinks_say_how_far_behind_they_are(plant: WatchedCollector) -> None:
    (sink,) = plant.ask("/api/sinks")[1]["sinks"]
    assert sink["name"] == "lines"
    wait_until(lambda: plant.ask("/api/sinks")[1]["sinks"][0]["sent"] > 0, 30)


def test_the_page_and_all_that_it_names_are_served(plant: WatchedCollector) -> None:
    waiting, seen = ["/", "/collector.js"], set[str]()
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen.add(path)
        with urlopen(plant.page.url.rstrip("/") + path, timeout=60) as answer:
            text = answer.read().decode()
        waiting += [f"/{name}" for name in re.findall(r'(?:src=|href=|from |import )"\.?/([^"]+)"', text)]
    assert {"/collector.js", "/history.js", "/dom.js", "/link.js", "/style.css", "/uplot/uPlot.esm.js"} <= seen


def test_time_without_samples_is_a_gap_in_a_trend() -> None:
    second = 1_000_000_000
    table = BucketTable(
        ["pump"] * 4, ["speed"] * 4, [0, second, 9 * second, 10 * second], [1, 2, None, 4], [1, 2, None, 4],
        [1.0, 2.0, None, 4.0], [1, 1, 0, 1], [1, 1, 1, 1], [0, 0, 16, 0],
    )  # fmt: skip
    found = _trend(table, 11 * second, 11, 2.0)
    assert found.time == [0, 1, 5, 9, 10]
    assert found.mean == [1, 2, None, None, 4]


def test_a_value_of_which_only_changes_are_kept_holds_until_the_next_and_until_it_was_read_last() -> None:
    second = 1_000_000_000
    table = BucketTable(
        ["pump"] * 3, ["speed"] * 3, [0, 9 * second, 10 * second], [1, 2, None], [1, 2, None],
        [1.0, 2.0, None], [1, 1, 0], [1, 1, 1], [0, 0, 16],
    )  # fmt: skip
    found = _trend(table, 20 * second, 20, math.inf, 1.0)
    assert (found.time, found.mean) == ([0, 8, 9, 10], [1, 1, 2, None])
    assert _held_trend(found, (2.0, 0, 19 * second)).time[-1] == 10  # a gap is not filled
    empty = _held_trend(_trend(BucketTable(), 20 * second, 20, math.inf, 1.0), (5.0, 0, 19 * second))
    assert (empty.time, empty.mean) == ([0, 19], [5, 5])
    assert _held_trend(_trend(BucketTable(), 20 * second, 20, math.inf), (None, 20, 19 * second)).time == []
