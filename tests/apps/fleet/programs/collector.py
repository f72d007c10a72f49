"""One collector of the chaos test. It writes down each commit that it was told of, and the outcome of each write.

usage: collector.py SETTINGS (a JSON file). Says ``ready``, then answers commands on stdin: ``away`` parts it from its
coordinator for some seconds, ``end`` ends it in order. ``mutant`` in the settings breaks one rule.
"""

import asyncio
import json
import logging
import os
import random
import sqlite3
import sys
import time
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

from busway.apps.collector.configuration import load_collector
from busway.apps.collector.store.writer import Commit
from busway.apps.fleet.coordinator import Coordinator, CoordinatorDown, Entry, OutcomeUnknown
from busway.apps.fleet.coordinators import local, open_coordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.streams import NatsStream, StreamOptions, make_stream
from busway.errors import ModbusError


class Parted:
    """A coordinator that can be away for some seconds: nothing comes from it, and what goes there is lost."""

    def __init__(self, inner: Coordinator) -> None:
        self._inner = inner
        self._away_until = 0.0

    def leave(self, seconds: float) -> None:
        self._away_until = time.monotonic() + seconds

    async def _back(self) -> None:
        await asyncio.sleep(max(0.0, self._away_until - time.monotonic()))

    def _refuse(self) -> None:
        if time.monotonic() < self._away_until:
            raise CoordinatorDown("it is away")

    async def create(self, key: str, value: bytes) -> int:
        self._refuse()
        return await self._inner.create(key, value)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        self._refuse()
        made = await self._inner.replace(key, value, revision)
        if time.monotonic() < self._away_until:
            raise OutcomeUnknown("the answer is lost")
        return made

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        entries = self._inner.watch(prefix)
        try:
            async for entry in entries:
                await self._back()
                yield entry
        finally:
            await entries.aclose()

    async def close(self) -> None:
        await self._inner.close()


def mutate(name: str) -> None:
    """Break a rule of the product."""
    if name == "no deadline":
        LeaseTimes.deadline = lambda self, asked: float("inf")  # type: ignore[method-assign]
    elif name == "no compare-and-set":
        honest = local._changed

        def careless(database: sqlite3.Connection, key: str, value: bytes, revision: int | None) -> int:
            row = database.execute("SELECT revision FROM entries WHERE key = ?", (key,)).fetchone()
            return honest(database, key, value, None if row is None else int(row[0]))

        local._changed = careless
        local.LOOK_EVERY = 1.0  # type: ignore[misc]  # a slow watch, which harms nothing where changes compare


class Worker:
    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings
        self.log = os.open(settings["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self.writes = settings["first_write"]

    def note(self, *what: Any) -> None:
        os.write(self.log, f"{json.dumps(what)}\n".encode())

    def told(self, commit: Commit) -> None:
        rows = [
            (batch.device, value)
            for batch in commit.batches
            for point, value, reason in zip(batch.points, batch.values, batch.reason_column(), strict=True)
            if point == "count" and not reason
        ]
        if rows:
            self.note("commit", rows)

    async def write(self, fleet: FleetCollector) -> None:
        """Write a value of its own to one of the owned links, now and then."""
        while True:
            await asyncio.sleep(self.settings["write_every"])
            owned = sorted(fleet.collector.loads())
            if owned:
                self.writes += 1
                value, link = self.writes, random.choice(owned)
                self.note("writes", value)
                try:
                    result = await fleet.collector.write(link, "setpoint", value, by="chaos")
                    self.note("written", value, result.state.value)
                except ModbusError as error:
                    self.note("refused", value, str(error))

    async def run(self) -> None:
        settings = self.settings
        options = CoordinatorOptions(**settings["options"])
        inner = await open_coordinator(settings["coordinator"], settings["zone"], options)
        coordinator = Parted(inner)
        stream, tasks = None, []
        if settings["stream"]:
            await make_stream(
                inner.client, settings["zone"], StreamOptions(replicas=settings["options"].get("replicas", 1))
            )  # type: ignore[attr-defined]
            stream = NatsStream(inner.client, settings["zone"], timeout=2.0)  # type: ignore[attr-defined]
            tasks.append(asyncio.create_task(stream.watch_cursors(coordinator)))
        fleet = FleetCollector(
            load_collector(settings["file"]),
            coordinator,
            settings["name"],
            host=settings["name"],
            shards=settings["shards"],
            times=LeaseTimes(**settings["times"]),
            stream=stream,
        )
        async with fleet:
            fleet.collector.subscribe(self.told)
            tasks.append(asyncio.create_task(self.write(fleet)))
            print("ready", flush=True)
            while line := await asyncio.to_thread(sys.stdin.readline):
                asked = json.loads(line)
                if asked["do"] == "away":
                    coordinator.leave(asked["seconds"])
                    print("{}", flush=True)
                elif asked["do"] == "kept":
                    await fleet.collector.flush()
                    status = None if fleet.outbox is None else fleet.outbox.status()
                    newest = fleet.collector.newest_commit
                    print(json.dumps({"newest": newest, "kept": None if status is None else status.kept}), flush=True)
                elif asked["do"] == "end":
                    break
            tasks.pop().cancel()
        for task in tasks:
            task.cancel()
        await inner.close()
        print("{}", flush=True)


wanted = json.loads(Path(sys.argv[1]).read_text())
logging.basicConfig(filename=f"{wanted['log']}.txt", format="%(asctime)s %(name)s %(message)s")
mutate(wanted["mutant"])
asyncio.run(Worker(wanted).run())
