"""The type checker that is no mypy: basedpyright, or pyright where that is installed."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest


def pyright() -> str:
    """The program; the test is left out where neither basedpyright nor pyright is installed."""
    beside = Path(sys.executable).parent
    program = next((found for name in ("basedpyright", "pyright") if (found := shutil.which(name, path=beside))), None)
    if program is None:
        pytest.skip("neither basedpyright nor pyright is installed")
    return program


def errors_of_pyright(files: list[Path], *, cwd: Path) -> list[dict[str, Any]]:
    """What pyright calls an error in these files, each as its JSON has it."""
    words = [pyright(), "--outputjson", "--level", "error", "--pythonpath", sys.executable, *map(str, files)]
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False, timeout=110)
    told: list[dict[str, Any]] = json.loads(done.stdout)["generalDiagnostics"]
    return [one for one in told if one["severity"] == "error"]
