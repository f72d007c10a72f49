"""What tests, benchmarks and scripts import from busway and from `tests/support` is there.

A type checker does not look at them, so a rename would be found only where the test is collected. `make check` runs
this file.
"""

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

import pytest

from busway.errors import MissingExtra

TESTS = Path(__file__).parent
ROOT = TESTS.parent
SUPPORT = {file.stem for file in (TESTS / "support").glob("*.py")}
FOLDERS = ("tests", "bench", "scripts")


def names_used(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Module and name of everything that a file imports, or replaces by a text such as ``busway.room.file.NAME``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                yield node.module, alias.name
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, ""
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr":
            first = node.args[0] if node.args else None
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                module, _, name = first.value.rpartition(".")
                yield module, name


def is_there(module: str, name: str) -> bool:
    """Whether a module, or an object in it, has this name."""
    try:
        resolve_name(f"{module}.{name}" if name else module)
    except AttributeError:
        return needs_an_extra(f"{module}.{name}")
    except ModuleNotFoundError as error:
        needed = (error.name or "").partition(".")[0]
        return needed not in ("busway", *SUPPORT)  # a package that is not installed here
    except ImportError:
        return False
    return True


def needs_an_extra(module: str) -> bool:
    """Whether it is a module that cannot be imported here for want of a package."""
    try:
        import_module(module)
    except MissingExtra:
        return True
    except ImportError:
        return False
    return False


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_name_that_is_imported_is_there(folder: str) -> None:
    missing = []
    for file in sorted((ROOT / folder).rglob("*.py")):
        if "build" in file.relative_to(ROOT).parts:
            continue
        for module, name in names_used(ast.parse(file.read_text(encoding="utf-8"))):
            if module.partition(".")[0] in ("busway", *SUPPORT) and not is_there(module, name):
                missing.append(f"{file.relative_to(ROOT)}: {module}.{name}")
    assert not missing, "\n".join(missing)


def test_a_name_that_is_not_there_is_found() -> None:
    used = list(names_used(ast.parse('from busway.codes import Gone\nm.setattr("busway.codes.LOST", 1)')))
    assert [is_there(*one) for one in used] == [False, False]
    assert is_there("busway.session.tcp_client", "TcpClientSession")
    assert is_there("busway", "session")
