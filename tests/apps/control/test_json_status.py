"""A status as JSON can hold it."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, IntEnum
from ipaddress import ip_address

from busway.apps.control.json_status import plain


class Colour(Enum):
    RED = "red"


class Level(IntEnum):
    HIGH = 3


@dataclass(slots=True)
class Inner:
    count: int


@dataclass(slots=True)
class Outer:
    inner: Inner
    several: tuple[Inner, ...]
    colour: Colour
    level: Level


def test_dataclasses_become_objects_and_enumerations_words() -> None:
    value = Outer(Inner(1), (Inner(2),), Colour.RED, Level.HIGH)
    assert plain(value) == {"inner": {"count": 1}, "several": [{"count": 2}], "colour": "red", "level": "high"}


def test_everything_can_be_written_as_json() -> None:
    value = {
        Colour.RED: [float("inf"), float("nan"), 1.5, None, True],
        3: {b"\x01\xff": frozenset({2})},
        "host": ip_address("10.0.0.1"),
        "when": datetime(2026, 1, 2, tzinfo=UTC),
    }
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == {
        "red": [None, None, 1.5, None, True],
        "3": {"01ff": [2]},
        "host": "10.0.0.1",
        "when": "2026-01-02T00:00:00+00:00",
    }
