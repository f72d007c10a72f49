"""Which report rule holds for a point: the first that says it, in the store and towards sinks."""

from pathlib import Path

import pytest

from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.collector.report_rules import sink_rules, store_rules
from busway.config.files.file_error import FileError
from busway.points import ReportRule

PROFILE = """
[[unit]]
point = [
    { name = "own", address = "4x1", store_report = { when = "change", deadband = 4 }, report = "change" },
    { name = "all", address = "4x2", store_report = "every" },
    { name = "slow", address = "4x3", poll_class = "slow" },
    { name = "usual", address = "4x4" },
    { name = "sum", formula = "own + all" },
]
"""
PLANT = """
[collector]
{collector}
[poll_class]
fast = {{ period = 1.0 {fast} }}
slow = {{ period = 9.0 {slow} }}
[[link]]
name = "hall"
url = "tcp://127.0.0.1"
[[device]]
name = "pump"
link = "hall"
profile = "pump.toml"
poll_class = "fast"
{device}
[[sink]]
name = "lines"
url = "file://lines.jsonl"
{sink}
"""


def change(deadband: float) -> str:
    return f'store_report = {{ when = "change", deadband = {deadband} }}'


def configured(folder: Path, **given: str) -> CollectorConfiguration:
    (folder / "pump.toml").write_text(PROFILE)
    keys = {key: given.get(key, "") for key in ("collector", "fast", "slow", "device", "sink")}
    return parse_collector(PLANT.format(**keys), str(folder / "plant.toml"))


def bands(configuration: CollectorConfiguration) -> dict[str, float]:
    return {point: rule.deadband for (_, point), rule in store_rules(configuration).items()}


def test_the_point_the_device_the_class_the_collector_say_what_is_kept_in_this_order(tmp_path: Path) -> None:
    collector, slow, device = change(1), f", {change(2)}", change(3)
    assert bands(configured(tmp_path)) == {"own": 4}
    assert bands(configured(tmp_path, collector=collector)) == {"own": 4, "slow": 1, "usual": 1, "sum": 1}
    found = configured(tmp_path, collector=collector, slow=slow, fast=', store_report = "every"')
    assert bands(found) == {"own": 4, "slow": 2}
    found = configured(tmp_path, collector=collector, slow=slow, device=device)
    assert bands(found) == {"own": 4, "slow": 3, "usual": 3, "sum": 3}
    assert store_rules(found, "pump") == store_rules(found)
    assert store_rules(found, "other") == {}


def test_the_rule_of_a_sink_is_its_own_also_where_it_says_every(tmp_path: Path) -> None:
    assert configured(tmp_path).sinks["lines"][1].report is None
    assert configured(tmp_path, sink='report = "every"').sinks["lines"][1].report == ReportRule()
    found = configured(tmp_path, sink='report = { when = "change", deadband = "2 %", max_silence = 60 }')
    assert found.sinks["lines"][1].report == ReportRule("change", None, 2.0, True, 60.0)
    assert sink_rules(found) == {("pump", "own"): ReportRule("change")}


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"sink": 'report = "sometimes"'}, "report"),
        ({"sink": 'report = { when = "change_or_period" }'}, "period: is missing"),
        ({"device": 'store_report = { when = "every", deadband = 1 }'}, "has no effect where every sample"),
        ({"collector": 'store_report = { when = "change", max_silence = 0 }'}, "max_silence"),
    ],
)
def test_a_rule_that_cannot_be_is_refused_with_line_and_key(
    tmp_path: Path, given: dict[str, str], sentence: str
) -> None:
    with pytest.raises(FileError, match=sentence):
        configured(tmp_path, **given)
