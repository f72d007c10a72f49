"""Each room with more than five files has a map: the docstring of its package names every file, one line each."""

import ast
import re
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[1] / "src" / "busway"
FEW = 5
"""Rooms of so many files need no map."""


def files_of(room: Path) -> set[str]:
    """The names of the modules and folders in a room."""
    modules = {file.stem for file in room.glob("*.py")} - {"__init__"}
    return modules | {folder.name for folder in room.iterdir() if folder.is_dir()} - {"__pycache__"}


ROOMS = [
    package.parent.relative_to(SOURCES).as_posix()
    for package in sorted(SOURCES.glob("*/**/__init__.py"))
    if len(list(package.parent.glob("*.py"))) - 1 > FEW
]


def map_of(room: str) -> list[str]:
    """The names at the beginning of the lines of a room's map."""
    docstring = ast.get_docstring(ast.parse((SOURCES / room / "__init__.py").read_text(encoding="utf-8"))) or ""
    table = re.search(r"^=+  =+\n(.*?)^=+  =+$", docstring, re.MULTILINE | re.DOTALL)
    assert table is not None, f"{room}/__init__.py has no map"
    return [name for line in table[1].splitlines() for name in re.findall(r"`(\w+)`,?", line.partition("  ")[0])]


@pytest.mark.parametrize("room", ROOMS)
def test_the_map_of_a_room_names_every_file_once_and_nothing_else(room: str) -> None:
    named = map_of(room)
    assert sorted(named) == sorted(files_of(SOURCES / room))


def test_rooms_were_found() -> None:
    assert {"server", "session", "apps/gateway", "transport/serial"} <= set(ROOMS)
