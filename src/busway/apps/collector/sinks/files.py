"""Sink that writes files: CSV, JSON lines, Parquet.

Knows formats; knows nothing of cursors.

1. Lines are appended and made durable before `send` returns; a line that was cut off by a crash is completed by a line
   break first. A batch that comes again is there twice, with the same commit.
2. A Parquet file is one batch, and is called by its commits: a batch that comes again replaces its file.
3. ``{date}`` in the name of a file of lines is the day (UTC) of the first sample of the batch.
"""

import asyncio
import csv
import io
import json
import os
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from ....errors import ConfigError
from ....options.sinks import FileFormat
from ..samples import NANOSECONDS, reason_text
from ..store.committed_samples import CommittedSample
from ..store.folder import UNFINISHED, make_durably, sync_file, sync_folder
from ..store.sealing import arrow
from .documents import sample_document
from .interface import SinkDown

HEADER: Final = ("time", "device", "point", "value", "quality", "reason", "half_width", "commit")


class FileSink:
    """Sink that writes samples to files."""

    def __init__(self, path: str | os.PathLike[str], kind: FileFormat | str | None = None) -> None:
        """Set the path of the files to write; nothing is opened yet.

        Args:
            path: the file, with ``{date}`` for one a day; for Parquet a folder.
            kind: the format; None for what the name ends with.

        Raises:
            ConfigError: there is no such format.
        """
        self._path = os.fspath(path)
        given = kind or self._path.rpartition(".")[2].lower()
        try:
            found = FileFormat(given)
        except ValueError:
            raise ConfigError(f"files are csv, jsonl or parquet, not {given!r}", key="format") from None
        is_csv = found is FileFormat.CSV
        self._write = self._write_parquet if found is FileFormat.PARQUET else self._append
        self._lines: Callable[[Sequence[CommittedSample]], str] = _csv_lines if is_csv else _json_lines
        self._header = ",".join(HEADER) + "\n" if is_csv else ""

    async def open(self) -> None:
        """Do nothing: files are opened for each batch."""

    async def close(self) -> None:
        """Do nothing: no file stays open."""

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Append a batch of samples to the files, durably. Raises `SinkDown`."""
        try:
            await asyncio.to_thread(self._write, samples)
        except OSError as error:
            raise SinkDown(f"{self._path} cannot be written: {error.strerror or error}") from error

    def _append(self, samples: Sequence[CommittedSample]) -> None:
        day = datetime.fromtimestamp(samples[0].time // NANOSECONDS, UTC).date()
        path = Path(self._path.replace("{date}", day.isoformat()))
        make_durably(path.parent)
        with path.open("a+b") as file:
            size = file.seek(0, os.SEEK_END)
            begin = self._header if size == 0 else ""
            if size:
                file.seek(size - 1)
                begin = "" if file.read(1) == b"\n" else "\n"
            file.write((begin + self._lines(samples)).encode())
            file.flush()
            os.fsync(file.fileno())
        if size == 0:
            sync_folder(path.parent)

    def _write_parquet(self, samples: Sequence[CommittedSample]) -> None:
        pa = arrow()
        folder = Path(self._path)
        make_durably(folder)
        whole = [sample.value if type(sample.value) is int and sample.value < 2**63 else None for sample in samples]
        table = pa.table(
            {
                "time": pa.array([sample.time for sample in samples], pa.timestamp("ns", "UTC")),
                "device": pa.array([sample.device for sample in samples]).dictionary_encode(),
                "point": pa.array([sample.point for sample in samples]).dictionary_encode(),
                "value": pa.array([_float(sample) for sample in samples], pa.float64()),
                "integer": pa.array(whole, pa.int64()),
                "text": pa.array([sample.value if isinstance(sample.value, str) else None for sample in samples]),
                "reason": pa.array([sample.reason for sample in samples], pa.int16()),
                "half_width": pa.array([sample.half_width for sample in samples], pa.int64()),
                "commit": pa.array([sample.commit for sample in samples], pa.int64()),
            }
        )
        target = folder / f"{samples[0].commit:012d}-{samples[-1].commit:012d}.parquet"
        unfinished = target.with_name(target.name + UNFINISHED)
        arrow("parquet").write_table(table, unfinished, compression="zstd")
        sync_file(unfinished)
        unfinished.rename(target)
        sync_folder(folder)


def _float(sample: CommittedSample) -> float | None:
    return None if sample.value is None or isinstance(sample.value, str) else float(sample.value)


def _csv_lines(samples: Sequence[CommittedSample]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        (
            sample.time,
            sample.device,
            sample.point,
            "" if sample.value is None else sample.value,
            sample.quality.name.lower(),
            reason_text(sample.reason),
            sample.half_width,
            sample.commit,
        )
        for sample in samples
    )
    return text.getvalue()


def _json_lines(samples: Sequence[CommittedSample]) -> str:
    return "".join(
        json.dumps({"device": sample.device, "point": sample.point, **sample_document(sample), "commit": sample.commit})
        + "\n"
        for sample in samples
    )
