"""What the page on the simulator says of the API is what there is."""

import re
from pathlib import Path

import pytest
from page_plant import watched

from busway.apps.web.access import BODY_LIMIT
from busway.apps.web.hosting import SHORTEST_TOKEN
from busway.apps.web.stream import FRAMES_AT_ONCE, MOST_POINTS, SEND_SECONDS

GUIDE = Path(__file__).parents[3] / "docs" / "simulator.md"


@pytest.fixture(scope="module")
def section():
    text = GUIDE.read_text(encoding="utf-8")
    return text.partition("## The control API and the page\n")[2].partition("\n## ")[0]


def test_the_table_has_every_resource_and_no_other(section):
    rows = re.findall(r"^\| `([A-Z]+ /api\S*)` \| (.+) \|$", section, re.MULTILINE)
    with watched() as plant:
        paths = plant.ask("GET", "/openapi.json")[1]["paths"]
    declared = [
        (f"{method.upper()} {path}", one["summary"][0].lower() + one["summary"][1:])
        for path, methods in paths.items()
        for method, one in methods.items()
    ]
    assert rows == declared


def test_the_limits_are_those_of_the_code(section):
    assert f"{BODY_LIMIT // 1024 // 1024} MiB" in section
    assert f"at least {SHORTEST_TOKEN} characters" in section
    assert f"up to {MOST_POINTS}" in section
    assert f"at most {FRAMES_AT_ONCE} a message" in section
    assert f"for {SEND_SECONDS:g} s is closed" in section
