"""What a test needs of the machine and is not there: the test is skipped, and says what, or it fails (`missing`)."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import NoReturn

import pytest


def missing(reason: str) -> NoReturn:
    """Skip the test for a reason; fail it where ``BUSWAY_REQUIRE_PEERS=1``."""
    if os.environ.get("BUSWAY_REQUIRE_PEERS") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


def installed(name: str, *places: str) -> str | None:
    """The path of a program, also looked for where servers are and in these folders; None if it is not installed."""
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", *places]))


def needed(name: str, *places: str) -> str:
    """The path of a program as of `installed`; `missing` if it is not installed."""
    return installed(name, *places) or missing(f"{name} is not installed")


def preloadable(source: Path, folder: Path) -> Path:
    """A file in C, compiled into a folder as a library for ``LD_PRELOAD``."""
    made = folder / f"{source.stem}.so"
    subprocess.run([needed("gcc"), "-shared", "-fPIC", "-O1", "-o", made, source, "-ldl"], check=True, timeout=60)
    return made
