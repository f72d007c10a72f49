"""The chaos test of a fleet: real collectors, devices, engines and a sink as processes, to which faults happen.

Knows processes, network namespaces and engines. What was wrong in a run is judged by `fleet_checker`, from logs alone.

1. Where this process may make network namespaces, each engine, collector and the plant are hosts of their own, and
   cables are cut. Elsewhere all is on loopback, the coordinator is kept from a collector inside that one, and the run
   says so (`Run.is_parted`).
2. Everything that was started is ended by its handle.
3. A run proves that its faults struck (`Run.struck`): one in which too little happened has failed. A fault has struck
   if others read links that its collector had read until then; many links that one fault moves are one takeover.
"""

import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fleet_checker import Bounds, Frame, Logs, Owned, Stored, Unread, excused, stood_still, taken
from foreign_servers import PostgresqlServer, free_port, needed
from hosts import Host, Network, why_not
from told_program import Program

from busway.apps.collector.store.store_reader import Store
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.ownership_log import OwnershipLog
from busway.apps.fleet.shards import shard_of

PROGRAMS = Path(__file__).parents[1] / "apps" / "fleet" / "programs"
SHARDS = 16
COLLECTORS = ("c0", "c1", "c2")
ZONE = "hall"
START_SECONDS = 80.0
"""Seconds for which collectors wait for the engines, which are started together with them."""
READY_SECONDS = 120.0
"""Guards against a run that hangs: all of it happens within a few seconds where the machine has time."""
METER = """
[[unit]]
[[unit.point]]
name = "count"
address = "4x1"
type = "uint32"
[[unit.point]]
name = "setpoint"
address = "4x3"
type = "uint32"
"""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What a run is.

    Attributes:
        backend: ``local``, ``nats`` or ``postgresql``.
        seed: of what happens to whom.
        faults: what happens, one after the other.
        times: of the leases; shorter than those of a plant, so that a run is short.
        calm: seconds after each fault, or after the time of a takeover where that is later.
        period: seconds between two reads of a device.
        mutant: the rule that is broken; empty for none.
        parts: whether hosts are parted where that is possible.
    """

    backend: str
    seed: int
    faults: Sequence[str]
    times: LeaseTimes
    calm: float = 2.0
    period: float = 0.2
    mutant: str = ""
    parts: bool = True

    @property
    def takeover(self) -> float:
        """Seconds within which a link is polled again."""
        return self.times.ttl + self.times.guard + 1.0

    @property
    def bounds(self) -> Bounds:
        """What the run is judged by."""
        return Bounds(self.period, self.takeover, self.period + 1.0)


def links_of_shards() -> list[str]:
    """One link for each shard, in the order of shards."""
    found: dict[str, str] = {}
    number = 0
    while len(found) < SHARDS:
        found.setdefault(shard_of(f"line-{number}", SHARDS), f"line-{number}")
        number += 1
    return [found[shard] for shard in sorted(found)]


class Place:
    """Where a process runs: on a host of its own, or here."""

    def __init__(self, host: Host | None, address: str) -> None:
        self.host, self.address = host, address

    def start(self, program: str, settings: Path) -> Program:
        if self.host is not None:
            return self.host.start(PROGRAMS / program, str(settings))
        return Program([sys.executable, str(PROGRAMS / program), str(settings)])

    def command(self, *words: str) -> list[str]:
        inside = [] if self.host is None else ["ip", "netns", "exec", self.host.namespace]
        return [*inside, *words]


@dataclass
class Engine:
    """A server of the coordinator that can be killed and started again."""

    name: str
    place: Place
    command: list[str]
    process: subprocess.Popen[bytes] | None = None
    user: str | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def end(self) -> None:
        """End it with the processes that it has started, as a server of PostgreSQL does when it is told to quit."""
        if self.process is not None:
            self.process.send_signal(signal.SIGQUIT)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
            self.kill()

    def revive(self) -> None:
        """Start it again where it has ended by itself: the processes of the one before may not have been gone."""
        if self.process is not None and self.process.poll() is not None:
            self.start()


class StallMeter(threading.Thread):
    """Notes when the machine had no time for a run: a thread of the run waited for a processor, or its disk for others.

    What threads waited is the kernel's own account (``schedstat``). A disk that is busy shows in this thread, which
    writes to it.
    """

    EVERY = 0.1

    def __init__(self, folder: Path, processes: Callable[[], Iterable[int]]) -> None:
        super().__init__(daemon=True)
        self.stalls: list[tuple[float, float]] = []
        self._file = folder / "meter"
        self._processes = processes
        self._waited: dict[str, float] = {}
        self._end = threading.Event()

    def run(self) -> None:
        before = time.time()
        with self._file.open("wb", buffering=0) as file:
            while not self._end.wait(self.EVERY):
                file.write(b".")
                os.fsync(file.fileno())
                lost = self._lost()
                now = time.time()
                lost = min(max(lost, now - before - 2 * self.EVERY), now - before)
                if lost > 0.01:
                    self.stalls.append((now - lost, now))
                before = now

    def _lost(self) -> float:
        """The longest that a thread has waited for a processor since the last look, in seconds."""
        longest = 0.0
        known, self._waited = self._waited, {}
        for process in self._processes():
            with suppress(OSError, ValueError):  # it has ended
                for thread in os.listdir(f"/proc/{process}/task"):
                    waited = int(Path(f"/proc/{process}/task/{thread}/schedstat").read_text().split()[1]) / 1e9
                    self._waited[thread] = waited
                    longest = max(longest, waited - known.get(thread, 0.0))
        return longest

    def end(self) -> None:
        self._end.set()
        self.join()


@dataclass
class Happened:
    """What was done to whom, from when to when."""

    what: str
    whom: str
    begin: float
    end: float = 0.0


class Run:
    """One run of the chaos test; a context manager.

    Attributes:
        happened: the faults.
        is_parted: whether hosts could be parted.
    """

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self.scenario, self.folder = scenario, folder
        self.happened: list[Happened] = []
        self.is_parted = scenario.parts and scenario.backend != "local" and not why_not()
        self.links = links_of_shards()
        self._chance = random.Random(scenario.seed)
        self._stack = ExitStack()
        self._collectors: dict[str, Program | None] = dict.fromkeys(COLLECTORS)
        self._runs = 0
        self._engines: dict[str, Engine] = {}
        self._places: dict[str, Place] = {}
        self._sink: Program | None = None
        self._begin = self._end = self._sunk_until = 0.0
        self._meter = StallMeter(folder, self._processes)
        self._known_frames: list[Frame] = []
        self._read_frames = 0

    # Start and end.

    def __enter__(self) -> Self:
        with self._stack:
            self._stack.callback(self._end_programs)
            self._lay_out()
            self._start_engines()
            self._plant = self._started_plant()
            self._plant.ready(READY_SECONDS)
            for name in COLLECTORS:
                self._start_collector(name)
            if self.has_stream:
                self._start_sink()
            self._meter.start()
            self._stack.callback(self._meter.end)
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def _slow(self) -> float:
        """Seconds that the sink takes for each batch: a mutant is to be killed in them."""
        return 1.0 if self.scenario.mutant else 0.0

    @property
    def has_stream(self) -> bool:
        """Whether samples go through a stream to a sink."""
        return self.scenario.backend == "nats"

    def _end_programs(self) -> None:
        for program in (*self._collectors.values(), self._sink, getattr(self, "_plant", None)):
            if program is not None:
                with suppress(ProcessLookupError):
                    os.kill(program.pid, signal.SIGCONT)
                program.kill()
        for engine in self._engines.values():
            engine.kill()

    def _processes(self) -> list[int]:
        """The numbers of all processes that run now."""
        programs = [*self._collectors.values(), self._sink, getattr(self, "_plant", None)]
        engines = [engine.process for engine in list(self._engines.values())]
        return [each.pid for each in (*programs, *engines) if each is not None]

    def _lay_out(self) -> None:
        servers = {"nats": ["n0", "n1", "n2"], "postgresql": ["pg"], "local": []}[self.scenario.backend]
        names = [*servers, "plant", *COLLECTORS]
        if self.is_parted:
            network = self._stack.enter_context(Network())
            self._places = {name: Place(host, host.address) for name in names for host in [network.host()]}
        else:
            self._places = {name: Place(None, "127.0.0.1") for name in names}
            for number, name in enumerate(COLLECTORS):
                self._places[name].address = f"127.0.2.{number + 1}"
        self._ports = {link: 15_000 + place if self.is_parted else free_port() for place, link in enumerate(self.links)}

    def _start_engines(self) -> None:
        self._options: dict[str, Any] = {"answer": self.scenario.times.answer, "start": START_SECONDS}
        if self.scenario.backend == "local":
            self._url = f"local:{self.folder / 'zone'}"
        elif self.scenario.backend == "nats":
            self._start_nats()
        else:
            self._start_postgresql()

    def _start_nats(self) -> None:
        program = needed("nats-server")
        names = ["n0", "n1", "n2"]
        ports = {name: (4222, 6222) if self.is_parted else (free_port(), free_port()) for name in names}
        routes = ", ".join(f"nats://{self._places[name].address}:{ports[name][1]}" for name in names)
        for name in names:
            place, (port, cluster) = self._places[name], ports[name]
            config = self.folder / f"{name}.conf"
            config.write_text(
                f'server_name: {name}\nlisten: "{place.address}:{port}"\n'
                f'jetstream {{ store_dir: "{self.folder / name}" }}\n'
                f'cluster {{ name: chaos, listen: "{place.address}:{cluster}", routes: [{routes}] }}\n'
            )
            self._engines[name] = Engine(name, place, place.command(program, "-c", str(config)))
            self._engines[name].start()
        self._url = "nats://" + ",".join(f"{self._places[name].address}:{ports[name][0]}" for name in names)
        self._options["replicas"] = 3

    def _start_postgresql(self) -> None:
        place = self._places["pg"]
        server = PostgresqlServer(syncs=True)
        self._stack.callback(lambda: shutil.rmtree(server.folder, ignore_errors=True))
        access = server.folder / "data" / "pg_hba.conf"
        access.write_text(access.read_text() + "host all all 10.77.0.0/24 scram-sha-256\n")
        words = [place.address if each == "listen_addresses=127.0.0.1" else each for each in server.command]
        words = [f"listen_addresses={place.address}" if each == place.address else each for each in words]
        if os.geteuid() == 0:
            words = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups", *words]
        engine = self._engines["pg"] = Engine("pg", place, place.command(*words))
        self._stack.callback(engine.end)  # before its folder goes
        engine.start()
        self._url = f"postgresql://collector@{place.address}:{server.port}/postgres"
        self._options["password"] = server.PASSWORD

    def _settings(self, of: str, **more: Any) -> Path:
        path = self.folder / f"{of}.json"
        common = {"coordinator": self._url, "zone": ZONE, "options": self._options, "mutant": self.scenario.mutant}
        path.write_text(json.dumps({**common, **more}))
        return path

    def _started_plant(self) -> Program:
        settings = self._settings(
            "plant", address=self._places["plant"].address, log=str(self.folder / "frames"), links=self._ports
        )
        return self._places["plant"].start("plant.py", settings)

    def _start_sink(self) -> None:
        settings = self._settings("sink", rows=str(self.folder / "sink.sqlite"), slow=self._slow)
        self._sink = self._places["plant"].start("sink.py", settings)

    def _start_collector(self, name: str) -> None:
        self._runs += 1
        settings = self._settings(
            name,
            name=name,
            file=str(self._plant_file(name)),
            log=str(self.folder / f"{name}.log"),
            stream=self.has_stream,
            shards=SHARDS,
            times=asdict(self.scenario.times),
            first_write=self._runs * 100_000,
            write_every=0.7,
        )
        self._collectors[name] = self._places[name].start("collector.py", settings)

    def _plant_file(self, name: str) -> Path:
        (self.folder / "meter.toml").write_text(METER)
        text = f'[collector]\nstore = "{self.folder / name}"\n[poll_class]\nfast.period = {self.scenario.period}\n'
        local = "" if self.is_parted else f'local_address = "{self._places[name].address}"\n'
        for link in self.links:
            text += f"""
