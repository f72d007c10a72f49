"""A command: what of it cannot be is refused when it is made, before it is recorded or sent."""

import json
from typing import Any

import pytest

from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.errors import InvalidRequest


def command(**changes: Any) -> PointCommand:
    fields = {"key": "k", "device": "d", "point": "p", "value": 1, "by": "anna", "origin": "mqtt", "expires": 2e9}
    return PointCommand(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"by": "anna\ud800"}, "by has 1…200 printable characters"),
        ({"by": "a\nb"}, "by has 1…200 printable characters"),
        ({"value": "\udfff"}, "half of a surrogate pair"),
        ({"value": ["on", "\ud800"]}, "half of a surrogate pair"),
        ({"expires": 10**400}, "expires is seconds since 1970"),
        ({"expires": float("nan")}, "expires is seconds since 1970"),
        ({"expires": float("inf")}, "expires is seconds since 1970"),
    ],
)
def test_what_no_record_and_no_answer_could_hold_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        command(**changes)


@pytest.mark.parametrize("value", ["😀 °C", ["on", "ü"], 2**64 - 1, -0.5, True])
def test_what_is_taken_can_be_recorded_and_answered(value: Any) -> None:
    result = CommandResult(command(value=value, by="Ünal 😀"), CommandState.OPEN, 1.0)
    assert json.loads(json.dumps(result.content(), ensure_ascii=False).encode())["value"] == value
