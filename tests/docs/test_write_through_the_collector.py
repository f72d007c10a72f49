"""The tables of the page about commands make what receives commands."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from busway.apps.collector.commands.input_options import make_input
from busway.apps.collector.sinks.options import make_sink
from busway.config.files.sinks import SentSection, sink_section

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "write-through-the-collector.md").read_text("utf-8")
TABLES = [
    table
    for block in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    for table in tomllib.loads(block).get("sink", [])
]


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["name"])
def test_each_table_takes_commands(table: dict[str, Any]) -> None:
    for package in ("aiomqtt", "nats", "google.protobuf"):
        pytest.importorskip(package)
    section = sink_section(table)
    assert isinstance(section, SentSection)
    assert make_sink(section)
    made = make_input(section)
    assert made is not None
    usual = "{device}/{point}"  # of Sparkplug, whose topics are given
    assert made.rights.where == table["commands"].get("topic", table["commands"].get("subject", usual))
    assert "heater/setpoint" in made.rights.points