[[link]]
name = "{link}"
url = "tcp://{self._places["plant"].address}:{self._ports[link]}"
timeout = 0.3
connect_timeout = 0.3
{local}
[[device]]
name = "{link}"
link = "{link}"
unit = 1
profile = "meter.toml"
poll_class = "fast"
"""
        path = self.folder / f"{name}.toml"
        path.write_text(text)
        return path

    # What happens.

    def go(self) -> None:
        """Let everything happen that the scenario names, then bring all back and wait until all is well."""
        for name in COLLECTORS:
            self._collector(name).ready(READY_SECONDS)
        self._until_all_polled(by=len(COLLECTORS))
        self._begin = time.time()
        for fault in self.scenario.faults:
            with self._noted(fault) as happened:
                getattr(self, f"_{fault}")(happened)
            over = happened.begin + self.scenario.takeover - time.time()
            time.sleep(max(0.0, over) + self.scenario.calm)
            self._bring_back()
            self._until_all_polled()
        self._end = time.time()
        self._finish()

    @contextmanager
    def _noted(self, fault: str) -> Iterator[Happened]:
        happened = Happened(fault, "", time.time())
        self.happened.append(happened)
        yield happened
        happened.end = happened.end or time.time()

    def _collector(self, name: str) -> Program:
        program = self._collectors[name]
        assert program is not None
        return program

    def _any(self) -> str:
        """A collector that reads some links: else a fault strikes nothing."""
        begin = time.time() - 2.0
        busy = Counter(
            name for name, _ in {(frame.collector, frame.link) for frame in self._frames() if frame.at > begin}
        )
        return self._chance.choice(
            [name for name in COLLECTORS if self._collectors[name] is not None and busy[name] > 1]
        )

    def _links_of(self, name: str, begin: float) -> set[str]:
        """The links that a collector has read since then."""
        return {frame.link for frame in self._frames() if frame.at > begin and frame.collector == name}

    def _until_taken_over(self, happened: Happened, links: set[str], again: Callable[[], None] = lambda: None) -> None:
        """Wait until others read the links of a collector, and at least as long as leases hold; tell it ``again``."""
        until = happened.begin + self.scenario.takeover + 1.0
        while time.time() < happened.begin + READY_SECONDS:
            taken = {f.link for f in self._frames() if f.at > happened.begin and f.collector != happened.whom}
            if time.time() >= until and links <= taken:
                return
            again()
            time.sleep(0.2)

    def _kill(self, happened: Happened) -> None:
        happened.whom = self._any()
        self._collector(happened.whom).kill()
        self._collectors[happened.whom] = None

    def _freeze(self, happened: Happened, seconds: float = 0.0) -> None:
        """Stop a process for longer than its leases hold."""
        happened.whom = self._any()
        program = self._collector(happened.whom)
        links = self._links_of(happened.whom, happened.begin - 1.0)
        os.kill(program.pid, signal.SIGSTOP)
        try:
            if seconds:
                time.sleep(seconds)
            else:
                self._until_taken_over(happened, links)
        finally:
            happened.end = time.time()
            os.kill(program.pid, signal.SIGCONT)

    def _nap(self, happened: Happened) -> None:
        """Stop a process for a part of the time that its leases hold."""
        self._freeze(happened, 0.4 * self.scenario.times.ttl)

    def _leader(self, happened: Happened) -> None:
        """Kill the server that decides on leases."""
        name = "pg"
        if self.scenario.backend == "nats":
            name = self._plant.ask("leader", stream=f"KV_busway-{ZONE}")["leader"]
        happened.whom = name
        self._engines[name].kill()
        if self.scenario.backend == "postgresql":
            time.sleep(1.5)
            self._engines[name].start()

    def _cut(self, happened: Happened) -> None:
        """Pull the cable of a collector for longer than its leases hold; elsewhere, keep the coordinator from it."""
        if not self.is_parted:
            self._away(happened)
            return
        happened.whom = self._any()
        host = self._places[happened.whom].host
        assert host is not None
        links = self._links_of(happened.whom, happened.begin - 1.0)
        host.cut()
        self._until_taken_over(happened, links)
        happened.end = time.time()
        host.mend()

    def _away(self, happened: Happened) -> None:
        """Keep the coordinator's answers from a collector, whose requests still arrive where hosts are parted."""
        happened.whom = self._any()
        links = self._links_of(happened.whom, happened.begin - 1.0)
        if not self.is_parted:
            away = self._collector(happened.whom)
            self._until_taken_over(happened, links, lambda: away.ask("away", seconds=1.0))
            return
        address = self._places[happened.whom].address
        engines = [host for engine in self._engines.values() if (host := engine.place.host) is not None]
        for host in engines:
            host.drop_to(address, dropped=True)
        self._until_taken_over(happened, links)
        happened.end = time.time()
        for host in engines:
            host.drop_to(address, dropped=False)

    def _sink_dies(self, happened: Happened) -> None:
        assert self._sink is not None
        happened.whom = "sink"
        until = time.monotonic() + READY_SECONDS
        while not self._sunk_rows():
            assert self._sink.runs, self._sink.complaints()
            assert time.monotonic() < until, f"the sink got no samples: {self._sink.complaints()}"
            time.sleep(0.2)
        time.sleep(self._slow / 2)  # a batch has just been kept: the next one is half done by now
        self._sink.kill()
        self._start_sink()

    def _restart(self, happened: Happened) -> None:
        """End all collectors in order, one after the other; each begins again before the next one ends."""
        happened.whom = "all"
        for name in COLLECTORS:
            self._collector(name).ask("end")
            self._collector(name).kill()
            self._start_collector(name)
            self._collector(name).ready()
            self._until_all_polled(by=len(COLLECTORS))

    def _bring_back(self) -> None:
        for engine in self._engines.values():
            if engine.process is None:
                engine.start()
            engine.revive()
        for name, program in self._collectors.items():
            if program is None:
                self._start_collector(name)

    def _until_all_polled(self, by: int = 1) -> None:
        """Wait until every link is read by one collector, and so many collectors read some."""
        until = time.monotonic() + READY_SECONDS + self.scenario.takeover
        while time.monotonic() < until:
            begin = time.time() - 2.0
            frames = [frame for frame in self._frames() if frame.at > begin and not frame.is_write]
            pairs = {(frame.collector, frame.link) for frame in frames}
            if len(pairs) == len({link for _, link in pairs}) == SHARDS and len(dict(pairs)) >= by:
                return
            for engine in self._engines.values():
                engine.revive()
            time.sleep(0.2)
        raise AssertionError(f"not all collectors poll, each links of its own: {sorted(pairs)}\n{self.story()}")

    def _finish(self) -> None:
        """Wait until the sink has all, then end the collectors in order."""
        if self.has_stream:
            self._sunk_until = time.time() - 1.0
            for name in COLLECTORS:
                newest = self._collector(name).ask("kept")["newest"]
                until = time.monotonic() + READY_SECONDS
                while (kept := self._collector(name).ask("kept")["kept"]) < newest:
                    assert time.monotonic() < until, f"the sink has {kept} of {newest} commits of {name}"
                    time.sleep(0.2)
        for name in COLLECTORS:
            self._collector(name).tell("end")
        for name in COLLECTORS:
            self._collector(name).outcome()

    def story(self) -> str:
        """What happened, and the last words of each collector."""
        words = [f"{each.begin:.2f}-{each.end:.2f} {each.what} {each.whom}" for each in self.happened]
        for name in COLLECTORS:
            log = self.folder / f"{name}.log.txt"
            words.append(f"{name}: {log.read_text()[-1500:] if log.exists() else 'no log'}")
        return "\n".join(words)

    # What it left.

    def _frames(self) -> list[Frame]:
        names = {place.address: name for name, place in self._places.items() if name in COLLECTORS}
        path = self.folder / "frames"
        if path.exists():
            with path.open("rb") as file:
                file.seek(self._read_frames)
                whole, newline, _ = file.read().rpartition(b"\n")
            self._read_frames += len(whole + newline)
            self._known_frames += [
                Frame(at, link, names[peer], is_write, value)
                for at, link, peer, is_write, value in map(json.loads, whole.splitlines())
            ]
        return self._known_frames

    def logs(self) -> Logs:
        """What devices, stores and the sink have, after `go`."""
        logs = Logs(self._begin, self._end, self._frames(), sunk_until=self._sunk_until, stalls=self._meter.stalls)
        logs.faults = [moment for each in self.happened for moment in (each.begin, each.end)]
        logs.down = self._times_without_quorum()
        for name in COLLECTORS:
            self._read_store(name, logs)
            self._read_log(name, logs)
        if self.has_stream:
            logs.sunk = self._sunk_rows()
        return logs

    def _sunk_rows(self) -> Counter[tuple[str, int]]:
        """Link and value of what the sink has."""
        path = self.folder / "sink.sqlite"
        if not path.exists():
            return Counter()
        with closing(sqlite3.connect(path, timeout=60)) as database:
            if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'rows'").fetchall():
                return Counter()
            rows = database.execute("SELECT device, value FROM rows WHERE point = 'count' AND reason = 0").fetchall()
        return Counter(rows)

    def _times_without_quorum(self) -> list[tuple[float, float]]:
        successes = self._plant.ask("successes")["successes"]
        return [(a, b) for a, b in pairwise(successes) if b - a > 1.0]

    def _read_store(self, name: str, logs: Logs) -> None:
        table = Store(self.folder / name).read("*/count")
        period = self.scenario.period
        for device, at, value, reason in zip(table.device, table.time, table.value, table.reason, strict=True):
            if reason:
                logs.unread.append(Unread(name, device, at / 1e9 - period, at / 1e9 + period))
            else:
                assert isinstance(value, int)
                logs.stored.append(Stored(name, device, value, at / 1e9))
        for each in table.intervals:
            end = None if each.end is None else each.end / 1e9
            logs.unread.append(Unread(name, each.device, each.begin / 1e9, end))
        logs.unread += [Unread(name, None, each.begin / 1e9, each.end / 1e9) for each in table.gaps]
        with closing(OwnershipLog(self.folder / name)) as ownership:
            for row in ownership.all():
                epoch = row.epoch.generation, row.epoch.revision
                end = None if row.end is None else row.end / 1e9
                logs.owned.append(Owned(name, row.link, epoch, row.begin / 1e9, end))

    def _read_log(self, name: str, logs: Logs) -> None:
        for line in (self.folder / f"{name}.log").read_text().splitlines():
            what, *rest = json.loads(line)
            if what == "commit":
                logs.committed |= {(link, value) for link, value in rest[0]}
            elif what == "refused" or (what == "written" and rest[1] in ("expired", "refused")):
                logs.not_executed.add(rest[0])

    def struck(self, logs: Logs) -> dict[str, float]:
        """How many faults struck, by kind, what of its long silences is excused, and how much it stood still.

        Raises `AssertionError` where the run proves nothing. Where hosts can be parted, a cut must have kept a
        collector from all devices.
        """
        found: dict[str, float] = Counter()
        for each, next_one in pairwise([*self.happened, Happened("end", "", logs.end)]):
            lasts = each.what in ("freeze", "cut", "away")  # while a fault lasts, or else until the next one
            if each.what == "leader" or taken(logs, each.whom, each.begin, each.end if lasts else next_one.begin):
                found[each.what] += 1
                found["takeovers"] += each.what != "leader"
            if each.what == "cut" and self.is_parted:
                middle = (each.begin + each.end) / 2
                heard = [f for f in logs.frames if f.collector == each.whom and middle < f.at < each.end]
                assert not heard, f"{each.whom} was heard while its cable was cut"
        found["excused"] = round(excused(logs, self.scenario.bounds), 3)
        found["stood still"] = round(stood_still(logs, logs.begin, logs.end) / (logs.end - logs.begin), 3)
        assert found["takeovers"] >= 3, found
        assert found["freeze"] >= 1, found
        assert found["leader"] >= 1 or self.scenario.backend == "local", found
        assert found["cut"] >= 1 or not self.is_parted or "cut" not in self.scenario.faults, found
        return found
