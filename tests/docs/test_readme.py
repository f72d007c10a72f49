"""The README: its examples run, its table is that of the code, and it fits a screen or two."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"


def test_the_server_the_blocking_and_the_asyncio_example_run_against_each_other(
    run_page: Callable[[Path], None],
) -> None:
    text = README.read_text(encoding="utf-8")
    assert "busway.serve_forever(" in text
    assert "busway.connect(" in text
    assert "busway.open(" in text
    run_page(README)


def test_the_function_table_is_that_of_the_declarations() -> None:
    done = subprocess.run(
        [sys.executable, "scripts/function_table.py", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_two_commands_and_the_limits_are_named() -> None:
    text = README.read_text(encoding="utf-8")
    assert "make demo" in text
    assert "make test" in text
    assert "not there yet" in text
