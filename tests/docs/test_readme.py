"""The README: its example runs, its table is that of the pages, and it fits one screen."""

from collections.abc import Callable
from pathlib import Path

import pytest
from generated import assert_up_to_date

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
WORDS, LINES = 480, 60


def test_the_example_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    assert "busway.connect(" in README.read_text(encoding="utf-8")
    run_page(README)


def test_it_fits_one_screen() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) <= WORDS
    assert len(text.splitlines()) <= LINES


@pytest.mark.parametrize("script", ["function_table.py", "comparison_table.py"])
def test_generated_tables_are_up_to_date(script: str) -> None:
    assert_up_to_date(script)


def test_the_two_commands_and_the_limits_are_named() -> None:
    text = README.read_text(encoding="utf-8")
    assert "make demo" in text
    assert "make test" in text
    assert "never run" in text
