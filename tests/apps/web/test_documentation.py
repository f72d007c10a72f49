"""What the pages on the simulator and on the collector's page say of their APIs is what there is."""

import re
from pathlib import Path
from typing import Any

import pytest
from page_collector import watched_collector
from page_plant import watched

from busway.apps.web.connections import SEND_SECONDS
from busway.apps.web.hosting import SHORTEST_TOKEN
from busway.apps.web.request_guard import BODY_LIMIT
from busway.apps.web.simulation_stream import FRAMES_AT_ONCE, MOST_POINTS

DOCS = Path(__file__).parents[3] / "docs"
GUIDE = DOCS / "simulator.md"


@pytest.fixture(scope="module")
def section():
    text = GUIDE.read_text(encoding="utf-8")
    return text.partition("## The control API and the page\n")[2].partition("\n## ")[0]


def resources_in(text: str) -> list[tuple[str, str]]:
    return re.findall(r"^\| `([A-Z]+ /api\S*)` \| (.+) \|$", text, re.MULTILINE)


def resources_of(document: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        (f"{method.upper()} {path}", one["summary"][0].lower() + one["summary"][1:])
        for path, methods in document["paths"].items()
        for method, one in methods.items()
    ]


def test_the_table_has_every_resource_and_no_other(section):
    with watched() as plant:
        document = plant.ask("GET", "/openapi.json")[1]
    assert resources_in(section) == resources_of(document)


def test_the_table_of_the_collectors_page_has_every_resource_and_no_other(tmp_path):
    page = (DOCS / "how-to" / "watch-a-plant.md").read_text(encoding="utf-8")
    with watched_collector(tmp_path) as plant:
        assert resources_in(page) == resources_of(plant.ask("/openapi.json")[1])


def test_the_limits_are_those_of_the_code(section):
    assert f"{BODY_LIMIT // 1024 // 1024} MiB" in section
    assert f"at least {SHORTEST_TOKEN} characters" in section
    assert f"up to {MOST_POINTS}" in section
    assert f"at most {FRAMES_AT_ONCE} a message" in section
    assert f"for {SEND_SECONDS:g} s is closed" in section
