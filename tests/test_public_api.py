"""The public names and their signatures, compared with `public_api.txt`: no change of them goes unnoticed.

A change that is meant is accepted with ``python tests/test_public_api.py > tests/public_api.txt``, and has its line in
the change notes.
"""

import difflib
import inspect
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, is_typeddict

import busway
from busway.pdu.compiler import attribute_names
from busway.pdu.fields import NO_DEFAULT
from busway.pdu.message import Message

LIST = Path(__file__).parent / "public_api.txt"


def test_every_public_name_is_there_and_listed() -> None:
    for name in busway.__all__:
        assert getattr(busway, name) is not None
    assert sorted(set(busway.__all__)) == sorted(busway.__all__), "each name once"
    assert dir(busway) == sorted(busway.__all__)
    star: dict[str, Any] = {}
    exec("from busway import *", star)
    assert {*busway.__all__} <= {*star}


def test_a_name_that_is_not_public_is_no_attribute() -> None:
    missing = "read_everything"
    assert not hasattr(busway, missing)


def test_every_public_name_is_documented() -> None:
    for name in busway.__all__:
        value = getattr(busway, name)
        if inspect.isclass(value) or inspect.isroutine(value):
            assert inspect.getdoc(value), name


def test_names_and_signatures_are_those_of_the_list() -> None:
    now, then = list(described()), LIST.read_text("utf-8").splitlines()
    assert now == then, "\n".join(difflib.unified_diff(then, now, "public_api.txt", "the package", lineterm=""))


def described() -> Iterator[str]:
    """One line for each public name, and for each public member of a class."""
    for name in sorted(busway.__all__):
        value = getattr(busway, name)
        if inspect.isclass(value):
            yield from described_class(name, value)
        elif inspect.isroutine(value):
            yield f"{name}{arguments(value)}"
        elif name != "__version__":
            yield f"{name}: {type(value).__name__}"


def described_class(name: str, kind: Any) -> Iterator[str]:
    if issubclass(kind, Enum):
        yield f"{name}: {', '.join(f'{one.name}={one.value!r}' for one in kind)}"
        return
    if is_typeddict(kind):
        yield f"{name}: {', '.join(sorted(kind.__annotations__))}"
        return
    if issubclass(kind, Message):
        yield f"{name}({message_arguments(kind)})"
        if "Reply" in vars(kind):
            yield f"{name}.Reply({message_arguments(kind.Reply)})"
        members = ("of",) if hasattr(kind, "of") else ()
    elif issubclass(kind, BaseException) or not getattr(kind, "_is_protocol", False):
        yield f"{name}{arguments(kind)}"
        members = tuple(one for one in sorted(dir(kind)) if not one.startswith("_") and is_ours(kind, one))
    for member in members:
        value = inspect.getattr_static(kind, member)
        if isinstance(value, property):
            yield f"{name}.{member}"
        elif callable(value) or isinstance(value, classmethod | staticmethod):
            yield f"{name}.{member}{arguments(getattr(kind, member), bound=isinstance(value, classmethod))}"


def is_ours(kind: Any, member: str) -> bool:
    """Whether a member comes from this package, and not from ``object`` or an exception of Python."""
    owner = next((one for one in kind.__mro__ if member in vars(one)), None)
    return owner is not None and owner.__module__.startswith("busway")


def message_arguments(kind: Any) -> str:
    parts = []
    for field in attribute_names(kind):
        default = getattr(kind.declared[field], "default", NO_DEFAULT)
        parts.append(field if default is NO_DEFAULT else f"{field}={default!r}")
    return ", ".join(parts)


def arguments(function: Any, *, bound: bool = False) -> str:
    """The signature without annotations, which are for the type checker; ``self`` left out."""
    parts: list[str] = []
    star = False
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name == "self" and not bound:
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not star:
            parts.append("*")
            star = True
        prefix = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        star = star or prefix == "*"
        default = "" if parameter.default is parameter.empty else f"={shown(parameter.default)}"
        parts.append(f"{prefix}{parameter.name}{default}")
    return f"({', '.join(parts)})"


def shown(default: object) -> str:
    if isinstance(default, Enum):
        return f"{type(default).__name__}.{default.name}"
    text = repr(default)
    return f"<{type(default).__name__}>" if " at 0x" in text else text


if __name__ == "__main__":
    print("\n".join(described()))
