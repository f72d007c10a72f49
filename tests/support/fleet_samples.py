"""Samples of a fleet as device, point and time: those in the store of a collector, and those that a sink has taken."""

import json
from pathlib import Path

import busway

Samples = set[tuple[str, str, int]]


def stored(folder: Path) -> Samples:
    """The samples in a store that were read; the times in which links were not owned are no samples."""
    rows = busway.Store(folder).read("*/*")
    return {(each.device, each.point, each.time) for each in rows if each.value is not None}


def taken(file: Path) -> Samples:
    """The samples in the lines that a sink has written so far, without one that it is writing."""
    if not file.exists():
        return set()
    lines = [json.loads(line) for line in file.read_text().splitlines() if line.endswith("}")]
    return {(each["device"], each["point"], each["time"]) for each in lines}
