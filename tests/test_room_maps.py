"""Each room with more than five files has a map: the docstring of its package names every file, one line each.

Below it, "Where it is decided" says which file of the room decides what.
"""

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


@pytest.mark.parametrize("room", ROOMS)
def test_the_map_of_a_room_says_which_of_its_files_decides_what(room: str) -> None:
    docstring = ast.get_docstring(ast.parse((SOURCES / room / "__init__.py").read_text(encoding="utf-8"))) or ""
    _, found, text = docstring.partition("\n\nWhere it is decided: ")
    assert found, f"{room}/__init__.py does not say where what is decided"
    decisions = text.partition("\n\n")[0]
    files = set(re.findall(r"(?<!`)`([a-z]\w*)`(?!`)", decisions))
    assert files
    assert files <= files_of(SOURCES / room)
    for other in re.findall(r"`busway\.([a-z_.]+)`", decisions):
        path = SOURCES.joinpath(*other.split("."))
        assert path.is_dir() or path.with_suffix(".py").is_file(), other


def test_rooms_were_found() -> None:
    assert {"server", "session", "apps/gateway", "transport/serial"} <= set(ROOMS)
