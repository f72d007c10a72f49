"""Checks the files of a store for damage, also while the store is being written.

Knows files and what the manifest says of them; changes nothing and takes no lock.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

from ....values.counts import counted
from .folder import COMMANDS, OWNERSHIP, SEGMENTS, UNFINISHED, holder_of
from .manifest import Manifest, StorePart
from .sealing import arrow, can_seal
from .segment import facts_of, is_unmade, open_for_reading

_TRIES: Final = 10


def check_store_files(folder: Path) -> list[str]:
    """Check the files beside a store's manifest, and return the problems found, one sentence each.

    They are the files with samples, the journal of commands, and the record of ownership of a fleet. An empty list if
    there are no problems. The check changes nothing, and works while the store is being written. A sealed file that
    cannot be checked, because pyarrow is not installed, is a problem too.

    Raises:
        ConfigError: there is no store, or its manifest cannot be read.
    """
    with closing(Manifest(folder)) as manifest:
        for _ in range(_TRIES):
            try:
                return list(_problems(folder, manifest))
            except FileNotFoundError:  # a part was sealed meanwhile: from the start
                continue
        return list(_problems(folder, manifest, tolerant=True))


def _problems(folder: Path, manifest: Manifest, *, tolerant: bool = False) -> Iterator[str]:
    parts = manifest.parts()
    seen: dict[int, str] = {}
    for part in parts:
        path = folder / SEGMENTS / part.file
        if not path.exists():
            if part.kind == "open" and holder_of(folder) is not None:
                continue  # listed, and not made yet
            if not tolerant and not any(each.file == part.file for each in manifest.parts()):
                raise FileNotFoundError(part.file)
            lost = ": it is lost, or a collector was killed before it made it" if part.kind == "open" else ""
            yield f"{part.file} is listed, but the file is not there{lost}"
            continue
        if part.kind == "sealed":
            yield from _problems_of_sealed(path, part, manifest)
        else:
            yield from _problems_of_segment(path, part, manifest)
        if part.first_commit is not None and part.kind != "sealed":
            other = seen.setdefault(part.first_commit, part.file)
            if other != part.file:
                yield f"{part.file} and {other} have the same commits"
    for name in (COMMANDS, OWNERSHIP):
        if (folder / name).exists():
            yield from _problems_of_record(folder / name)
    listed = {part.file for part in manifest.parts()} | {part.file for part in parts} | set(manifest.files_to_unlink())
    for path in sorted((folder / SEGMENTS).iterdir()):
        name = path.name.removesuffix("-wal").removesuffix("-shm")
        if path.name.endswith(UNFINISHED):
            continue  # what a process was writing that has ended: the next start removes it
        if name not in listed and path.exists() and holder_of(folder) is None:
            yield f"{path.name} is in the folder, but not listed"


def _problems_of_record(path: Path) -> Iterator[str]:
    try:
        with closing(open_for_reading(path)) as database:
            for (sentence,) in database.execute("PRAGMA quick_check(5)"):
                if sentence != "ok":
                    yield f"{path.name} is damaged: {sentence}"
    except sqlite3.DatabaseError as error:
        yield f"{path.name} cannot be read: {error}"


def _problems_of_segment(path: Path, part: StorePart, manifest: Manifest) -> Iterator[str]:
    try:
        with closing(open_for_reading(path)) as database:
            database.execute("BEGIN")
            for (sentence,) in database.execute("PRAGMA quick_check(5)"):
                if sentence != "ok":
                    yield f"{part.file} is damaged: {sentence}"
            facts = facts_of(database, part, 0)
            (rows,) = database.execute("SELECT count(*) FROM samples").fetchone()
            if part.kind == "closed" and part.rows != facts.rows:
                yield f"{part.file} has {counted(facts.rows or 0, 'sample')}, but {part.rows} are listed"
            if rows > (facts.rows or 0):
                yield f"{part.file} has {counted(rows, 'sample')}, but its commits made {facts.rows}"
            yield from _unlisted(
                part, {row[0] for row in database.execute("SELECT DISTINCT point FROM samples")}, manifest
            )
    except sqlite3.DatabaseError as error:
        if part.kind == "open" and isinstance(error, sqlite3.OperationalError) and is_unmade(error):
            return
        yield f"{part.file} cannot be read: {error}"


def _unlisted(part: StorePart, found: set[int], manifest: Manifest) -> Iterator[str]:
    """Yield a sentence if a file of the store has samples of points that the manifest does not list.

    The manifest is read after the samples, because a point is listed before its first sample is written.

    Args:
        part: the file.
        found: ids of the points that have samples in it.
        manifest: the manifest of the store.
    """
    unlisted = found - {point.id for point in manifest.points()}
    if unlisted:
        yield f"{part.file} has samples of points that are not listed: {sorted(unlisted)[:5]}"


def _problems_of_sealed(path: Path, part: StorePart, manifest: Manifest) -> Iterator[str]:
    if not can_seal():
        yield f"{part.file} cannot be checked without pyarrow: pip install 'busway[store]'"
        return
    try:
        table = arrow("parquet").read_table(path, columns=["point", "time"])
    except (OSError, ValueError) as error:  # pyarrow's own errors are these
        yield f"{part.file} cannot be read: {error}"
        return
    if table.num_rows != part.rows:
        yield f"{part.file} has {counted(table.num_rows, 'sample')}, but {part.rows} are listed"
    yield from _unlisted(part, set(arrow("compute").unique(table["point"]).to_pylist()), manifest)
    bounds = arrow("compute").min_max(table["time"].cast("int64")).as_py()
    if (bounds["min"], bounds["max"]) != (part.low, part.high):
        yield f"{part.file} has other times than are listed"
