"""Alarms and maintenance over HTTP: what is shown, who may change it, and what a wrong question gets."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from page_collector import WatchedCollector, watched_collector
from waiting import wait_until

BOILER = """\
[[device]]
name = "boiler"
link = "hall"
unit = 1
profile = "boiler.toml"
"""
POINTS = """\
[[unit]]
unit = 1
point = [
    { name = "heat", address = "4x11", unit_of_measure = "°C", alarm = [ALARM] },
]
""".replace("ALARM", '{ kind = "HH", limit = 80, acknowledge = true }')


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[WatchedCollector]:
    (tmp_path / "boiler.toml").write_text(POINTS)
    with watched_collector(tmp_path, more=BOILER) as watched:
        yield watched


def token(plant: WatchedCollector, role: str) -> str:
    lines = [line.split() for line in plant.page.token_path.read_text().splitlines() if not line.startswith("#")]
    return {line[0]: line[1] for line in lines}[role]


def post(plant: WatchedCollector, path: str, content: Any, role: str = "operate") -> tuple[int, Any]:
    request = Request(plant.page.url.rstrip("/") + path, json.dumps(content).encode(), method="POST")
    request.add_header("Content-Type", "application/json")
    request.add_header("Authorization", f"Bearer {token(plant, role)}")
    try:
        with urlopen(request, timeout=60) as answer:
            return answer.status, json.load(answer)
    except HTTPError as error:
        return error.code, json.load(error)


def alarms(plant: WatchedCollector) -> Any:
    status, content = plant.ask("/api/alarms")
    assert status == 200
    return content


WHICH = {"device": "boiler", "point": "heat", "limit": "HH"}


def test_an_alarm_is_shown_acknowledged_by_an_operator_and_gone_when_the_value_is_back(plant: WatchedCollector) -> None:
    assert alarms(plant) == {"active": [], "journal": []}
    plant.device.holding_registers[10] = 90
    wait_until(lambda: bool(alarms(plant)["active"]))
    (shown,) = alarms(plant)["active"]
    assert {key: shown[key] for key in WHICH} == WHICH
    assert (shown["value"], shown["text"], shown["quality"]) == (90, "above 80 °C", "good")
    assert (shown["acknowledged"], shown["cleared"], shown["needs_acknowledgement"]) == (None, None, True)
    assert post(plant, "/api/alarms/acknowledge", WHICH, "view")[0] == 403
    status, event = post(plant, "/api/alarms/acknowledge", WHICH)
    assert (status, event["event"]) == (200, "acknowledged")
    (shown,) = alarms(plant)["active"]
    assert shown["acknowledged"] == {"by": event["by"], "at": event["at"]}
    status, refused = post(plant, "/api/alarms/acknowledge", WHICH)
    assert (status, refused["error"]) == (404, "there is no alarm HH of boiler/heat to acknowledge")
    plant.device.holding_registers[10] = 20
    wait_until(lambda: not alarms(plant)["active"])
    assert [each["event"] for each in alarms(plant)["journal"]] == ["cleared", "acknowledged", "raised"]
    assert plant.ask("/api/alarms", limit=1)[1]["journal"][0]["event"] == "cleared"


def test_a_device_is_put_into_maintenance_with_a_reason_and_its_values_are_bad(plant: WatchedCollector) -> None:
    path = "/api/devices/boiler/maintenance"
    assert post(plant, path, {"on": True, "reason": ""})[0] == 422
    assert post(plant, path, {"on": True, "reason": "x"}, "view")[0] == 403
    assert post(plant, "/api/devices/missing/maintenance", {"on": True, "reason": "x"})[0] == 404
    status, answer = post(plant, path, {"on": True, "reason": "new sensor"})
    assert (status, answer["on"], answer["reason"]) == (200, True, "new sensor")
    assert plant.ask("/api/maintenance")[1] == [answer]

    def reasons() -> set[str]:
        points, values = plant.ask("/api/points")[1]["points"], plant.ask("/api/values")[1]
        return {why for point, why in zip(points, values["reason"], strict=True) if point["device"] == "boiler"}

    wait_until(lambda: reasons() == {"maintenance"})
    assert post(plant, path, {"on": False, "reason": "done"})[1]["on"] is False
    wait_until(lambda: reasons() == {""})
