"""Sink that writes files: CSV, JSON lines, Parquet.

Knows formats; knows nothing of cursors.

1. Lines are appended and made durable before `send` returns. If a crash has cut off the last line, a line break is
   written first. A batch that is sent again is in the file twice, with the same commit numbers.
2. A Parquet file is one batch, named by its first commit. A batch that is sent again replaces its file, even if it ends
   with another commit then. It also replaces files of the same commits that an earlier process wrote: after a full
   disk there may be several.
3. ``{date}`` in the name of a file of lines is the day (UTC) of the first sample or alarm event of the batch.
4. Alarm events go to files of their own: with ``-alarms`` before the ending of the name; for Parquet, in the folder
   ``alarms``.
"""

import asyncio
import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeVar

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import FileFormat
from ..samples import NANOSECONDS, SampleValue, reason_text
from ..store.committed_samples import CommittedAlarm, CommittedSample
from ..store.folder import UNFINISHED, is_cut_off, make_durably, sync_file, sync_folder
from ..store.sealing import arrow
from .documents import alarm_document, sample_document
from .interface import SinkDown

HEADER: Final = ("time", "device", "point", "value", "quality", "reason", "half_width", "commit")
ALARM_HEADER: Final = ("time", "device", "point", "limit", "event", "value", "text", "by", "commit", "place")


SampleOrAlarm = TypeVar("SampleOrAlarm", CommittedSample, CommittedAlarm)


