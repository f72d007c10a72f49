"""A collector that is killed while it hands samples on: what was sent is in the store, and in the end all is sent."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
import sink_worker
from waiting import wait_until

from busway.apps.collector.store.store_reader import Store

pytest.importorskip("pyarrow")
EACH = 100_000
MOST_BYTES = 300_000
"""Of samples that are sent between two kills: some segments are sealed meanwhile."""


def size_of(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def sent(folder: Path) -> list[tuple[str, int]]:
    """Point and time of each line that was written whole, in order."""
    path = folder / "sent.jsonl"
    found = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            content = json.loads(line)
        except ValueError:  # cut by a kill; it comes again
            continue
        found.append((content["point"], content["time"]))
    return found


def stored(folder: Path) -> set[tuple[str, int]]:
    return {(sample.point, sample.time) for sample in Store(folder).read() if sample.value is not None}


@pytest.mark.parametrize("seed", range(2))
def test_what_was_sent_is_in_the_store_and_all_of_the_store_is_sent_in_the_end(tmp_path: Path, seed: int) -> None:
    moments, path = random.Random(seed), tmp_path / "sent.jsonl"
    for run in range(3):
        command = [sys.executable, sink_worker.__file__, str(tmp_path), str(run * EACH), str(EACH)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as worker:
            assert worker.stdout is not None
            assert worker.stdout.readline() == b"ready\n"
            wanted = size_of(path) + moments.randrange(MOST_BYTES)
            wait_until(lambda wanted=wanted: size_of(path) >= wanted, 60)
            worker.kill()
        assert set(sent(tmp_path)) <= stored(tmp_path)
    command = [sys.executable, sink_worker.__file__, str(tmp_path), str(4 * EACH), "100"]
    assert subprocess.run(command, capture_output=True, timeout=100, check=True).stdout == b"ready\ndone\n"
    lines = sent(tmp_path)
    assert set(lines) == stored(tmp_path)
    for point in {point for point, _ in lines}:
        times = list(dict.fromkeys(time for name, time in lines if name == point))
        assert times == sorted(times)
