"""The architecture page names files and functions that exist, and parts that are those of the package."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "src" / "busway"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
STEPS = re.findall(r"^\| \d+ \| `([\w/.]+)` \| `([\w.]+)` \|", PAGE, re.MULTILINE)


def defined_in(file: Path) -> set[str]:
    """The functions and classes of a file, methods as ``Class.method``."""
    found = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
                    found.add(f"{node.name}.{inner.name}")
    return found


def test_the_journeys_have_steps() -> None:
    assert len(STEPS) > 25


@pytest.mark.parametrize(("file", "function"), STEPS, ids=lambda text: text)
def test_each_step_of_a_journey_names_a_function_that_is_there(file: str, function: str) -> None:
    assert function in defined_in(SOURCES / file)


def test_every_file_that_is_named_is_there() -> None:
    named = set(re.findall(r"`((?:\w+/)+\w+\.py)`", PAGE))
    assert [name for name in named if not (SOURCES / name).exists() and not (ROOT / name).exists()] == []


def test_every_part_of_the_package_is_named() -> None:
    parts = {one.stem for one in SOURCES.iterdir() if not one.name.startswith("_") and one.suffix in ("", ".py")}
    parts -= {"version", "py"}
    assert [part for part in parts if not re.search(rf"\b{part}\b", PAGE)] == []


@pytest.mark.parametrize(
    "name",
    [
        "AsyncLinkDriver._on_timer",
        "AsyncLinkDriver.lost",
        "TcpClientSession.tick",
        "CallTracker.failed",
        "TcpClientSession.disconnected",
        "TcpServerSession._finish",
        "ServerConnection.pause_writing",
    ],
)
def test_methods_named_in_sentences_are_there(name: str) -> None:
    assert f"`{name}`" in PAGE
    assert any(name in defined_in(file) for file in SOURCES.rglob("*.py"))
