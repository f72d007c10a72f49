"""Targets of the Makefile that users run: what they install, seen without installing it."""

import os
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def commands_of(target: str, environment: Path) -> str:
    """What make would run for a target in a checkout with this virtual environment."""
    (environment / "bin").mkdir(parents=True)
    (environment / "bin" / "python").touch()
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        ["make", "--dry-run", target, f"VENV={environment}"],
        cwd=ROOT,
        env=plain,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return done.stdout


def test_what_runs_on_one_python_is_there_and_the_others_leave_nothing_else_out(tmp_path: Path) -> None:
    *_, others = commands_of("test-unit-quietly", tmp_path / "venv").splitlines()
    left_out = re.findall(r"--ignore=(\S+)", others)
    assert len(left_out) > 30
    assert [path for path in left_out if not (ROOT / path).exists()] == []
    assert "tests/client" not in left_out


def test_the_demo_has_what_its_page_and_its_store_need_also_where_something_was_installed_before(
    tmp_path: Path,
) -> None:
    (tmp_path / "venv").mkdir()
    (tmp_path / "venv" / ".installed").touch()  # of a checkout whose demo had no page
    commands = commands_of("demo", tmp_path / "venv")
    found = re.search(r"--editable '\.\[([a-z,]+)\]'", commands)
    assert found is not None, commands
    assert {"cli", "files", "serial", "store", "web"} <= set(found[1].split(","))
    assert "busway collect demo" in commands.splitlines()[-1]
