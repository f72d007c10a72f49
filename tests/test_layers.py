"""Imports point down only, and the core is pure.

The parts of the package stand in layers (`docs/architecture.md`). A part may import from its own layer and from those
below it, whether at the top of a file, inside a function or for typing only. Layers 0 to 3 are the core: they see no
clock, socket, file, environment, logging, thread or event loop, and nothing that is not of the standard library.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = "busway"
SOURCES = Path(__file__).parents[1] / "src" / PACKAGE

LAYER_OF = {
    "codes": 0,
    "errors": 0,
    "version": 0,
    "pdu": 1,
    "values": 1,
    "framing": 2,
    "session": 3,
    "interpreter": 4,
    "transport": 4,
    "config": 4,
    "client": 5,
    "server": 5,
    "observe": 5,
    "assembly": 6,
    "control": 6,
    "gateway": 6,
    "simulator": 6,
    "testing": 6,
    "web": 6,
    "cli": 7,
    "__main__": 7,
}
HIGHEST_CORE_LAYER = 3
FRONT_LAYER = 6.5
"""``busway`` itself, which gathers the public names: only the command line stands above it."""

STRANGERS = {("client", "server"), ("server", "client")}
"""Parts of one layer that must not know each other."""

PURE_MODULES = {
    "__future__",
    "abc",
    "array",
    "binascii",
    "bisect",
    "collections",
    "contextlib",
    "copy",
    "dataclasses",
    "enum",
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
    "weakref",
}
"""What the core may take from the standard library: nothing in it waits, looks outside, or differs from run to run."""

IMPURE_CALLS = {"open", "print", "input", "__import__", "breakpoint"}


@dataclass(frozen=True, slots=True)
class Import:
    """One imported module, by its absolute dotted name."""

    module: str
    line: int


def imports_of(source: str, module: str, *, is_package: bool) -> Iterator[Import]:
    """Every import in a file, wherever it stands; ``module`` is the file's own dotted name."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno)
        elif isinstance(node, ast.ImportFrom):
            base = _base_of(node, module, is_package=is_package)
            if base == PACKAGE:  # the names are parts of the package, or public names of its front
                for alias in node.names:
                    yield Import(f"{base}.{alias.name}" if alias.name in LAYER_OF else base, node.lineno)
            else:
                yield Import(base, node.lineno)


def _base_of(node: ast.ImportFrom, module: str, *, is_package: bool) -> str:
    if node.level == 0:
        return node.module or ""
    parents = module.split(".")
    up = node.level - 1 if is_package else node.level
    kept = parents[: len(parents) - up]
    return ".".join([*kept, node.module] if node.module else kept)


def part_of(module: str) -> str:
    """The part that a module of the package belongs to; empty for the package's front."""
    return module.split(".")[1] if "." in module else ""


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """What a file does against the rules, one sentence each."""
    part = part_of(module)
    if part == "":
        return []  # the front gathers the public names, from wherever they are
    if part not in LAYER_OF:
        return [f"{module}: the part {part} stands in no layer"]
    layer = LAYER_OF[part]
    found = []
    for each in imports_of(source, module, is_package=is_package):
        if each.module.split(".")[0] == PACKAGE:
            target = part_of(each.module)
            target_layer = LAYER_OF.get(target, FRONT_LAYER if target == "" else None)
            if target_layer is None:
                found.append(f"{module}:{each.line}: {each.module} stands in no layer")
            elif target_layer > layer:
                found.append(f"{module}:{each.line}: layer {layer} imports {each.module} of layer {target_layer}")
            elif (part, target) in STRANGERS:
                found.append(f"{module}:{each.line}: {part} and {target} must not know each other")
        elif layer <= HIGHEST_CORE_LAYER and each.module.split(".")[0] not in PURE_MODULES:
            found.append(f"{module}:{each.line}: the core imports {each.module}")
    if layer <= HIGHEST_CORE_LAYER:
        found.extend(
            f"{module}:{node.lineno}: the core calls {node.func.id}"
            for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in IMPURE_CALLS
        )
    return found


def module_of(file: Path) -> str:
    """The dotted name of a source file."""
    parts = file.relative_to(SOURCES.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_every_file_imports_downward_and_the_core_is_pure() -> None:
    files = sorted(SOURCES.rglob("*.py"))
    assert files
    found = [
        sentence
        for file in files
        for sentence in violations(
            file.read_text(encoding="utf-8"), module_of(file), is_package=file.name == "__init__.py"
        )
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source", "offence"),
    [
        ("busway.pdu.bits", "from ..framing import mbap", "imports busway.framing of layer 2"),
        ("busway.pdu.bits", "from .. import framing", "imports busway.framing of layer 2"),
        ("busway.pdu.bits", "from busway.session.client import Client", "imports busway.session.client of layer 3"),
        ("busway.pdu.bits", "import busway.server", "imports busway.server of layer 5"),
        ("busway.transport.tcp", "def f():\n    from ..client import link", "imports busway.client of layer 5"),
        (
            "busway.values",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .framing import Framer",
            "imports busway.framing of layer 2",
        ),
        ("busway.client.link", "from ..server import listener", "client and server must not know each other"),
        ("busway.server.tcp", "import busway.client.link", "server and client must not know each other"),
        ("busway.client.link", "from busway import connect", "layer 5 imports busway of layer 6.5"),
        ("busway.session.client", "import time", "the core imports time"),
        ("busway.session.client", "from asyncio import Future", "the core imports asyncio"),
        ("busway.framing.rtu", "import os.path", "the core imports os.path"),
        ("busway.values", "import numpy", "the core imports numpy"),
        ("busway.errors", "def f():\n    import logging", "the core imports logging"),
        ("busway.pdu.bits", "print(1)", "the core calls print"),
        ("busway.elsewhere", "", "the part elsewhere stands in no layer"),
        ("busway.client.link", "from ..elsewhere import x", "busway.elsewhere stands in no layer"),
    ],
)
def test_an_offending_file_is_found(module: str, source: str, offence: str) -> None:
    (sentence,) = violations(source, module)
    assert offence in sentence


@pytest.mark.parametrize(
    ("module", "source", "is_package"),
    [
        ("busway.pdu", "from .bits import ReadCoils\nfrom ..codes import FunctionCode", True),
        ("busway.pdu.bits", "from .message import Request\nfrom .. import errors\nimport struct", False),
        ("busway.client.link", "import asyncio\nfrom ..session import client\nfrom ..transport.tcp import x", False),
        ("busway.cli.read", "from busway import connect\nimport busway\nimport typer", False),
        ("busway", "from .client import connect\nfrom .server import serve", True),
        ("busway.server.files", "data = open('x')", False),
        ("busway.session.client", "class Link:\n    def open(self): ...\nLink().open()", False),
    ],
)
def test_a_file_within_the_rules_passes(module: str, source: str, is_package: bool) -> None:
    assert violations(source, module, is_package=is_package) == []
