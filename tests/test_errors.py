"""The tree of errors, their fields, and sentences that an operator can act on."""

import inspect
import re
from typing import Any

import pytest

from busway import errors
from busway.errors import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkClosed,
    LinkDown,
    MissingExtra,
    ModbusError,
    NoAnswer,
    NoReply,
    Overloaded,
    UnitSuspended,
    WriteOutcomeUnknown,
)

CLASSES = {
    name: one
    for name, one in vars(errors).items()
    if inspect.isclass(one) and issubclass(one, ModbusError) and one.__module__ == errors.__name__
}
EXAMPLES: list[ModbusError] = [
    InvalidRequest("count must be 1…125, not 126"),
    ExceptionReply(2),
    BadReply("function 4 answers function 3", raw=b"\x00\x01"),
    NoReply("no reply within 1 s"),
    UnitSuspended("unit 3 is not asked", next_probe=4.5),
    Overloaded("64 calls wait on this link already; nothing was sent"),
    WriteOutcomeUnknown("the write was sent and may have been executed"),
    LinkDown("connection refused"),
    LinkClosed("the link is closed"),
    ConfigError("must be 1…16, not 17", key="max_transactions"),
    MissingExtra("serialx", "serial", purpose="a serial port"),
]


def own_copy(error: ModbusError) -> ModbusError:
    """An example that a test may change: the others read the same ones, in any order."""
    copied = type(error).__new__(type(error))
    copied.__dict__.update(error.__dict__)
    return copied


def drawn_tree() -> dict[str, str]:
    """Parent by class, as the module's docstring draws it."""
    parents: dict[str, str] = {}
    path: list[tuple[int, str]] = []
    for line in (errors.__doc__ or "").splitlines():
        found = re.match(r"^    (?P<lead>[│ ├└─]*)(?P<name>[A-Z]\w+)\b", line)
        if found is None:
            continue
        depth, name = len(found["lead"]), found["name"]
        while path and path[-1][0] >= depth:
            path.pop()
        if path:
            parents[name] = path[-1][1]
        path.append((depth, name))
    return parents


def test_the_tree_is_the_one_that_the_docstring_draws() -> None:
    tree = drawn_tree()
    assert {*tree, "ModbusError"} == {*CLASSES}
    for name, parent in tree.items():
        assert CLASSES[name].__bases__[0] is CLASSES[parent], name


def test_the_builtin_kind_beside_a_name_in_the_tree_is_true() -> None:
    kinds = dict(re.findall(r"(\w+) \((\w+Error)\)", errors.__doc__ or ""))
    assert kinds == {
        "InvalidRequest": "ValueError",
        "NoReply": "TimeoutError",
        "LinkDown": "ConnectionError",
        "ConfigError": "ValueError",
        "MissingExtra": "ImportError",
    }
    for name, kind in kinds.items():
        assert issubclass(CLASSES[name], vars(__import__("builtins"))[kind])


def test_there_is_an_example_of_every_error() -> None:
    assert {type(one) for one in EXAMPLES} == {*CLASSES.values()} - {ModbusError, NoAnswer}


def test_one_class_catches_every_way_of_not_answering_and_nothing_else() -> None:
    caught = {type(one) for one in EXAMPLES if isinstance(one, NoAnswer)}
    assert caught == {NoReply, UnitSuspended, WriteOutcomeUnknown, LinkDown, LinkClosed}


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda error: type(error).__name__)
def test_every_error_says_its_sentence_and_has_every_field(error: ModbusError) -> None:
    assert error.message
    assert error.message in str(error)
    for field in ("endpoint", "unit", "function", "address", "attempt", "elapsed"):
        assert getattr(error, field) is None
    assert isinstance(error.raw, bytes)
    assert type(error).__doc__


@pytest.mark.parametrize("error", [one for one in EXAMPLES if not isinstance(one, ConfigError)], ids=repr)
def test_later_facts_complete_an_error_and_never_overwrite(error: ModbusError) -> None:
    error = own_copy(error)
    same = error.at(endpoint="tcp://192.0.2.5:502", unit=3, function=16, address=100, attempt=2, elapsed=1.25)
    assert same is error
    error.at(endpoint="other", unit=9, function=9, address=9, attempt=9, elapsed=9)
    assert (error.endpoint, error.unit, error.function, error.address) == ("tcp://192.0.2.5:502", 3, 16, 100)
    sentence = str(error)
    assert sentence.startswith("tcp://192.0.2.5:502, unit 3, function 16 (write multiple registers), address 100: ")
    assert "(attempt 2, after 1.250 s" in sentence


def test_zero_is_known_and_not_overwritten() -> None:
    error = NoReply("no reply", unit=0, address=0, elapsed=0.0).at(unit=7, address=7, elapsed=7.0)
    assert (error.unit, error.address, error.elapsed) == (0, 0, 0.0)
    assert str(error) == "unit 0, address 0: no reply (after 0.000 s)"


def test_the_first_attempt_is_not_worth_a_word() -> None:
    assert str(NoReply("no reply", attempt=1)) == "no reply"


def test_received_bytes_are_shown_up_to_a_bearable_length() -> None:
    assert str(BadReply("short", raw=b"\x01\xab")) == "the reply is broken: short (received 01 ab)"
    long = str(BadReply("long", raw=bytes(200)))
    assert long.endswith("00 …)")
    assert long.count("00") == 64


@pytest.mark.clause("A20")
@pytest.mark.parametrize("code", range(256))
def test_an_exception_reply_of_any_code_is_said_in_words(code: int) -> None:
    error = ExceptionReply(code)
    assert f"exception {code:02X}, " in str(error)
    assert error.from_gateway == (code in (0x0A, 0x0B))


def test_particular_fields() -> None:
    late = NoReply("slow", kind="late", observed_delay=1.5)
    assert (late.kind, late.observed_delay) == ("late", 1.5)
    assert NoReply("nothing").kind == "nothing"
    assert UnitSuspended("held", next_probe=2.0).next_probe == 2.0
    assert BadReply("because").reason == "because"
    assert not LinkDown("refused").sent
    assert LinkDown("reset", sent=True).sent


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "wrong"),
        ({"key": "a.b"}, "a.b: wrong"),
        ({"file": "x.toml"}, "x.toml: wrong"),
        ({"file": "x.toml", "line": 4}, "x.toml:4: wrong"),
        ({"line": 4, "key": "a"}, "line 4: a: wrong"),
        ({"file": "x.toml", "line": 4, "key": "a"}, "x.toml:4: a: wrong"),
    ],
)
def test_a_configuration_error_names_file_line_and_key(options: dict[str, Any], sentence: str) -> None:
    assert str(ConfigError("wrong", **options)) == sentence


def test_errors_are_caught_by_the_kinds_that_programs_catch_already() -> None:
    with pytest.raises(TimeoutError):
        raise UnitSuspended("held", next_probe=1.0)
    with pytest.raises(ConnectionError):
        raise LinkDown("refused")
    with pytest.raises(OSError, match="refused"):
        raise LinkDown("refused")
    with pytest.raises(ValueError, match="no"):
        raise InvalidRequest("no")
