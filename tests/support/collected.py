"""Samples for the tests of stores and sinks, and stores that hold them."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from busway.apps.collector.samples import NANOSECONDS, PointGroup, SampleBatch, SampleValue
from busway.apps.collector.store import sealed_writer
from busway.apps.collector.store.sealing import StepDone
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

NOON = 1_800_000_000 * NANOSECONDS
"""A time at which ten minutes begin; samples of the tests are after it."""
SECOND = NANOSECONDS
METER = PointGroup("meter-7", ("voltage", "current", "state"))
PUMP = PointGroup("pump-1", ("speed",))


def at(seconds: float) -> int:
    """Nanoseconds of a time so many seconds after `NOON`."""
    return NOON + round(seconds * SECOND)


def read_of(
    group: PointGroup, seconds: float, *values: SampleValue | None, reasons: Iterable[int] | int = 0
) -> SampleBatch:
    """The samples of a read so many seconds after `NOON`, which took 10 ms."""
    return SampleBatch(group, at(seconds), 5_000_000, values, reasons if isinstance(reasons, int) else tuple(reasons))


def meter_read(seconds: float, number: float = 0.0) -> SampleBatch:
    """A read of the meter: voltage 230 + ``number``, current ``number``, state "on"."""
    return read_of(METER, seconds, 230.0 + number, number, "on")


def filled(
    folder: Path, commits: int = 10, *, options: StoreOptions | None = None, first: int = 0, step: float = 1.0
) -> StoreWriter:
    """A store, still open, with one read of the meter in each commit, ``step`` seconds apart."""
    writer = StoreWriter(folder, options, now=at(first * step))
    for number in range(first, first + commits):
        writer.commit([meter_read(number * step, number)], [], at(number * step + 0.1))
    return writer


def parts_of_all_kinds(folder: Path) -> StoreWriter:
    """A store, still open, with a sealed part, a closed and an open segment."""
    writer = filled(folder, 15, step=60.0)
    writer.seal_closed()
    writer.roll()
    writer.commit([meter_read(2000, 7)], [], at(2000))
    return writer


def sealed_here(
    source: Path, points: list[tuple[int, str, str, str]], step: StepDone
) -> list[tuple[Path, dict[str, Any]]]:
    """What another process writes when a segment is sealed, written by this one: its start takes most of the time."""
    return list(sealed_writer.write_parts(source, points, os.getppid()))
