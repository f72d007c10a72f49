"""Behaviour ``replay``: recorded values from lines ``time,value``.

Knows the text of such a file; reads none.

1. Times are seconds and rise. The first line may be a heading. Empty lines, and those that begin with ``#``, are left
   out. A value is a number; ``on`` and ``off`` (``true``, ``false``) are 1 and 0.
2. The recording begins at its first time. With ``repeat`` it begins anew after its last time plus the distance of its
   last two.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, Literal

from ....config.files.file_error import FileError
from ....errors import ConfigError
from ....values.refusal import shown

_MOST_PROBLEMS: Final = 20
_STATES: Final = {"on": 1.0, "true": 1.0, "off": 0.0, "false": 0.0}


@dataclass(frozen=True, slots=True)
class Recording:
    """Recorded values of a point over time, to be replayed.

    Attributes:
        times: seconds since the first of them, rising, the first 0.
        values: as many.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]

    @property
    def length(self) -> float:
        """Seconds from the start of the recording until it repeats."""
        times = self.times
        return times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0)


def parse_recording(text: str, name: str) -> Recording:
    """Parse the lines ``time,value`` of a recording to be replayed.

    Args:
        text: the content of the file.
        name: its name, for the sentences.

    Raises:
        FileError: all that is wrong, each with file and line.
    """
    times: list[float] = []
    values: list[float] = []
    problems: list[ConfigError] = []
    is_first = True
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            time, value = _pair(line)
            if times and time <= times[-1]:
                raise ConfigError(f"times rise, but {time:g} comes after {times[-1]:g}")
        except ConfigError as error:
            if not (is_first and _is_heading(line)):
                problems.append(ConfigError(error.message, file=name, line=number))
        else:
            times.append(time)
            values.append(value)
        is_first = False
        if len(problems) == _MOST_PROBLEMS:
            break
    if not times and not problems:
        problems.append(ConfigError("there is no line of time,value", file=name, line=1))
    if problems:
        raise FileError(problems)
    return Recording(tuple(time - times[0] for time in times), tuple(values))


def _pair(line: str) -> tuple[float, float]:
    cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
    if len(cells) != 2:
        raise ConfigError(f"a line is time,value, not {shown(line)}")
    return _number("time", cells[0]), _number("value", cells[1])


def _number(what: str, text: str) -> float:
    if what == "value" and text.lower() in _STATES:
        return _STATES[text.lower()]
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or "_" in text:
        raise ConfigError(f"the {what} is no number: {shown(text)}")
    return number


def _is_heading(line: str) -> bool:
    cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
    return len(cells) == 2 and all(cell and not cell[0].isdigit() and cell[0] not in "+-." for cell in cells)


class Replay:
    """Behaviour ``replay``: the point takes recorded values, again and again.

    Args:
        recording: the values.
        at_end: whether the last value stays after the end, or all are repeated.
        between: how values between two lines come: the earlier one, or on a straight line.
    """

    __slots__ = ("_is_line", "_length", "_recording", "_repeats")

    def __init__(
        self, recording: Recording, at_end: Literal["repeat", "hold"], between: Literal["step", "line"]
    ) -> None:
        self._recording = recording
        self._repeats = at_end == "repeat"
        self._is_line = between == "line"
        self._length = recording.length

    def value(self, time: float) -> float:
        """Return the recorded value at a time."""
        times, values = self._recording.times, self._recording.values
        if self._repeats:
            time %= self._length
        at = max(bisect_right(times, time) - 1, 0)
        if not self._is_line or at == len(times) - 1:
            return values[at]
        part = (time - times[at]) / (times[at + 1] - times[at])
        return values[at] + part * (values[at + 1] - values[at])

    def resume(self, time: float, value: float) -> None:
        """Do nothing: the replayed value follows from the time."""

    def state(self, time: float) -> float | None:
        """Return None, as a replay has no state to keep."""
        return None
