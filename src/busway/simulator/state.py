"""Values of a simulation over a restart: a file of JSON.

Knows the file; knows no device.

1. It is written beside its place and then put there in one step: who reads it sees all of it, or the one before.
2. A file that can not be read is put aside, never overwritten, and said; the simulation begins anew.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ..errors import ConfigError

_KIND: Final = "busway simulation state"
_VERSION: Final = 1
ASIDE: Final = ".broken"
"""What is appended to the name of a file that could not be read."""


@dataclass(frozen=True, slots=True)
class KeptPoint:
    """What is kept of a point.

    Attributes:
        value: in the unit of measure; None where the behaviour alone is kept.
        is_held: whether it was set by hand and does not follow its behaviour.
        behaviour: what its behaviour goes on from; None where that follows from the time.
    """

    value: Any = None  # what the point's type says
    is_held: bool = False
    behaviour: float | None = None


@dataclass(frozen=True, slots=True)
class KeptState:
    """What is kept of a simulation.

    Attributes:
        time: seconds since its beginning.
        points: by ``UNIT/NAME``.
    """

    time: float
    points: Mapping[str, KeptPoint] = field(default_factory=dict)


def save_state(path: str, state: KeptState) -> None:
    """Put a state into a file. Raises `ConfigError` where that can not be; then the one before still stands."""
    document = {
        "kind": _KIND,
        "version": _VERSION,
        "time": state.time,
        "points": {
            key: {"value": point.value, "held": point.is_held, "behaviour": point.behaviour}
            for key, point in state.points.items()
        },
    }
    fresh = Path(f"{path}.{os.getpid()}.new")
    try:
        with fresh.open("w", encoding="utf-8") as file:
            json.dump(document, file, ensure_ascii=False, indent=1)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            fresh.unlink()
        raise ConfigError(f"the values can not be kept: {error.strerror or error}", file=path) from error


def load_state(path: str) -> KeptState | None:
    """The state in a file; None where there is no file.

    Raises:
        ConfigError: it is there and means nothing; it now stands beside, with ``.broken`` after its name.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"the values that were kept can not be read: {error.strerror or error}", file=path) from error
    try:
        return _state(json.loads(data))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        with contextlib.suppress(OSError):
            Path(path).replace(f"{path}{ASIDE}")
        raise ConfigError(
            f"the values that were kept can not be understood, and stand in {path}{ASIDE} now", file=path
        ) from error


def _state(document: Any) -> KeptState:  # what JSON has
    if document["kind"] != _KIND or document["version"] != _VERSION:
        raise ValueError(document["kind"])
    time = float(document["time"])
    if not 0 <= time < 1e12:
        raise ValueError(time)
    points = {}
    for key, point in document["points"].items():
        value, behaviour = point["value"], point["behaviour"]
        if isinstance(value, dict) or (behaviour is not None and not isinstance(behaviour, int | float)):
            raise ValueError(key)
        # A group of bits is a tuple; JSON makes it a list, which would be several values.
        points[key] = KeptPoint(tuple(value) if isinstance(value, list) else value, bool(point["held"]), behaviour)
    return KeptState(time, points)
