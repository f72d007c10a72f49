"""The core sees no clock, socket, file, environment, logging, thread or event loop.

It takes bytes or values plus ``now``, and returns bytes, values or events. Which way imports point is held by the
contracts of import-linter in ``pyproject.toml`` (``make check``).
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = "busway"
SOURCES = Path(__file__).parents[1] / "src" / PACKAGE
CORE = ("codes", "errors", "log_limiter", "pdu", "points", "values", "framing", "session", "options")

PURE_MODULES = {
    "__future__",
    "abc",
    "ast",
    "array",
    "binascii",
    "bisect",
    "collections",
    "contextlib",
    "copy",
    "dataclasses",
    "difflib",
    "enum",
    "fnmatch",
    "fractions",
    "decimal",
    "functools",
    "heapq",
    "ipaddress",
    "itertools",
    "keyword",
    "math",
    "operator",
    "re",
    "string",
    "struct",
    "types",
    "typing",
    "urllib",
    "weakref",
}
"""What the core may take from the standard library: nothing in it waits, looks outside, or differs from run to run."""

IMPURE_CALLS = {"open", "print", "input", "__import__", "breakpoint"}


def core_files() -> Iterator[Path]:
    """The files of the core."""
    for part in CORE:
        place = SOURCES / part
        yield from place.rglob("*.py") if place.is_dir() else [place.with_suffix(".py")]


def offences(source: str) -> list[str]:
    """What a file of the core imports or calls although it must not, one sentence each."""
    found = []
    for node in ast.walk(ast.parse(source)):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            modules = [node.module or ""]
        found += [f"line {node.lineno} imports {name}" for name in modules if name.split(".")[0] not in PURE_MODULES]  # type: ignore[attr-defined]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in IMPURE_CALLS:
            found.append(f"line {node.lineno} calls {node.func.id}")
    return found


@pytest.mark.parametrize("file", sorted(core_files()), ids=lambda file: str(file.relative_to(SOURCES)))
def test_file_of_the_core_is_pure(file: Path) -> None:
    assert offences(file.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "import time",
        "from asyncio import Future",
        "import os.path",
        "import numpy",
        "def f():\n    import logging",
        "print(1)",
        "open('x')",
    ],
)
def test_an_offending_file_is_found(source: str) -> None:
    assert offences(source)


@pytest.mark.parametrize(
    "source", ["from .bits import ReadCoils", "import struct", "class Link:\n    def open(self): ..."]
)
def test_a_file_within_the_rules_passes(source: str) -> None:
    assert offences(source) == []
