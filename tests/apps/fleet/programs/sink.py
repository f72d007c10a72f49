"""The sink of the chaos test: a durable consumer of the stream that keeps samples in an SQLite file.

usage: sink.py SETTINGS (a JSON file). Says ``ready``. ``mutant`` in the settings makes it acknowledge too early.
"""

import asyncio
import json
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.streams import StreamOptions, StreamSink

SCHEMA = (
    "CREATE TABLE IF NOT EXISTS rows (device, point, time INTEGER, value, reason, PRIMARY KEY (device, point, time))"
)


class KeepingSink:
    def __init__(self, path: str, slow: float) -> None:
        self._path, self._slow = path, slow

    async def open(self) -> None:
        self._database = sqlite3.connect(self._path)
        self._database.execute("PRAGMA journal_mode=WAL")
        self._database.execute(SCHEMA)

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        await asyncio.sleep(self._slow)
        with self._database:
            self._database.executemany(
                "INSERT OR REPLACE INTO rows VALUES (?, ?, ?, ?, ?)",
                [(each.device, each.point, each.time, each.value, each.reason) for each in samples],
            )

    async def close(self) -> None:
        pass


class AcknowledgesTooEarly(StreamSink):
    """Writes its cursor and acknowledges before the sink has committed."""

    async def _take(self, jetstream: Any, stream: str, found: Any) -> None:
        messages = list(found)
        read = [(each, self._read(each)) for each in messages]
        for message, each in read:
            self._progress.take(message.metadata.sequence.stream, each)
            await message.ack()
        await self._write_cursors()
        await self._client.flush(timeout=5)
        await self._send([sample for _, each in read if each is not None for sample in each.samples])


async def main(settings: dict[str, Any]) -> None:
    kind = AcknowledgesTooEarly if settings["mutant"] == "acknowledgement too early" else StreamSink
    coordinator: Any = await open_coordinator(
        settings["coordinator"], settings["zone"], CoordinatorOptions(**settings["options"])
    )
    options = StreamOptions(replicas=settings["options"].get("replicas", 1))
    sink = KeepingSink(settings["rows"], settings["slow"])
    await sink.open()
    print("ready", flush=True)
    await kind(coordinator.client, coordinator, settings["zone"], "keeping", sink, options=options).run()


asyncio.run(main(json.loads(Path(sys.argv[1]).read_text())))
