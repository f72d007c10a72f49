"""``busway fleet demo``: three collectors share a plant of 200 devices, and one of them is killed.

1. Everything is on loopback and in a temporary folder, which is removed at the end. It starts a nats-server of its own.
2. Collectors and sink are separate processes, started by ``busway fleet run`` and ``sink``. All are ended, also after
   Ctrl-C. On Linux the system ends them if the demonstration is killed; its folder is left then.
3. The demonstration ends when its scenes are over. The times that it prints were measured while it ran.
"""

import asyncio
import json
import os
import shutil
import struct
import subprocess
import sys
import time
from collections import Counter
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from ..errors import ConfigError, LinkDown
from ..extras import require
from ..values.counts import counted
from .output import say
from .signals import on_hangup, stop_event

if TYPE_CHECKING:
    from ..apps.fleet.zone_watch import ZoneWatch
    from ..server.device import Device

COLLECTORS: Final = ("west", "middle", "east")
KILLED: Final = "west"
LINKS, UNITS = 20, 10
SHARDS: Final = 256
"""Number of shards of the zone, the default of `busway fleet run`."""
SERVER_FOLDERS: Final = "/usr/sbin:/usr/local/sbin:/usr/local/bin"
"""Folders in which nats-server is searched after those of ``PATH``; Debian installs it into the first."""
START_SECONDS: Final = 60.0
ENDS_IN: Final = 8.0
"""Seconds that a process may take to end after SIGTERM; then it is killed."""
CALM: Final = 6.0
"""Seconds between two scenes of the demonstration."""
_END_WITH_PARENT: Final = """\
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""
"""Program that becomes another one, which the system (Linux) ends with SIGTERM as soon as the parent process has died.

Its arguments are the number of the parent process, and the path and arguments of the other program.
"""
PROFILE = """\
[[unit]]
[[unit.point]]
name = "power"
address = "4x1"
type = "float32"
[[unit.point]]
name = "energy"
address = "4x3"
type = "uint32"
"""
FILE = """\
[collector]
clock = "trusted"
store = "{folder}/store"
page = "127.0.0.1:0"

[poll_class]
all.period = 1.0

