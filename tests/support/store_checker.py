"""The checker: every sample that was handed on is in the store once, and the time without samples is a gap."""

from collections import Counter
from pathlib import Path

from collected import METER, NOON, SECOND, at
from store_worker import HANDED_ON, READS_PER_COMMIT, SECONDS_PER_COMMIT

from busway.apps.collector.samples import Gap
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter


def handed_on(folder: Path) -> list[int]:
    """Numbers of the commits whose samples were handed on; an unfinished last line does not count."""
    path = folder / HANDED_ON
    text = path.read_text() if path.exists() else ""
    return [int(line) for line in text.split("\n")[:-1] if line]


def check_after_crash(folder: Path, numbers: list[int], *, begins: int, crashes: int = 1) -> list[Gap]:
    """Open the store again after a crash, and compare it with what was handed on; the gaps that it tells.

    Args:
        folder: the store.
        numbers: commits that were handed on, and that must be there.
        begins: seconds after `NOON` at which the store is opened again.
        crashes: how many there were before.
    """
    StoreWriter(folder, StoreOptions(), now=at(begins)).close(at(begins))
    table = Store(folder).read()
    kept = Counter((sample.point, sample.time, sample.value) for sample in table if sample.value is not None)
    assert not [key for key, count in kept.items() if count > 1], "a sample is there twice"
    commits = Counter((time - NOON) // SECOND // SECONDS_PER_COMMIT for _, time, _ in kept)
    whole = READS_PER_COMMIT * len(METER.points)
    assert {number: commits.get(number) for number in numbers} == dict.fromkeys(numbers, whole)
    assert set(commits.values()) <= {whole}, "half of a commit is there"
    assert len(commits) <= len(numbers) + crashes, "only the commit at the crash may be there without having been told"
    last = max((time for _, time, _ in kept), default=None)
    if last is not None:
        assert any(gap.begin >= last and gap.end == at(begins) for gap in table.gaps), (
            "no gap where samples are missing"
        )
    return table.gaps
