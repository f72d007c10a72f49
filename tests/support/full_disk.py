"""A program that collects on a small file system that becomes full and has room again; prints what came of it as JSON.

unshare -Urm sh -c 'mount -t tmpfs -o size=6m tmpfs FOLDER && exec python full_disk.py FOLDER'
"""

import json
import logging
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).parent))

from collected import at, meter_read

from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

READS = 4000


def main() -> None:
    logging.basicConfig(level=logging.CRITICAL)
    folder = Path(sys.argv[1])
    moment = at(0)
    writer = StoreWriter(folder / "store", StoreOptions(segment_size=200_000), now=moment)
    committer = Committer(writer, now=lambda: moment, interval=0.005, most_waiting=3000, retry=0.02)
    slowest, errors = 0.0, set()
    for number in range(READS):
        if number == 1000:
            fill(folder / "filler")
        if number == 3000:
            until = time.monotonic() + 10
            while committer.status().error is None and time.monotonic() < until:
                time.sleep(0.01)
            errors.add(committer.status().error)
            (folder / "filler").unlink()
        moment = at(number)
        before = time.monotonic()
        committer.add(meter_read(number, number))
        slowest = max(slowest, time.monotonic() - before)
        time.sleep(0.0002)
    flushed = committer.flush(30)
    status = committer.status()
    committer.close()
    table = Store(folder / "store").read()
    kept = [sample for sample in table if sample.value is not None]
    print(
        json.dumps(
            {
                "made": 3 * READS,
                "kept": len({(sample.point, sample.time) for sample in kept}),
                "twice": len(kept) - len({(sample.point, sample.time) for sample in kept}),
                "lost": status.lost,
                "in gaps": sum(gap.lost for gap in table.gaps),
                "flushed": flushed,
                "error then": [error or "" for error in errors],
                "error now": status.error,
                "slowest": slowest,
                "problems": check_store_files(folder / "store"),
            }
        )
    )


def fill(path: Path) -> None:
    """Take all room that there is."""
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            return


if __name__ == "__main__":
    main()
