"""Sealing: turns a finished segment into Parquet files, sorted by point and time, a tenth of its size or less.

Knows the steps and their order; knows nothing of commits that are made meanwhile, nor of the content of a file.

1. Another process writes the files (`sealed_writer`): polling and commits go on beside it, and its memory ends with it.
2. The files are written under unfinished names, their content is made durable, they are renamed, and the folder is made
   durable. Then one transaction of the manifest lists them instead of the segment, and the segment is deleted. If the
   process ends anywhere between, nothing is lost and nothing counts twice, because the manifest alone decides what
   counts.
3. pyarrow and Arrow's driver for SQLite are needed (``busway[store]``). Without them segments stay SQLite files.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from ....extras import require
from .folder import SEGMENTS, UNFINISHED, sync_folder, unlink_part
from .manifest import Manifest, StorePart
from .segment import intervals_of, open_for_reading

StepDone = Callable[[str], None]
"""A function that is called with the name of each step when the step is done; tests end the process there."""

_LONGEST: Final = 1800
"""Most seconds that the process that writes the Parquet files may take for one segment."""


class SealingFailed(OSError):
    """Error: the process that converts a finished segment file to Parquet failed; the segment is unchanged."""


def can_seal() -> bool:
    """Whether the packages that convert segments to Parquet (pyarrow and Arrow's driver for SQLite) are installed."""
    return find_spec("pyarrow") is not None and find_spec("adbc_driver_sqlite") is not None


def arrow(module: str = "") -> Any:  # pyarrow has no types of its own
    """Import and return pyarrow, or one of its modules.

    Args:
        module: name of the module, such as ``parquet``; empty for pyarrow itself.

    Raises:
        MissingExtra: pyarrow is not installed.
    """
    require("pyarrow", "a sealed part of the store")
    return import_module(f"pyarrow{'.' * bool(module)}{module}")


def seal(folder: Path, manifest: Manifest, part: StorePart, step: StepDone) -> list[StorePart]:
    """Turn a closed segment into Parquet files, list them in the manifest in its place, and delete the segment file.

    Args:
        folder: the folder of the store.
        manifest: its manifest.
        part: the closed segment.
        step: called with the name of each step when it is done.

    Returns:
        The sealed parts; empty for a segment without samples.

    Raises:
        SealingFailed: the Parquet files could not be written; the segment is unchanged.
        OSError, sqlite3.Error: a file or the manifest could not be written; no samples are lost.
    """
    source = folder / SEGMENTS / part.file
    with closing(open_for_reading(source)) as database:
        intervals = intervals_of(database)
    written = _written(source, manifest.point_texts(), step)
    step("seal-written")
    for unfinished, sealed in written:
        unfinished.rename(source.with_name(sealed["file"]))
    step("seal-renamed")
    sync_folder(source.parent)
    step("seal-folder-synced")
    parts = [StorePart(id=0, segment=part.segment, kind="sealed", alive=part.alive, **sealed) for _, sealed in written]
    manifest.replace_part(part, parts, intervals)
    step("seal-listed")
    remove_unlisted(folder, manifest)
    step("seal-unlinked")
    return parts


def _written(
    source: Path, points: list[tuple[int, str, str, str]], step: StepDone
) -> list[tuple[Path, dict[str, Any]]]:
    """Let another process write the Parquet files of a segment file, and wait for its end.

    Returns:
        For each file its present, unfinished path, and its entry for the manifest.

    Raises:
        SealingFailed: the process failed or took too long.
    """
    asked = {
        "segment": os.fspath(source),
        "parent": os.getpid(),
        "points": points,
    }
    command = [*_interpreter(), "-m", f"{__package__}.sealed_writer"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, encoding="utf-8") as process:
        step("seal-begun")
        try:
            answer, complaint = process.communicate(json.dumps(asked), timeout=_LONGEST)
        except subprocess.TimeoutExpired as error:
            raise SealingFailed(f"{source.name} could not be sealed within {_LONGEST} s") from error
        finally:
            process.kill()  # one that has ended is left alone
    if process.returncode:
        reason = complaint.strip().splitlines()[-1:] or [f"it ended with {process.returncode}"]
        raise SealingFailed(f"{source.name} could not be sealed: {reason[0]}")
    return [(Path(unfinished), sealed) for unfinished, sealed in json.loads(answer)]


def _interpreter() -> list[str]:
    """Return the command that starts this Python again, importing modules from the same places as this process."""
    is_own = any(path in ("", os.getcwd()) for path in sys.path)
    return [sys.executable] if is_own else [sys.executable, "-P"]


def remove_unlisted(folder: Path, manifest: Manifest) -> None:
    """Delete the files that the manifest lists as to be deleted, and remove them from that list.

    Raises:
        OSError, sqlite3.Error: a file or the manifest could not be written; the next call tries again.
    """
    for file in manifest.files_to_unlink():
        unlink_part(folder / SEGMENTS / file)
        manifest.unlinked(file)


def remove_unfinished(folder: Path, manifest: Manifest) -> None:
    """Delete Parquet files that a crash left unfinished or not listed yet; the segment file still has their samples."""
    parts = manifest.parts()
    listed = {part.file for part in parts}
    segments = {part.file.removesuffix(".sqlite") for part in parts if part.kind != "sealed"}
    for path in (folder / SEGMENTS).iterdir():
        is_left_over = path.suffix == ".parquet" and path.name not in listed and path.name[:8] in segments
        if path.name.endswith(UNFINISHED) or is_left_over:
            path.unlink(missing_ok=True)
