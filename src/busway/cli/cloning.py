"""``busway simulate --clone``: records a live device into a simulation file.

1. The device is only read. With ``--map`` each point of the map is read, with ``--watch`` repeatedly; without a map the
   tables are searched for items.
2. The file goes to stdout, or with ``--out`` into a file; progress and what could not be recorded go to stderr.
3. An existing file is overwritten with ``--force`` only; that is checked before the device is asked.
"""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import ConfigError
from .arguments import opened_unit, seconds
from .exits import ExitCode
from .files import refuse_to_replace, write_new
from .output import say, warn

if TYPE_CHECKING:
    from ..apps.simulator.clone import Clone
    from ..client.blocking import BlockingUnit

BETWEEN_LOOKS = 1.0
"""Seconds between two readings of a device whose values are observed (``--watch``)."""
_RANGE = re.compile(r"(\d{1,5})(?:-(\d{1,5}))?")
_LAST = 65_535


@dataclass(frozen=True, slots=True)
class CloneOptions:
    """The options of ``busway simulate --clone``, as texts of the command line.

    Attributes:
        url: URL of the device; empty without ``--clone``.
        unit: unit identifier, 0…255; None for the default of the link.
        map: path of a register map in CSV, whose points are read; None: the tables are searched for items.
        out: path of the simulation file; None for stdout.
        watch: how long to observe how the values change, such as ``60s``; None for not at all. Needs ``map``.
        ranges: offsets to search without a map: ``0-999,40000-40199``; None for the usual ones.
        thorough: whether blocks that seem empty are searched too.
        force: whether an existing file ``out`` may be overwritten.
        timeout, retries: options of the link; None for its defaults.
        verbose: how much traffic is logged: 0 none, 1 messages, 2 frames, 3 bytes.
    """

    url: str
    unit: str | None = None
    map: str | None = None
    out: str | None = None
    watch: str | None = None
    ranges: str | None = None
    thorough: bool = False
    force: bool = False
    timeout: str | None = None
    retries: str | None = None
    verbose: int = 0


def refuse_without_clone(options: CloneOptions) -> None:
    """Raise `ConfigError` if one of ``--out``, ``--watch``, ``--range``, ``--thorough`` and ``--force`` is given.

    These options need ``--clone``; call this only if that is not given.
    """
    given = {"--out": options.out, "--watch": options.watch, "--range": options.ranges, "--thorough": options.thorough}
    for option, value in {**given, "--force": options.force}.items():
        if value:
            raise ConfigError("goes with --clone only", key=option)


def clone_device(options: CloneOptions) -> int:
    """Record a live device, and write a simulation file that imitates it; return the exit code.

    Raises:
        ConfigError: options contradict each other or the file exists already, and nothing was sent; or the file cannot
            be written.
        ModbusError: the device cannot be read.
    """
    from ..apps.simulator.device_text import device_text

    duration = None if options.watch is None else seconds(options.watch, "--watch")
    if options.map is None and duration is not None:
        raise ConfigError("needs --map: without names there is nothing to watch", key="--watch")
    if options.map is not None and (options.ranges is not None or options.thorough):
        raise ConfigError("does not go with --map", key="--thorough" if options.ranges is None else "--range")
    if options.force and options.out is None:
        raise ConfigError("goes with --out only", key="--force")
    if options.out is not None:
        refuse_to_replace(options.out, force=options.force)
    with opened_unit(
        options.url, unit=options.unit, timeout=options.timeout, retries=options.retries, verbose=options.verbose
    ) as unit:
        clone = _recorded(unit, options, duration)
    for remark in clone.remarks:
        warn(remark)
    remarks = [f"Recorded from {options.url}, unit {unit.number}.", *clone.remarks]
    text = device_text([clone.section], remarks=remarks, compact=options.map is None)
    if options.out is None:
        print(text, end="")
    else:
        write_new(options.out, text, force=options.force, kind="recording")
        say(f"{options.out} is written")
    return ExitCode.DONE


def _recorded(unit: "BlockingUnit", options: CloneOptions, duration: float | None) -> "Clone":
    from ..apps.simulator.clone import RANGES, clone_points, clone_tables, watch_points
    from ..apps.simulator.csv_register_map import read_register_map

    if options.map is None:
        ranges = RANGES if options.ranges is None else _ranges(options.ranges)
        return clone_tables(unit, ranges=ranges, thorough=options.thorough, progress=say)
    clone = clone_points(unit, read_register_map(options.map), progress=say)
    if duration is None:
        return clone
    say(f"watching for {duration:g} s")
    return watch_points(unit, clone, _moments(duration), progress=say)


def _moments(duration: float) -> Iterator[float]:
    """Yield about one value a second, after sleeping that long: the seconds since the first step.

    The last value is ``duration`` (seconds).
    """
    began = time.monotonic()
    due = 0.0
    while due < duration:
        due = min(max(due + BETWEEN_LOOKS, time.monotonic() - began), duration)
        time.sleep(max(0.0, began + due - time.monotonic()))
        yield due


def _ranges(text: str) -> list[range]:
    """Return the ranges of 0-based offsets in a text such as ``0-999,40000``, ends included.

    Raises:
        ConfigError: the text is written otherwise, or an offset is above 65535.
    """
    found = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first = -1 if match is None else int(match[1])
        last = first if match is None or match[2] is None else int(match[2])
        if not 0 <= first <= last <= _LAST:
            raise ConfigError(f"offsets 0…{_LAST} such as 0-999,40000-40199 are needed, not {part!r}", key="--range")
        found.append(range(first, last + 1))
    return found
