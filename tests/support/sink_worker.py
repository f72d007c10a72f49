"""A program that collects into a store and hands it on to a file; ended by the test that started it.

    python sink_worker.py FOLDER FIRST COUNT

Commits reads FIRST to FIRST + COUNT of the meter in a thread, at most `AHEAD` samples before a sink, which writes
``FOLDER/sent.jsonl``; prints "done" when all are committed and sent.
"""

import os
import sys
import time
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).parent))

from collected import at, meter_read

from busway.apps.collector.sinks.delivery import DeliveryOptions
from busway.apps.collector.sinks.files import FileSink
from busway.apps.collector.sinks.sink_thread import SinkThread
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

AHEAD = 3000


def main() -> None:
    folder, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    now = at(first)
    writer = StoreWriter(folder, StoreOptions(segment_size=100_000), now=now)
    committer = Committer(writer, now=lambda: now, interval=0.002)
    options = DeliveryOptions(age=0.0, most=50, keep=1e9)
    sinks = SinkThread(writer, {"file": (FileSink(folder / "sent.jsonl"), options)})
    print("ready", flush=True)
    for number in range(first, first + count):
        now = at(number)
        committer.add(meter_read(number, number))
        while 3 * (number - first) > sinks.statuses()[0].sent + AHEAD:
            time.sleep(0.001)
        if number % 500 == 0:
            writer.seal_closed()
    committer.flush()
    last = committer.writer.commit([], [], now).number
    while sinks.statuses()[0].cursor < last:
        time.sleep(0.01)
    sinks.close()
    committer.close()
    print("done", flush=True)


if __name__ == "__main__":
    main()
