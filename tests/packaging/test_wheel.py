"""What is published is built from the checkout, holds what it must and nothing else, and works where it is installed.

The environment into which the wheel goes is made for the test and sees neither the checkout nor the development tools.
"""

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
LIMIT = 300.0
"""Seconds for one step; pip may have to fetch the dependencies."""

pytestmark = [pytest.mark.packaging, pytest.mark.timeout(3 * LIMIT)]

ROUND_TRIP = """
import busway

with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)}) as server:
    with busway.connect(server.endpoints[0]) as link:
        link.unit(1).write_single_register(3, 7)
        print(link.unit(1).read_holding_registers(3, count=1))
"""


@dataclass(frozen=True, slots=True)
class Distribution:
    """The two files that a release consists of."""

    wheel: Path
    sdist: Path


def run(*command: str | Path, folder: Path) -> str:
    """What a command prints; a failure shows its whole output."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    finished = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert finished.returncode == 0, f"{command}\n{finished.stdout}\n{finished.stderr}"
    return finished.stdout


@pytest.fixture(scope="module")
def distribution(tmp_path_factory: pytest.TempPathFactory) -> Distribution:
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, CHECKOUT, folder=folder)
    (wheel,) = folder.glob("*.whl")
    (sdist,) = folder.glob("*.tar.gz")
    return Distribution(wheel, sdist)


@pytest.fixture(scope="module")
def installed(distribution: Distribution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment that holds the wheel and nothing else."""
    return environment(tmp_path_factory.mktemp("environment"), f"{distribution.wheel}")


@pytest.fixture(scope="module")
def installed_with_commands(distribution: Distribution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with what the commands need."""
    return environment(tmp_path_factory.mktemp("commands"), f"{distribution.wheel}[cli]")


def environment(folder: Path, wanted: str) -> Path:
    """The folder of programs of a new environment with one requirement and what it declares to need."""
    venv.create(folder, with_pip=True)
    programs = folder / ("Scripts" if sys.platform == "win32" else "bin")
    run(programs / "python", "-m", "pip", "--disable-pip-version-check", "install", wanted, folder=folder)
    return programs


def test_the_wheel_holds_the_package_its_types_and_the_licence_and_nothing_else(distribution: Distribution) -> None:
    with zipfile.ZipFile(distribution.wheel) as wheel:
        names = wheel.namelist()
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        description = wheel.read(metadata).decode()
    assert "busway/py.typed" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"busway"}
    assert not [name for name in names if "test_" in name or name.endswith((".pyc", ".c"))]
    sources = {path.relative_to(CHECKOUT / "src").as_posix() for path in (CHECKOUT / "src" / "busway").rglob("*.py")}
    assert sources <= set(names)
    assert "License-Expression: Apache-2.0" in description
    assert "Requires-Python: >=3.11" in description


def test_the_source_distribution_holds_what_its_own_tests_need(distribution: Distribution) -> None:
    with tarfile.open(distribution.sdist) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    for needed in ("pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "Makefile", "scripts/find-python"):
        assert needed in names
    assert "src/busway/__init__.py" in names
    assert "tests/test_core_is_pure.py" in names
    assert not [name for name in names if name.startswith((".venv", ".peers", "dist/"))]


def test_the_installed_command_tells_its_version(installed_with_commands: Path, tmp_path: Path) -> None:
    python = installed_with_commands / "python"
    version = run(python, "-c", "import busway; print(busway.__version__)", folder=tmp_path).strip()
    assert version in run(installed_with_commands / "busway", "--version", folder=tmp_path)


def test_the_bare_installation_brings_no_other_package(installed: Path, tmp_path: Path) -> None:
    code = (
        "from importlib.metadata import distributions\n"
        "print(sorted({one.name for one in distributions()} - {'pip', 'setuptools'}))"
    )
    assert run(installed / "python", "-c", code, folder=tmp_path) == "['busway']\n"


def test_the_bare_command_names_the_extra_that_it_needs(installed: Path, tmp_path: Path) -> None:
    ended = subprocess.run(
        [installed / "busway", "read", "tcp://127.0.0.1", "4x1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr == "busway: this command needs the package typer: pip install 'busway[cli]'\n"


def test_the_installed_library_is_found_by_type_checkers(installed: Path, tmp_path: Path) -> None:
    code = "import busway, pathlib; print(pathlib.Path(busway.__file__).with_name('py.typed').is_file())"
    assert run(installed / "python", "-c", code, folder=tmp_path) == "True\n"


def test_the_installed_library_serves_and_is_read_with_warnings_as_errors(installed: Path, tmp_path: Path) -> None:
    assert run(installed / "python", "-W", "error", "-c", ROUND_TRIP, folder=tmp_path) == "[7]\n"