[[sink]]
name = "archive"
url = "file://{folder}/archive.jsonl"
"""
LINK = """
[[link]]
name = "line-{number}"
url = "{url}"
timeout = 1.0
"""
DEVICE = """
[[device]]
name = "meter-{number}-{unit}"
link = "line-{number}"
unit = {unit}
profile = "meter.toml"
"""


async def fleet_demo(limit: float) -> None:
    """Run the fleet's demonstration until its scenes are over, ``limit`` seconds have passed, or a signal comes.

    Raises:
        MissingExtra: a package for NATS is not installed.
        ConfigError: nats-server is not installed.
        LinkDown: a process does not start, or ends too early.
    """
    require("nats", "busway fleet demo")
    require("msgpack", "busway fleet demo")
    program = shutil.which("nats-server") or shutil.which("nats-server", path=SERVER_FOLDERS)
    if program is None:
        raise ConfigError("is not installed: apt-get install nats-server", key="nats-server")
    with stop_event() as stop, on_hangup(stop.set):
        async with AsyncExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="busway-fleet-demo-")))
            demo = FleetDemo(stack, folder)
            playing = asyncio.create_task(demo.play(program))
            stopped = asyncio.create_task(stop.wait())
            await asyncio.wait({playing, stopped}, timeout=limit, return_when=asyncio.FIRST_COMPLETED)
            stopped.cancel()
            if not playing.done():
                playing.cancel()
            await asyncio.gather(playing, stopped, return_exceptions=True)
            if not playing.cancelled():
                playing.result()
            demo.print_outcome()


class FleetDemo:
    """Runs the demonstration: starts nats-server, devices, collectors and a sink, and prints what happens.

    Args:
        stack: exit stack that ends all processes and servers when it closes.
        folder: folder for the collector file, the stores and the file that the sink writes.
    """

    def __init__(self, stack: AsyncExitStack, folder: Path) -> None:
        self._stack, self._folder = stack, folder
        self._programs: dict[str, asyncio.subprocess.Process] = {}
        self._shown: dict[str, int] = {}
        self._at: tuple[str, ...] = ()
        stack.push_async_callback(self._end_programs)

    async def play(self, program: str) -> None:
        """Run all scenes: three collectors share the links, one is killed, the others take over, it is started again.

        Args:
            program: path of nats-server.

        Raises:
            LinkDown: a process does not start or ends too early, or the links are not shared in time.
        """
        from ..apps.fleet.control_entries import apply_configuration
        from ..apps.fleet.coordinators import open_coordinator
        from ..apps.fleet.zone_watch import ZoneWatch

        url = await self._start_server(program)
        self._at = ("--coordinator", url, "--zone", "demo")
        file = await self._start_plant()
        table = await open_coordinator(url, "demo")
        self._stack.push_async_callback(table.close)
        await apply_configuration(table, str(file))
        watch = await self._stack.enter_async_context(ZoneWatch(table))
        await self._start("archive", "sink", "archive")
        for name in COLLECTORS:
            await self._start_collector(name)
        await self._until_shared(watch, set(COLLECTORS))
        for name in COLLECTORS:
            self._print_page(name)
        await asyncio.sleep(CALM)
        await self._kill_one(watch)
        await asyncio.sleep(CALM)
        await self._start_collector(KILLED)
        await self._until_shared(watch, set(COLLECTORS))
        await asyncio.sleep(CALM)

    def print_outcome(self) -> None:
        """Print how many samples have reached the sink; nothing if the sink has written none."""
        archive = self._folder / "archive.jsonl"
        if archive.exists():
            with archive.open("rb") as lines:
                say(f"the sink has {counted(sum(1 for _ in lines), 'sample')}; all of the demonstration is removed")

    # What runs.

    async def _start_server(self, program: str) -> str:
        """Start a nats-server on a free port of loopback, and return its URL.

        Raises:
            LinkDown: it ends, or does not answer within `START_SECONDS`.
        """
        folder = self._folder / "nats"
        folder.mkdir()
        words = [program, "-a", "127.0.0.1", "-p", "-1", "-js", "-sd", str(folder), "--ports_file_dir", str(folder)]
        server = await self._start_program("nats-server", words)
        until = time.monotonic() + START_SECONDS
        while True:
            for found in folder.glob("*.ports"):
                if ports := _ports_of(found):
                    say(f"nats-server on {ports} keeps who polls what, and the stream of samples")
                    return ports
            if server.returncode is not None or time.monotonic() > until:
                raise LinkDown(f"nats-server does not start: {self._last_words('nats-server')}", kind="other")
            await asyncio.sleep(0.1)

    async def _start_plant(self) -> Path:
        """Serve the devices of all links in this process, and write the collector file; return the path of the file."""
        from ..server.device import Device
        from ..server.serving import serve

        (self._folder / "meter.toml").write_text(PROFILE, encoding="utf-8")
        text = FILE.format(folder=self._folder)
        devices: list[Device] = []
        for number in range(LINKS):
            units = {unit: Device(holding_registers=4) for unit in range(1, UNITS + 1)}
            server = await self._stack.enter_async_context(serve("tcp://127.0.0.1:0", units=units))
            devices += units.values()
            text += LINK.format(number=number, url=server.endpoints[0])
            text += "".join(DEVICE.format(number=number, unit=unit) for unit in units)
        moving = asyncio.create_task(_move(devices))
        self._stack.callback(moving.cancel)
        say(f"{LINKS * UNITS} devices on {LINKS} links, in this process")
        file = self._folder / "plant.toml"
        file.write_text(text, encoding="utf-8")
        return file

    async def _start_collector(self, name: str) -> None:
        store = str(self._folder / name)
        await self._start(name, "run", "--stream", "--name", name, "--store", store)
        say(f"collector {name} is started, process {self._programs[name].pid}")

    async def _start(self, name: str, *words: str) -> None:
        await self._start_program(name, [sys.executable, "-m", "busway", "fleet", *words, *self._at])

    async def _start_program(self, name: str, words: list[str]) -> asyncio.subprocess.Process:
        """Start a program in a session of its own, so that Ctrl-C does not reach it; return its process.

        On Linux it ends when this process is killed. Its output goes into the file ``NAME.log``.
        """
        if sys.platform == "linux":
            words = [sys.executable, "-I", "-S", "-c", _END_WITH_PARENT, str(os.getpid()), *words]
        with (self._folder / f"{name}.log").open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                *words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, cwd=self._folder
            )
        self._programs[name] = process
        return process

    async def _end_programs(self) -> None:
        """End collectors and sink, all at the same time, and after them the nats-server."""
        server = self._programs.pop("nats-server", None)
        await asyncio.gather(*map(_end, self._programs.values()))
        if server is not None:
            await _end(server)

    # What happens.

    async def _kill_one(self, watch: "ZoneWatch") -> None:
        """Kill one collector (SIGKILL), wait until the others own its links, and print how long that took."""
        process = self._programs[KILLED]
        process.kill()
        await process.wait()
        begun = time.monotonic()
        say(f"{KILLED} is killed; no other collector may poll its links before its leases end")
        await self._until_shared(watch, set(COLLECTORS) - {KILLED})
        say(f"after {time.monotonic() - begun:.1f} s the others poll all links (a lease holds for 15 s)")

    async def _until_shared(self, watch: "ZoneWatch", names: set[str]) -> None:
        """Wait until the collectors ``names``, and no others, own the shards of all links; print each change of owners.

        Raises:
            LinkDown: one of the collectors has ended, or `START_SECONDS` have passed.
        """
        from ..apps.fleet.shards import shard_of

        wanted = {shard_of(f"line-{number}", SHARDS) for number in range(LINKS)}
        until = time.monotonic() + START_SECONDS
        while time.monotonic() < until:
            owners = {shard: lease.owner for shard, lease in watch.status().leases.items() if lease.held}
            shares = dict(sorted(Counter(owners.values()).items()))
            if shares != self._shown:
                self._shown = shares
                say("shards of links: " + ", ".join(f"{name} {share}" for name, share in shares.items()))
            if wanted <= owners.keys() and set(owners.values()) == names:
                return
            for name in names:
                if self._programs[name].returncode is not None:
                    raise LinkDown(f"collector {name} has ended: {self._last_words(name)}", kind="other")
            await asyncio.sleep(0.2)
        raise LinkDown(f"the shards were not shared in {START_SECONDS:g} s: {self._shown}", kind="timeout")

    def _print_page(self, name: str) -> None:
        for line in (self._folder / f"{name}.log").read_text(encoding="utf-8").splitlines():
            if "page on " in line:
                say(f"page of {name}: {line.partition('page on ')[2].partition(' ')[0]} (tab Fleet shows links move)")

    def _last_words(self, name: str) -> str:
        lines = (self._folder / f"{name}.log").read_text(encoding="utf-8", errors="replace").splitlines()
        return lines[-1] if lines else "it said nothing"


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process with SIGTERM; kill it if it has not ended after `ENDS_IN` seconds."""
    if process.returncode is None:
        process.terminate()
        try:
            async with asyncio.timeout(ENDS_IN):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()


def _ports_of(file: Path) -> str:
    """Return the first URL in the ports file that a nats-server writes; empty if the file is not complete yet."""
    try:
        return str(json.loads(file.read_text(encoding="utf-8"))["nats"][0])
    except (ValueError, LookupError, OSError):
        return ""


async def _move(devices: "list[Device]") -> None:
    """Change the values of a fifth of the devices every 0.2 s, a different fifth each time, until cancelled."""
    turn = 0
    while True:
        for place in range(turn % 5, len(devices), 5):
            power = 1000.0 + 10 * place + turn % 60
            devices[place].holding_registers[0:4] = [*struct.unpack(">2H", struct.pack(">f", power)), 0, turn & 0xFFFF]
        turn += 1
        await asyncio.sleep(0.2)
