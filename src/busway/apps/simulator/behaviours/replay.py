"""Behaviour ``replay``: recorded values from lines ``time,value``.

Knows the text of a recording; reads no file.

1. Times are seconds and rise. The first line may be a heading. Empty lines, and those that begin with ``#``, are left
   out. A value is a number; ``on`` and ``off`` (``true``, ``false``) are 1 and 0.
2. The recording begins at its first time, which is time 0 of the simulation. With ``repeat`` the last value lasts as
   long as the value before it; then the recording begins again.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, Literal

from ....config.files.file_error import FileError
from ....errors import ConfigError
from ....values.unfit_values import shown

_MOST_PROBLEMS: Final = 20
_STATES: Final = {"on": 1.0, "true": 1.0, "off": 0.0, "false": 0.0}


@dataclass(frozen=True, slots=True)
class Recording:
    """Recorded values of a point over time, to be replayed.

    Attributes:
        times: times of the values in seconds since the first one, rising; the first is 0.
        values: a value for each time.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]

    @property
    def length(self) -> float:
        """The seconds from the start of the recording until it repeats; 1 second if it has one value only.

        The last value lasts as long as the value before it.
        """
        times = self.times
        return times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0)


def parse_recording(text: str, name: str) -> Recording:
    """Return the recording that a text of lines ``time,value`` holds.

    Args:
        text: content of the file.
        name: name of the file, for errors.

    Raises:
        FileError: the text is invalid; the error has up to 20 problems, each with file and line.
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
    """Behaviour ``replay``: the point takes recorded values, once or again and again.

    Args:
        recording: the recorded values.
        at_end: ``hold``: the last value stays after the end; ``repeat``: the recording begins again.
        between: the value between two recorded ones. ``step``: the earlier one; ``line``: on a straight line from one
            to the other.
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
        """Return the value of the recording at a time, in seconds of the simulation."""
        times, values = self._recording.times, self._recording.values
        if self._repeats:
            time %= self._length
        at = max(bisect_right(times, time) - 1, 0)
        if not self._is_line or at == len(times) - 1:
            return values[at]
        part = (time - times[at]) / (times[at + 1] - times[at])
        return values[at] + part * (values[at + 1] - values[at])

    def resume(self, time: float, value: float) -> None:
        """Do nothing: the replayed value follows from the time alone."""

    def state(self, time: float) -> float | None:
        """Return None, as a replay has no state to keep."""
        return None
