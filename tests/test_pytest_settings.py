"""What the settings of pytest and ``conftest.py`` promise of failures and hangs, tried by a pytest of its own.

1. A test that fails fails the run: none is repeated, in real time or not.
2. A test that hangs fails by name.
3. A file that makes a line in real time has the mark ``real_time`` or ``alone``.
4. Where a foreign program is not installed, its tests are skipped by its name, and fail where peers are required.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from foreign_servers import needed

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
        pytest.param("", "test_it.py", id="unit test"),
        pytest.param("@pytest.mark.real_time", "test_it.py", id="real time by its own mark"),
        pytest.param("", "load/test_it.py", id="real time by its folder"),
    ],
)
def test_failed_test_is_not_repeated(tmp_path: Path, mark: str, name: str) -> None:
    status, output = outcome_of(tmp_path, FAILS_AT_FIRST.format(mark=mark), name=name)
    assert status == 1
    assert "1 failed" in output
    assert "the machine paused" in output
    assert "RERUN" not in output


def test_test_that_hangs_fails_by_name(tmp_path: Path) -> None:
    status, output = outcome_of(tmp_path, HANGS, "--timeout=0.5")
    assert status == 1
    assert "FAILED test_it.py::test_it - Failed: Timeout (>0.5s) from pytest-timeout." in output


def test_every_file_that_makes_a_line_in_real_time_has_the_mark_or_is_in_a_folder_that_has() -> None:
    for file in TESTS.rglob("test_*.py"):
        text = file.read_text(encoding="utf-8")
        if "import PacedLine" in text:
            relative = file.relative_to(TESTS).as_posix()
            assert (
                "pytest.mark.real_time" in text or "pytest.mark.alone" in text or relative.startswith("interop/serial/")
            ), relative


@pytest.mark.parametrize(("required", "outcome"), [(None, pytest.skip.Exception), ("1", pytest.fail.Exception)])
def test_a_foreign_program_that_is_not_there_is_named(
    monkeypatch: pytest.MonkeyPatch, required: str | None, outcome: type[BaseException]
) -> None:
    monkeypatch.delenv("BUSWAY_REQUIRE_PEERS", raising=False)
    if required is not None:
        monkeypatch.setenv("BUSWAY_REQUIRE_PEERS", required)
    with pytest.raises(outcome, match=r"^no-such-server is not installed$"):
        needed("no-such-server")
    assert Path(needed("sh")).is_file()
