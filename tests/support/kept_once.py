"""What a store and its sinks have to hold of what devices answered: each sample once, with one key, none lost.

1. A sample is named by device, point and time. In the store it is there once; in a sink all its copies are equal, with
   one commit.
2. What was seen anywhere (a sink, a query, the page, a backup) is in the store at the end, as it was seen.
3. An answer that a device gave is in the store, but for the moments before an end of the process.
"""

import csv
import io
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

from lying_devices import Answer

Key = tuple[str, str, int]
SECOND = 1_000_000_000


class Loss(Protocol):
    """A gap: the nanoseconds where it begins and ends, and how many samples were lost in it."""

    @property
    def begin(self) -> int: ...

    @property
    def end(self) -> int: ...

    @property
    def lost(self) -> int: ...


PROMPT = SECOND // 20
"""An answer that took longer came from a machine that was too busy: it may have been too late."""


@dataclass(slots=True)
class Delivered:
    """What a sink received: by sample all commits and values that it came with, in the order of arrival."""

    values: dict[Key, set[object]] = field(default_factory=lambda: defaultdict(set))
    commits: dict[Key, set[int]] = field(default_factory=lambda: defaultdict(set))
    order: list[Key] = field(default_factory=list)
    copies: int = 0

    def take(self, key: Key, value: object, commit: int) -> None:
        self.copies += 1
        if key not in self.values:
            self.order.append(key)
        self.values[key].add(value)
        self.commits[key].add(commit)

    def problems(self) -> Iterable[str]:
        """Copies that differ, and points of which something came before what is older."""
        for key, values in self.values.items():
            if len(values) != 1:
                yield f"{key} was handed on with the values {values}"
            if len(self.commits[key]) != 1 and values != {None}:  # the next process tells an interval that goes on too
                yield f"{key} was handed on as of commits {sorted(self.commits[key])}"
        last: dict[tuple[str, str], tuple[int, int]] = {}
        for key in self.order:
            point = key[:2]
            this = (min(self.commits[key]), key[2])
            if this <= last.get(point, (0, 0)):
                yield f"{key} of commit {this[0]} was handed on after {last[point]}"
            last[point] = this


def of_lines(text: str) -> Delivered:
    """What a sink of JSON lines received."""
    found = Delivered()
    for line in text.splitlines():
        try:
            sample = json.loads(line)
        except ValueError:
            continue  # what a kill cut off; it comes again
        found.take((sample["device"], sample["point"], sample["time"]), sample["value"], sample["commit"])
    return found


def of_csv(text: str) -> dict[Key, str]:
    """The samples of ``busway query --csv`` that have a value."""
    found = {}
    for row in csv.DictReader(io.StringIO(text)):
        if row["quality"] != "bad":
            device, _, point = row["point"].partition("/")
            found[device, point, nanoseconds(row["time"])] = row["value"]
    return found


def of_parquet(file: Path) -> dict[Key, int]:
    """The samples of ``busway query --parquet`` that have a value; the digits of what is no float are texts."""
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(file)
    table = table.set_column(0, "time", table["time"].cast("int64"))
    return {
        (row["device"], row["point"], row["time"]): int(row["value"] if row["text"] is None else row["text"])
        for row in table.to_pylist()
        if row["quality"] != "bad"
    }


def nanoseconds(text: str) -> int:
    """A time of the command line, as nanoseconds since 1970."""
    whole, _, part = text.rstrip("Z").partition(".")
    return int(datetime.fromisoformat(whole + "+00:00").timestamp()) * SECOND + int(part.ljust(9, "0") or 0)


def valued_samples(table: Iterable[Any]) -> tuple[dict[Key, object], list[str]]:
    """The samples of a store that have a value, by their names, and which are there twice."""
    found: dict[Key, object] = {}
    twice = []
    for sample in table:
        if sample.value is not None:
            key = (sample.device, sample.point, sample.time)
            if key in found:
                twice.append(f"{key} is there twice: {found[key]} and {sample.value}")
            found[key] = sample.value
    return found, twice


def bad_samples(table: Iterable[Any]) -> dict[tuple[str, str], list[int]]:
    """By point, the times of the transactions of which no value came."""
    found = defaultdict(list)
    for sample in table:
        if sample.value is None:
            found[sample.device, sample.point].append(sample.time)
    return found


def missing_answers(
    kept: Mapping[Key, object],
    bad: Mapping[tuple[str, str], Sequence[int]],
    lost: Sequence[Loss],
    answers: Mapping[str, Sequence[Answer]],
    excused: Sequence[tuple[int, int]],
) -> Iterable[str]:
    """Honest answers whose read is nowhere in the store, with its value, as bad or as lost, and those there twice.

    The clock of samples need not be that of answers: an answer without a sample belongs between the samples of the
    answers before and after it.
    """
    turns: dict[tuple[str, str, int], list[int]] = defaultdict(list)
    for (device, point, time), value in kept.items():
        if point.startswith("code"):
            assert isinstance(value, int)
            turns[device, point, value & 0xFFFFFFFF].append(time)
    for place, times in turns.items():
        if len(times) > 1:
            yield f"the answer {place} is there at {times}"
    counted = 0
    for device, given in answers.items():
        spans = _spans(given, {turn: times[0] for (each, _, turn), times in turns.items() if each == device})
        for answer in given:
            if answer.lie != "honest" or answer.function != 3 or answer.start % 4 or answer.count % 4:
                continue
            if any(begin <= answer.received <= end for begin, end in excused):
                continue
            if answer.answered - answer.received > PROMPT:
                continue
            low, high = spans[answer.round]
            for start in range(answer.start, answer.start + answer.count, 4):
                point = f"code{start}"
                if point not in WANTED or (device, point, answer.round) in turns:
                    continue
                if any(low <= time <= high for time in bad.get((device, point), ())):
                    continue
                if any(loss.begin <= high and low <= loss.end for loss in lost):
                    counted += 1
                    continue
                yield f"{device}/{point}: the answer {answer.round} at {answer.received} is not in the store"
    said = sum(loss.lost for loss in lost)
    if counted > said:
        yield f"{counted} samples are lost, and gaps say {said}"


def _spans(given: Sequence[Answer], kept: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """For each answer of a device the times between which its sample belongs: those of the answers that are kept."""
    spans: dict[int, tuple[int, int]] = {}
    ordered = sorted(each.round for each in given)
    before: dict[int, int] = {}
    last = 0
    for turn in ordered:
        before[turn] = last = kept.get(turn, last)
    following = 2**63
    for turn in reversed(ordered):
        following = kept.get(turn, following)
        low, high = sorted((before[turn], following))
        spans[turn] = low - SECOND // 20, high + SECOND // 20
    return spans


WANTED = frozenset(f"code{start}" for start in (0, 4, 8, 200, 204))
"""The points of the devices of these tests."""


def profile() -> str:
    """Five points in two reads, and nothing else that could be read."""
    lines = ["[[unit]]", "unit = 1", "point = ["]
    for start in (0, 4, 8, 200, 204):
        lines.append(f'    {{ name = "code{start}", address = "holding:{start}", type = "uint64" }},')
    return "\n".join([*lines, "]"]) + "\n"
