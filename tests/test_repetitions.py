"""What the settings of pytest and ``conftest.py`` promise of repetitions and hangs, tried by a pytest of its own.

1. A test that depends on real time is repeated once and then named; no other test is repeated.
2. A test that hangs fails by name, and is not repeated either.
3. Whoever makes a line in real time has the mark.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
FAILS_AT_FIRST = """
import pathlib
import pytest

{mark}
def test_it(pytestconfig):
    been_here = pathlib.Path(__file__).with_name("been here")
    if not been_here.exists():
        been_here.touch()
        raise RuntimeError("the machine paused")
"""
HANGS = """
import threading
import pytest

@pytest.mark.real_time
def test_it():
    threading.Event().wait()
"""


def outcome_of(folder: Path, source: str, *options: str, name: str = "test_it.py") -> tuple[int, str]:
    """Exit status and output of pytest, with the settings of this project, for a test file."""
    folder.joinpath("conftest.py").write_bytes(TESTS.joinpath("conftest.py").read_bytes())
    folder.joinpath("pyproject.toml").write_bytes(TESTS.with_name("pyproject.toml").read_bytes())
    file = folder / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(source, encoding="utf-8")
    finished = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options, str(file)],
        cwd=folder,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return finished.returncode, finished.stdout


@pytest.mark.parametrize(
    ("mark", "name"),
    [
        pytest.param("@pytest.mark.real_time", "test_it.py", id="by its own mark"),
        pytest.param("", "load/test_it.py", id="by its folder"),
    ],
)
def test_failed_test_in_real_time_is_repeated_and_named_with_its_failure(tmp_path: Path, mark: str, name: str) -> None:
    status, said = outcome_of(tmp_path, FAILS_AT_FIRST.format(mark=mark), name=name)
    assert status == 0
    assert "1 passed, 1 rerun" in said
    assert f"RERUN {name}::test_it" in said
    assert "the machine paused" in said


def test_test_without_the_mark_is_not_repeated(tmp_path: Path) -> None:
    status, said = outcome_of(tmp_path, FAILS_AT_FIRST.format(mark=""))
    assert (status, "1 failed" in said, "RERUN" in said) == (1, True, False)


def test_test_that_hangs_fails_by_name_and_is_not_repeated(tmp_path: Path) -> None:
    status, said = outcome_of(tmp_path, HANGS, "--timeout=0.5")
    assert status == 1
    assert "FAILED test_it.py::test_it - Failed: Timeout (>0.5s) from pytest-timeout." in said
    assert "RERUN" not in said


def test_every_file_that_makes_a_line_in_real_time_has_the_mark_or_is_in_a_folder_that_has() -> None:
    for file in TESTS.rglob("test_*.py"):
        text = file.read_text(encoding="utf-8")
        if "import PacedLine" in text:
            relative = file.relative_to(TESTS).as_posix()
            assert "pytest.mark.real_time" in text or relative.startswith("interop/serial/"), relative
