"""The plant of the chaos test: devices that write down what they are asked, and a probe of the coordinator's quorum.

usage: plant.py SETTINGS (a JSON file). Says ``ready``, then answers commands on stdin.
"""

import asyncio
import json
import os
import struct
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from busway.apps.fleet.coordinator import CoordinatorDown, OutcomeUnknown, RevisionConflict
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions

PROBE_EVERY = 0.2
LEADER_SECONDS = 25.0
"""An election takes about five seconds where the machine has time."""


class Devices:
    """One device for each link, on a port of its own; register 0 and 1 count its reads, 2 and 3 can be written."""

    def __init__(self, log: int) -> None:
        self._log = log
        self._reads: dict[str, int] = {}

    async def serve(self, link: str, address: str, port: int) -> None:
        await asyncio.start_server(lambda reader, writer: self._talk(link, reader, writer), address, port)

    async def _talk(self, link: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("peername")[0]
        try:
            while True:
                transaction, _, length, unit = struct.unpack(">HHHB", await reader.readexactly(7))
                pdu = await reader.readexactly(length - 1)
                reply = self._reply(link, peer, pdu)
                writer.write(struct.pack(">HHHB", transaction, 0, len(reply) + 1, unit) + reply)
        except (asyncio.IncompleteReadError, OSError):
            pass
        finally:
            writer.close()

    def _reply(self, link: str, peer: str, pdu: bytes) -> bytes:
        if pdu[0] == 3:
            start, count = struct.unpack(">HH", pdu[1:5])
            value = self._reads[link] = self._reads.get(link, 0) + 1
            self._note(link, peer, is_write=False, value=value if start == 0 else 0)
            words = [value >> 16, value & 0xFFFF, 0, 0][start : start + count]
            return bytes((3, 2 * count)) + struct.pack(f">{count}H", *words)
        if pdu[0] == 16:
            self._note(link, peer, is_write=True, value=struct.unpack(">I", pdu[6:10])[0])
            return pdu[:5]
        return bytes((pdu[0] | 0x80, 1))

    def _note(self, link: str, peer: str, *, is_write: bool, value: int) -> None:
        os.write(self._log, f"{json.dumps([time.time(), link, peer, is_write, value])}\n".encode())


class Probe:
    """Changes an entry every `PROBE_EVERY` seconds: the times of success show when there was a quorum."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self.successes: list[float] = []
        self.coordinator: Any = None

    async def run(self) -> None:
        self.coordinator = coordinator = await open_coordinator(
            self._settings["coordinator"], self._settings["zone"], CoordinatorOptions(**self._settings["options"])
        )
        revision = 0
        while True:
            try:
                value = b"%d" % time.time_ns()
                if revision:
                    revision = await coordinator.replace("probe", value, revision)
                else:
                    revision = await coordinator.create("probe", value)
                self.successes.append(time.time())
            except RevisionConflict:  # one without an answer was made
                revision = await self._present()
            except (CoordinatorDown, OutcomeUnknown):
                pass
            await asyncio.sleep(PROBE_EVERY)

    async def _present(self) -> int:
        """The revision of the entry, 0 where there is none."""
        watch = self.coordinator.watch("probe")
        try:
            return int((await anext(watch)).revision)
        finally:
            await watch.aclose()


async def leader(probe: Probe, stream: str) -> str:
    """The server that leads a stream; waits while none does."""
    nats = import_module("nats")
    until = time.monotonic() + LEADER_SECONDS
    info = None
    while True:
        try:
            info = await probe.coordinator.client.jetstream(timeout=2).stream_info(stream)
            if info.cluster.leader:
                return str(info.cluster.leader)
        except (nats.errors.Error, TimeoutError):
            if time.monotonic() > until:
                raise
        assert time.monotonic() < until, info
        await asyncio.sleep(PROBE_EVERY)


async def main(settings: dict[str, Any]) -> None:
    log = os.open(settings["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    devices, probe = Devices(log), Probe(settings)
    for link, port in settings["links"].items():
        await devices.serve(link, settings["address"], port)
    task = asyncio.create_task(probe.run())
    print("ready", flush=True)
    while line := await asyncio.to_thread(sys.stdin.readline):
        asked = json.loads(line)
        if asked["do"] == "leader":
            print(json.dumps({"leader": await leader(probe, asked["stream"])}), flush=True)
        else:
            assert not task.done(), task
            print(json.dumps({"successes": probe.successes}), flush=True)


asyncio.run(main(json.loads(Path(sys.argv[1]).read_text())))
