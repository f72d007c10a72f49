"""docs/performance.md says what the run says that it names."""

import json
from pathlib import Path

import performance_page
from generated import assert_up_to_date

ROOT = Path(__file__).parents[2]
NEEDED = ("server", "client", "gateway", "layers")
RUN = {
    "date": "2026-01-02T03:04:05+0000",
    "took_seconds": 480.2,
    "shortened": False,
    "machine": {"cpu": "a processor", "load_average": 0.1},
    "tables": {
        "server": {
            "title": "Servers",
            "columns": ["", "per second"],
            "rows": [["16 x 16  busway", "500,000"], ["a | b", "–"]],
            "figures": [],
            "bars": [
                {"what": "rate", "value": 4.0, "relation": ">=", "limit": 5, "unit": "x", "verdict": "missed"},
                {"what": "CPU", "value": None, "relation": "<=", "limit": 60, "unit": "%", "verdict": "not measured"},
            ],
            "notes": ["a note"],
        }
    },
}


def test_page_is_what_the_generator_makes_of_the_run_that_is_kept() -> None:
    assert_up_to_date("performance_page.py")


def test_page_names_the_run_and_the_machine() -> None:
    text = performance_page.machine(RUN)
    assert "2026-01-02T03:04:05+0000" in text
    assert "| load average | 0.1 |" in text


def test_goal_that_is_missed_or_was_not_measured_stands_in_the_table() -> None:
    lines = performance_page.goals(RUN).splitlines()
    assert lines[2:] == [
        "| server | rate | 4.00 x | – | ≥ 5.00 x | **missed** |",
        "| server | CPU | – | – | ≤ 60.0 % | not measured |",
    ]


def test_goals_show_how_far_apart_other_runs_are() -> None:
    others = [{"goals": {"server: rate": 3.5}}, {"goals": {"server: rate": 5.25, "server: CPU": None}}]
    lines = performance_page.goals(RUN | {"others": others}).splitlines()
    assert "in 2 other runs" in lines[0]
    assert lines[2:] == [
        "| server | rate | 4.00 x | 3.50 … 5.25 | ≥ 5.00 x | **missed** |",
        "| server | CPU | – | – | ≤ 60.0 % | not measured |",
    ]


def test_tables_keep_their_rows_and_notes_and_cells_do_not_break_them() -> None:
    text = performance_page.tables(RUN)
    assert "### Servers" in text
    assert "| 16 x 16 busway | 500,000 |" in text
    assert "| a \\| b | – |" in text
    assert "a note" in text


def test_run_that_was_cut_short_or_lacks_tables_is_not_kept() -> None:
    full = RUN | {"tables": {name: {} for name in NEEDED}}
    assert performance_page.is_full(full)
    assert not performance_page.is_full(full | {"shortened": True})
    assert not performance_page.is_full(RUN)


def test_run_that_is_kept_names_no_place_of_a_machine() -> None:
    if performance_page.KEPT.exists():
        kept = performance_page.KEPT.read_text(encoding="utf-8")
        assert json.loads(kept)["shortened"] is False
        assert str(ROOT) not in kept
