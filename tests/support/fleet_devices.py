"""Devices of a plant on plain sockets, which write down every request: who asked, when, and for what."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.fleet.lease_times import LeaseTimes

TIMES = LeaseTimes(ttl=3.0, renew=0.4, guard=0.3, answer=0.8)
LONG_TIMES = LeaseTimes(ttl=30.0, renew=0.4, guard=0.3, answer=0.8)
"""Of leases that do not lapse while a machine pauses."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One request on the wire of a device."""

    at: float
    peer: int
    function: int
    address: int


@dataclass
class FleetDevice:
    """A device whose registers 0 and 1 count its reads; it notes when connections end, and of which peer."""

    name: str
    port: int = 0
    asked: list[Asked] = field(default_factory=list)
    ended: list[tuple[float, int]] = field(default_factory=list)
    written: list[tuple[int, int]] = field(default_factory=list)
    reads: int = 0
    talks: dict[asyncio.Task[None], asyncio.StreamWriter] = field(default_factory=dict)

    async def serve(self) -> asyncio.Server:
        server = await asyncio.start_server(self._talk, "127.0.0.1", self.port)
        self.port = server.sockets[0].getsockname()[1]
        return server

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("peername")[1]
        talk = cast("asyncio.Task[None]", asyncio.current_task())
        self.talks[talk] = writer
        talk.add_done_callback(self.talks.pop)
        try:
            while True:
                head = await reader.readexactly(7)
                transaction, _, length, unit = struct.unpack(">HHHB", head)
                pdu = await reader.readexactly(length - 1)
                function, address = pdu[0], struct.unpack(">H", pdu[1:3])[0]
                self.asked.append(Asked(asyncio.get_running_loop().time(), peer, function, address))
                reply = self._reply(function, address, pdu)
                writer.write(struct.pack(">HHHB", transaction, 0, len(reply) + 1, unit) + reply)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self.ended.append((asyncio.get_running_loop().time(), peer))
            writer.close()

    async def end(self) -> None:
        """Close what is left of its connections, and wait until nothing of them runs."""
        while self.talks:
            for writer in self.talks.values():
                writer.close()
            await asyncio.wait(list(self.talks))

    def _reply(self, function: int, address: int, pdu: bytes) -> bytes:
        if function == 3:
            self.reads += 1
            count = struct.unpack(">H", pdu[3:5])[0]
            values = [(self.reads >> 16) & 0xFFFF, self.reads & 0xFFFF, *range(2, 120)]
            return bytes((3, 2 * count)) + struct.pack(f">{count}H", *values[address : address + count])
        if function in (6, 16):
            self.written.append((address, struct.unpack(">H", pdu[-2:])[0]))
            return pdu[:5]
        return bytes((function | 0x80, 1))

    def owners(self) -> list[int]:
        """The peers that asked, in order, each run of requests of one peer once."""
        found: list[int] = []
        for each in self.asked:
            if not found or found[-1] != each.peer:
                found.append(each.peer)
        return found


METER = """
[[unit]]
[[unit.point]]
name = "count"
address = "4x1"
type = "uint32"
"""


def plant(store: Path, devices: list[FleetDevice], options: str = "timeout = 0.5\nconnect_timeout = 0.5") -> str:
    (store.parent / "meter.toml").write_text(METER)
    text = f'[collector]\nstore = "{store}"\n[poll_class]\nfast.period = 0.1\n'
    for device in devices:
        text += f"""
[[link]]
name = "{device.name}"
url = "tcp://127.0.0.1:{device.port}"
{options}
[[device]]
name = "{device.name}"
link = "{device.name}"
unit = 1
profile = "{store.parent / "meter.toml"}"
poll_class = "fast"
"""
    return text


def parsed(tmp_path: Path, name: str, devices: list[FleetDevice]) -> CollectorConfiguration:
    return parse_collector(plant(tmp_path / name, devices), f"{name}.toml")


@contextlib.asynccontextmanager
async def devices_of(count: int) -> AsyncIterator[list[FleetDevice]]:
    devices = [FleetDevice(f"link-{number}") for number in range(count)]
    servers = [await device.serve() for device in devices]
    try:
        yield devices
    finally:
        for server in servers:
            server.close()
        for device in devices:
            await device.end()
