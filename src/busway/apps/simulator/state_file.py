"""The JSON file with the saved values of a simulation, from which it continues after a restart.

Knows the file; knows no device.

1. A state is written to a new file, which then takes the name of the old file in one step: a reader sees the whole new
   state or the whole old state.
2. A state that cannot be read is renamed, never overwritten, and an error says so; the simulation begins anew.
3. A file that is no state is refused and stays as it is. So is a file that is reached by a link of another user.
4. Only its owner may read the file (0600): it holds values that clients wrote.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from ...errors import ConfigError
from ...safe_files import check_replaceable, read_safely, write_whole

_KIND: Final = "busway simulation state"
_VERSION: Final = 1
_LARGEST: Final = 256 << 20
"""Largest size of a state file in bytes: the state of a hundred thousand units takes 100 MB."""
ASIDE: Final = ".broken"
"""Ending that is appended to the name of a state file that cannot be read."""


@dataclass(frozen=True, slots=True)
class KeptPoint:
    """The saved state of one simulated point.

    Attributes:
        value: the value in the unit of measure; None if only the state of the behaviour is saved.
        is_held: whether the point was set by hand or by a Modbus client, and does not follow its behaviour.
        behaviour: the value from which the behaviour continues; None if it needs none, or the point is held.
        writer: who set the value: ``api``, or the address of a Modbus client; not of a behaviour's value.
    """

    value: Any = None  # what the point's type says
    is_held: bool = False
    behaviour: float | None = None
    writer: str = "api"


@dataclass(frozen=True, slots=True)
class KeptState:
    """The saved state of a simulation: its time and the state of its points.

    Attributes:
        time: time of the simulation, in seconds since its beginning.
        points: by ``UNIT/NAME``, the state of each saved point.
    """

    time: float
    points: Mapping[str, KeptPoint] = field(default_factory=dict)


def save_state(path: str, state: KeptState) -> None:
    """Save the state of a simulation in a file.

    Raises:
        ConfigError: the file cannot be replaced, and is as it was. If only its folder could not be synchronised to the
            disk, it has the new state already.
    """
    document = {
        "kind": _KIND,
        "version": _VERSION,
        "time": state.time,
        "points": {
            key: {
                "value": point.value,
                "held": point.is_held,
                "behaviour": point.behaviour,
                "writer": point.writer,
            }
            for key, point in state.points.items()
        },
    }
    place = check_state(path)
    try:
        write_whole(place, json.dumps(document, ensure_ascii=False, indent=1))
    except OSError as error:
        raise ConfigError(f"the values cannot be saved: {error.strerror or error}", file=path) from error


def check_state(path: str) -> str:
    """Return the path of a state file with links resolved; the file need not exist yet.

    Raises:
        ConfigError: there is a file that is not regular, is no state, or is reached by a link of another user; the file
            stays as it is.
    """
    return check_replaceable(
        path, is_ours=lambda head: f'"{_KIND}"'.encode("ascii") in head, kind="state of a simulation"
    )


def load_state(path: str) -> KeptState | None:
    """Return the state of a simulation saved in a file; None if there is no file.

    Raises:
        ConfigError: the file is no valid state, and was renamed if possible, with ``.broken`` after its name. Or
            the file is refused by `check_state`, cannot be read, or is too large, and stays as it is.
    """
    place = check_state(path)
    if not os.path.lexists(place):
        return None
    data = read_safely(place, most=_LARGEST)
    try:
        return _state(json.loads(data))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        where = _put_aside(place)
        raise ConfigError(f"the saved values cannot be read, and {where}", file=path) from error


def _put_aside(place: str) -> str:
    """Rename an invalid state file to ``NAME.broken``; return the end of a message that says where the values are now.

    The message says so if the file could not be renamed.
    """
    aside = f"{place}{ASIDE}"
    try:
        os.replace(place, check_state(aside))
    except ConfigError as error:
        return f"stand where they stood, because {error}"
    except OSError as error:
        return f"stand where they stood: {error.strerror or error}"
    return f"stand in {aside} now"


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
        points[key] = KeptPoint(
            tuple(value) if isinstance(value, list) else value,
            bool(point["held"]),
            None if behaviour is None else float(behaviour),
            str(point.get("writer", "api")),
        )
    return KeptState(time, points)
