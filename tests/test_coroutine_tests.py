"""The mechanism of ``conftest.py``: coroutine tests run in a loop, with their fixtures, and may not leave tasks behind.

Each case is a small test file that a pytest of its own runs, so that its failure can be looked at.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name("conftest.py").read_text(encoding="utf-8")


def outcome_of(folder: Path, source: str, limit: float = 60.0) -> str:
    """What pytest prints about a test file."""
    folder.joinpath("conftest.py").write_text(CONFTEST.replace("LIMIT = 100.0", f"LIMIT = {limit}"), encoding="utf-8")
    folder.joinpath("test_it.py").write_text(source, encoding="utf-8")
    finished = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:asyncio",
            "-o",
            "addopts=",
            "test_it.py",
        ],
        cwd=folder,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")},
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
    )
    return finished.stdout


@pytest.mark.parametrize(
    ("source", "limit", "said"),
    [
        pytest.param(
            "async def test_it(tmp_path):\n    assert tmp_path.exists()\n", 60.0, "1 passed", id="passes with fixtures"
        ),
        pytest.param("async def test_it():\n    assert 1 == 2\n", 60.0, "assert 1 == 2", id="a failed assertion fails"),
        pytest.param(
            "import asyncio\nasync def test_it():\n    await asyncio.Event().wait()\n",
            0.05,
            "TimeoutError",
            id="a hang fails",
        ),
        pytest.param(
            "import asyncio\nasync def test_it():\n    global task\n"
            "    task = asyncio.ensure_future(asyncio.Event().wait())\n",
            60.0,
            "left tasks behind",
            id="a task left behind fails",
        ),
        pytest.param(
            "import asyncio\nasync def test_it():\n    global task\n"
            "    task = asyncio.ensure_future(asyncio.Event().wait())\n    task.cancel()\n",
            60.0,
            "1 passed",
            id="a task just cancelled has its turn to end",
        ),
    ],
)
def test_coroutine_test(tmp_path: Path, source: str, limit: float, said: str) -> None:
    assert said in outcome_of(tmp_path, source, limit)
