"""Extension of griffe, which reads docstrings for the site: what takes its docstring at run time has it there too.

Knows the forms in which `busway.client.aio` takes docstrings; runs nothing of what it reads.

1. ``@documented_by(BlockingUnit.read)`` gives a method or property the docstring of that one.
2. ``__doc__ = BlockingUnit.__doc__`` gives a class the docstring of that one.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe


class DocstringsOfOthers(griffe.Extension):
    """Copies the docstrings of the blocking client to the asyncio client."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **kwargs: Any) -> None:  # Any: as griffe
        """Complete what was read of the package."""
        module = pkg["client.aio"]
        assert isinstance(module.filepath, Path)
        for taker, giver in taken(ast.parse(module.filepath.read_text(encoding="utf-8"))):
            docstring = pkg[f"client.blocking.{giver}"].docstring
            module[taker].docstring = griffe.Docstring(docstring.value, parent=module[taker])


def taken(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Which classes, methods and properties take the docstring of which others: names with dots."""
    for taker in tree.body:
        if not isinstance(taker, ast.ClassDef):
            continue
        for member in taker.body:
            match member:
                case ast.Assign([ast.Name("__doc__")], ast.Attribute(ast.Name(giver), "__doc__")):
                    yield taker.name, giver
                case ast.FunctionDef(name) | ast.AsyncFunctionDef(name):
                    for decorator in member.decorator_list:
                        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "documented_by":
                            yield f"{taker.name}.{name}", ast.unparse(decorator.args[0])
