"""The README: its example runs, its table is that of the pages, and it fits one screen."""

import runpy
from collections.abc import Callable
from pathlib import Path

import pytest
from generated import assert_up_to_date

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
WORDS, LINES = 440, 60


def test_the_example_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    assert "busway.connect(" in README.read_text(encoding="utf-8")
    run_page(README)


def test_it_fits_one_screen() -> None:
    text = README.read_text(encoding="utf-8")
    assert len([word for word in text.split() if word not in ("|", "–")]) <= WORDS
    assert len(text.splitlines()) <= LINES


@pytest.mark.parametrize("script", ["function_table.py", "comparison_table.py"])
def test_generated_tables_are_up_to_date(script: str) -> None:
    assert_up_to_date(script)


def test_the_two_commands_and_the_limits_are_named() -> None:
    text = README.read_text(encoding="utf-8")
    assert "make demo" in text
    assert "make test" in text
    assert "never run" in text


def test_the_pictures_of_readme_and_start_page_are_there_and_small() -> None:
    names = runpy.run_path(str(ROOT / "scripts" / "screenshots.py"))["PICTURES"]
    sizes = {name: (ROOT / "docs" / "figures" / name).stat().st_size for name in names}
    assert all(0 < size < 100_000 for size in sizes.values()), sizes
    pages = [README, ROOT / "docs" / "index.md", ROOT / "docs" / "simulator.md"]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert [name for name in names if f"figures/{name})" not in shown] == []


@pytest.mark.soak
def test_the_pictures_are_made_anew(tmp_path: Path) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "screenshots.py"))
    script["main"](tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(script["PICTURES"])
