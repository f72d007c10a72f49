"""``durability = power``: what was handed on is in the store wherever the power fails.

A program writes, seals and drops while its writes are recorded; then the record is cut at many points, and each
folder that a power failure could have left there is opened and compared with what was handed on before the cut.
"""

import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import store_worker
from missing_peers import preloadable
from power_failure import SOURCE, PowerFailure, Record, environment, lay_out, records_of
from store_checker import check_after_crash

from busway.apps.collector.store.committer import SYNC
from busway.apps.collector.store.folder import MANIFEST

pytest.importorskip("pyarrow")

CUTS = 25


def recorded(folder: Path, durability: str, *options: str) -> tuple[Path, list[Record]]:
    store = folder / "store"
    store.mkdir()
    log = folder / "log"
    command = [
        sys.executable,
        store_worker.__file__,
        str(store),
        "--durability",
        durability,
        "--commits",
        "10",
        *options,
    ]
    subprocess.run(command, env=environment(preloadable(SOURCE, folder), store, log), check=True, timeout=60)
    return store, records_of(log)


def cuts(
    records: list[Record], store: Path, seed: int, *, each_time_handed_on: bool = False
) -> Iterator[tuple[int, PowerFailure, list[int]]]:
    """Points at which the power fails, the state there, and what was handed on before."""
    moments = random.Random(seed)
    wanted = set(moments.sample(range(len(records)), CUTS))
    if each_time_handed_on:
        handing = str(store / store_worker.HANDED_ON)
        wanted |= {index for index, each in enumerate(records) if (each.path, each.operation) == (handing, "w")}
    state, handed_on = PowerFailure(), []
    for index, record in enumerate(records):
        if record.path == str(store / store_worker.HANDED_ON):
            handed_on += [int(record.data)] if record.operation == "w" else []
        else:
            state.apply(record)
        if index in wanted:
            yield index, state, handed_on


def test_the_record_has_commits_syncs_renames_and_unlinks(tmp_path: Path) -> None:
    store, records = recorded(tmp_path, "power")
    assert {record.operation for record in records} == set("cwtsdru") - ({"t"} - {r.operation for r in records})
    state = PowerFailure()
    for record in records:
        state.apply(record)
    for name, content in state.names.items():
        if name.endswith((".parquet", ".sqlite")):
            assert not content.pending, name
            assert Path(name).read_bytes() == content.durable
    assert str(store / MANIFEST) in state.durable_names


@pytest.mark.parametrize("durability", [("power",), ("process", "--sync")], ids=["power", "process, synced"])
def test_what_was_handed_on_survives_a_power_failure_anywhere(tmp_path: Path, durability: tuple[str, ...]) -> None:
    store, records = recorded(tmp_path, *durability)
    for index, state, handed_on in cuts(records, store, 7):
        for variant in range(2):
            target = tmp_path / f"{index}-{variant}"
            target.mkdir()
            lay_out(state.left(random.Random(index) if variant else None), store, target)
            check_after_crash(target, handed_on, begins=10_000)
            shutil.rmtree(target)


def test_without_it_a_power_failure_costs_the_end_and_leaves_a_whole_store(tmp_path: Path) -> None:
    store, records = recorded(tmp_path, "process")
    lost = 0
    for index, state, handed_on in cuts(records, store, 1, each_time_handed_on=True):
        lost += lost_after(state, store, tmp_path / str(index), handed_on)
    assert lost > 0, "then this test would show nothing"


def test_with_durability_process_a_power_failure_costs_five_seconds_at_most(tmp_path: Path) -> None:
    """Each commit is a quarter of a second after the one before, on the committer's clock; what is lost is a gap."""
    every = 0.25
    store, records = recorded(tmp_path, "process", "--commits", "60", "--every", str(every))
    most = 0
    for index, state, handed_on in cuts(records, store, 3, each_time_handed_on=True):
        most = max(most, lost_after(state, store, tmp_path / str(index), handed_on))
    assert SYNC / every * 0.9 <= most <= SYNC / every, f"{most * every} s were lost at most"


def lost_after(state: PowerFailure, store: Path, target: Path, handed_on: list[int]) -> int:
    """How many of the commits a power failure costs; the store that it leaves is whole. It is laid out in a folder."""
    target.mkdir()
    lay_out(state.left(None), store, target)
    kept = kept_of(target, handed_on)
    check_after_crash(target, kept, begins=10_000, crashes=1)
    shutil.rmtree(target)
    return len(handed_on) - len(kept)


def kept_of(folder: Path, handed_on: list[int]) -> list[int]:
    """Those of the commits that are in the store: all up to one, and none after it."""
    from collected import NOON, SECOND

    from busway.apps.collector.store.store_reader import Store
    from busway.apps.collector.store.writer import StoreWriter

    copy = folder.with_name(folder.name + "-copy")
    shutil.copytree(folder, copy)
    StoreWriter(copy, now=NOON + 10**6 * SECOND).__exit__()
    found = {
        (sample.time - NOON) // SECOND // store_worker.SECONDS_PER_COMMIT
        for sample in Store(copy).read()
        if sample.value is not None
    }
    shutil.rmtree(copy)
    kept = [number for number in handed_on if number in found]
    assert kept == handed_on[: len(kept)], "a commit is missing before one that is there"
    return kept