class FileSink:
    """Sink that writes samples and alarm events to files: CSV, JSON lines or Parquet.

    CSV and JSON lines are appended to a file, Parquet is one file for each batch. Parquet needs pyarrow.
    """

    def __init__(self, path: str | os.PathLike[str], kind: FileFormat | str | None = None) -> None:
        """Set where the sink writes its files; nothing is opened yet.

        Args:
            path: the file, with ``{date}`` in its name for one file a day; for Parquet a folder.
            kind: the format: ``csv``, ``jsonl`` or ``parquet``; None to take it from the ending of ``path``.

        Raises:
            ConfigError: there is no such format.
            MissingExtra: the format is Parquet, and pyarrow is not installed.
        """
        self._path = os.fspath(path)
        given = kind or self._path.rpartition(".")[2].lower()
        try:
            found = FileFormat(given)
        except ValueError:
            raise ConfigError(f"files are csv, jsonl or parquet, not {given!r}", key="format") from None
        if found is FileFormat.PARQUET:
            require("pyarrow", "a sink to files in Parquet")
        self._format = found
        self._ahead: set[int] | None = (
            None  # first commits of files that an earlier process wrote; None: not looked yet
        )

    @property
    def is_named_by_commits(self) -> bool:
        """Whether files are named by commit numbers (Parquet), so that two stores must not share the folder."""
        return self._format is FileFormat.PARQUET

    async def open(self) -> None:
        """Do nothing: the sink opens its files anew for each batch of samples."""

    async def close(self) -> None:
        """Do nothing: the sink keeps no file open between batches of samples."""

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Write a batch of samples to its file, so that it survives a power failure.

        Raises:
            SinkDown: the file cannot be written.
        """
        await self._write(self._write_samples, samples)

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Write alarm events to a file of their own, so that they survive a power failure.

        Raises:
            SinkDown: the file cannot be written.
        """
        await self._write(self._write_alarms, alarms)

    async def _write(self, write: Callable[[Sequence[SampleOrAlarm]], None], what: Sequence[SampleOrAlarm]) -> None:
        try:
            await asyncio.to_thread(write, what)
        except OSError as error:
            raise SinkDown(f"{self._path} cannot be written: {error.strerror or error}") from error

    def _write_samples(self, samples: Sequence[CommittedSample]) -> None:
        if self._format is FileFormat.PARQUET:
            first, last = samples[0].commit, samples[-1].commit
            _write_parquet(Path(self._path), f"{first:012d}", _columns(samples))
            self._remove_repeated(first, last)
        else:
            is_csv = self._format is FileFormat.CSV
            lines = _csv_lines(map(_row, samples)) if is_csv else _json_lines(map(_document, samples))
            self._append(self._path, samples[0].time, HEADER, lines)

    def _remove_repeated(self, first: int, last: int) -> None:
        """Remove the Parquet files of an earlier process whose first commit is after ``first`` and not after ``last``.

        Their samples are sent again: in the batch with commits ``first`` to ``last``, or in the next batch.
        """
        folder = Path(self._path)
        if self._ahead is None:
            numbers = [int(path.stem) for path in folder.glob("*.parquet") if path.stem.isdecimal()]
            self._ahead = {number for number in numbers if number > first}
        repeated = {number for number in self._ahead if number <= last}
        for number in repeated:
            (folder / f"{number:012d}.parquet").unlink(missing_ok=True)
        self._ahead -= repeated

    def _write_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        if self._format is FileFormat.PARQUET:
            first = f"{alarms[0].commit:012d}-{alarms[0].place:04d}"
            _write_parquet(Path(self._path) / "alarms", first, _alarm_columns(alarms))
            return
        lines = (
            _csv_lines(map(_alarm_row, alarms))
            if self._format is FileFormat.CSV
            else _json_lines(alarm_document(each).content for each in alarms)
        )
        name, dot, ending = self._path.rpartition(".")
        path = f"{name}-alarms.{ending}" if dot and "/" not in ending else f"{self._path}-alarms"
        self._append(path, alarms[0].event.at, ALARM_HEADER, lines)

    def _append(self, name: str, time: int, header: Sequence[str], lines: str) -> None:
        day = datetime.fromtimestamp(time // NANOSECONDS, UTC).date()
        path = Path(name.replace("{date}", day.isoformat()))
        make_durably(path.parent)
        with path.open("a+b") as file:
            size = file.seek(0, os.SEEK_END)
            begin = ",".join(header) + "\n" if size == 0 and self._format is FileFormat.CSV else ""
            if is_cut_off(file):
                begin = "\n"
            file.write((begin + lines).encode())
            file.flush()
            os.fsync(file.fileno())
        if size == 0:
            sync_folder(path.parent)


def _write_parquet(folder: Path, name: str, columns: dict[str, Any]) -> None:  # columns of Arrow
    """Write columns to the file ``name.parquet`` in a folder, and replace a file of that name.

    After a crash the file is complete, or as it was before.
    """
    make_durably(folder)
    target = folder / f"{name}.parquet"
    unfinished = target.with_name(target.name + UNFINISHED)
    arrow("parquet").write_table(arrow().table(columns), unfinished, compression="zstd")
    sync_file(unfinished)
    unfinished.rename(target)
    sync_folder(folder)


def _columns(samples: Sequence[CommittedSample]) -> dict[str, Any]:  # columns of Arrow
    pa = arrow()
    return {
        "time": pa.array([sample.time for sample in samples], pa.timestamp("ns", "UTC")),
        "device": pa.array([sample.device for sample in samples]).dictionary_encode(),
        "point": pa.array([sample.point for sample in samples]).dictionary_encode(),
        **_value_columns([sample.value for sample in samples]),
        "reason": pa.array([sample.reason for sample in samples], pa.int16()),
        "half_width": pa.array([sample.half_width for sample in samples], pa.int64()),
        "commit": pa.array([sample.commit for sample in samples], pa.int64()),
    }


def _alarm_columns(alarms: Sequence[CommittedAlarm]) -> dict[str, Any]:  # columns of Arrow
    pa = arrow()
    events = [alarm.event for alarm in alarms]
    values = _value_columns([event.value for event in events])
    return {
        "time": pa.array([event.at for event in events], pa.timestamp("ns", "UTC")),
        "device": pa.array([event.device for event in events]),
        "point": pa.array([event.point for event in events]),
        "limit": pa.array([event.limit for event in events]),
        "event": pa.array([event.kind.value for event in events]),
        "value": values["value"],
        "integer": values["integer"],
        "value_text": values["text"],
        "text": pa.array([event.text for event in events]),
        "by": pa.array([event.by for event in events]),
        "commit": pa.array([alarm.commit for alarm in alarms], pa.int64()),
        "place": pa.array([alarm.place for alarm in alarms], pa.int32()),
    }


def _value_columns(values: Sequence[SampleValue | None]) -> dict[str, Any]:  # columns of Arrow
    pa = arrow()
    numbers = [None if each is None or isinstance(each, str) else float(each) for each in values]
    return {
        "value": pa.array(numbers, pa.float64()),
        "integer": pa.array([each if type(each) is int and each < 2**63 else None for each in values], pa.int64()),
        "text": pa.array([each if isinstance(each, str) else None for each in values], pa.string()),
    }


def _csv_lines(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _row(sample: CommittedSample) -> Sequence[object]:
    quality, reason = sample.quality.name.lower(), reason_text(sample.reason)
    value = "" if sample.value is None else sample.value
    return sample.time, sample.device, sample.point, value, quality, reason, sample.half_width, sample.commit


def _alarm_row(alarm: CommittedAlarm) -> Sequence[object]:
    event = alarm.event
    value = "" if event.value is None else event.value
    key = (event.at, event.device, event.point, event.limit, event.kind.value)
    return *key, value, event.text, event.by, alarm.commit, alarm.place


def _json_lines(contents: Iterable[dict[str, Any]]) -> str:
    return "".join(json.dumps(each) + "\n" for each in contents)


def _document(sample: CommittedSample) -> dict[str, Any]:
    return {"device": sample.device, "point": sample.point, **sample_document(sample), "commit": sample.commit}
