"""The blocking and the asyncio interface have the same names, arguments, results and descriptions."""

import inspect
from typing import Any

import pytest

import busway

PAIRS = ((busway.AsyncUnit, busway.BlockingUnit), (busway.AsyncLink, busway.BlockingLink))
COUNTERPART = {
    "__aenter__": "__enter__",
    "__aexit__": "__exit__",
}


def _public(kind: type) -> dict[str, Any]:
    """Public members by their name, as the blocking interface has it."""
    found = {}
    for name, member in vars(kind).items():
        name = COUNTERPART.get(name, name)
        if not name.startswith("_") or name in COUNTERPART.values():
            found[name] = member
    return found


def _members() -> list[Any]:
    return [
        pytest.param(asynchronous, blocking, name, id=f"{blocking.__name__}.{name}")
        for asynchronous, blocking in PAIRS
        for name in sorted(_public(asynchronous))
    ]


@pytest.mark.parametrize(("asynchronous", "blocking"), PAIRS, ids=["Unit", "Link"])
def test_both_have_the_same_names(asynchronous: type, blocking: type) -> None:
    assert set(_public(asynchronous)) == set(_public(blocking))


@pytest.mark.parametrize(("asynchronous", "blocking", "name"), _members())
def test_both_have_the_same_parameters_and_description(asynchronous: type, blocking: type, name: str) -> None:
    one, other = _public(asynchronous)[name], _public(blocking)[name]
    assert type(one) is type(other)
    if isinstance(one, property):
        one, other = one.fget, other.fget
    assert inspect.getdoc(one) == inspect.getdoc(other)
    if not name.startswith("__"):
        assert inspect.getdoc(one), "a public name without a description"
    assert _parameters(one) == _parameters(other)
    assert _plain(one) == _plain(other)


def _parameters(function: Any) -> list[tuple[str, Any, Any, Any]]:
    signature = inspect.signature(function)
    return [(one.name, one.kind, one.default, str(one.annotation)) for one in signature.parameters.values()]


def _plain(function: Any) -> str:
    """What a function gives, once it is awaited, in the words of the blocking interface."""
    annotation = inspect.signature(function).return_annotation
    given = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    return given.replace("AsyncUnit", "BlockingUnit").replace("AsyncLink", "BlockingLink")


@pytest.mark.parametrize(("asynchronous", "blocking"), PAIRS, ids=["Unit", "Link"])
def test_classes_describe_the_same_thing(asynchronous: type, blocking: type) -> None:
    if asynchronous is busway.AsyncUnit:
        assert inspect.getdoc(asynchronous) == inspect.getdoc(blocking)
    assert inspect.getdoc(blocking)


def test_both_are_opened_with_the_same_arguments() -> None:
    assert _parameters(busway.open) == _parameters(busway.connect)
