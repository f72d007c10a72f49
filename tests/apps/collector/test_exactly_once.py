"""Every sample that was shown or handed on is in the store once, and sinks have all, also where the collector dies.

1. Devices are sockets of our own that remember what they answered.
2. One random walk kills and ends the collector, takes sinks away, reads, copies and restores the store meanwhile.
"""

import asyncio
import contextlib
import importlib.util
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from foreign_servers import ForeignServer, free_port, nats_server
from kept_once import (
    SECOND,
    Delivered,
    Key,
    bad_samples,
    good_samples,
    missing_answers,
    nanoseconds,
    of_csv,
    of_lines,
    of_parquet,
    profile,
)
from lying_devices import Field, Lies, LyingDevice

import busway

SEED = int(os.environ.get("BUSWAY_WALK_SEED", "20261122"))
PLACES = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"])
SUPPORT = Path(__file__).parents[2] / "support"
LIMIT = 60.0
AGAIN = "read again"


class Collecting:
    """``busway collect`` with small segments, which tests end and start again."""

    def __init__(self, file: Path, segment: int) -> None:
        self._command = [sys.executable, os.fspath(SUPPORT / "small_segments.py"), str(segment), "collect", str(file)]
        self._log = file.with_name("collect.log").open("ab")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._log
        )

    @property
    def process(self) -> subprocess.Popen[bytes]:
        assert self._process is not None
        return self._process

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(LIMIT)

    def close(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._log.close()


class Walk:
    """A plant, a collector, and everything that was seen of its samples."""

    def __init__(
        self, folder: Path, world: Field, seed: int, *, segment: int, nats: ForeignServer | None, collector: str = ""
    ) -> None:
        self.folder, self.chance, self.nats, self._world = folder, random.Random(seed), nats, world
        self.page = free_port()
        self.devices: dict[str, LyingDevice] = {}
        self.excused: list[tuple[int, int]] = []
        self.seen: list[tuple[str, dict[Key, Any]]] = []
        self.shown: set[tuple[str, str, int]] = set()
        self.restored: list[tuple[dict[Key, Any], set[Key]]] = []
        self.ends: list[int] = []
        self.drops = bool(collector)
        self.out = folder / "out"
        self.out.mkdir()
        self._text = self._configured(world, collector)
        (folder / "profile.toml").write_text(profile())
        self._write(0.03)
        self.collecting = Collecting(folder / "plant.toml", segment)

    def _configured(self, world: Field, collector: str) -> str:
        text = f'[collector]\nstore = "data"\npage = "127.0.0.1:{self.page}"\n{collector}'
        text += "[poll_class]\nall.period = PERIOD\n"
        for number in range(2):
            url, units = world.endpoint("tcp", [1, 2, 3], Lies({"exception": 0.01, "silent": 0.002}))
            text += f'[[link]]\nname = "l{number}"\nurl = "{url}"\ntimeout = 0.3\n'
            for unit, device in units.items():
                name = f"d{number}-{unit}"
                self.devices[name] = device
                text += f'[[device]]\nname = "{name}"\nlink = "l{number}"\nunit = {unit}\nprofile = "profile.toml"\n'
        text += f'[[sink]]\nname = "lines"\nurl = "file://{self.out}/lines.jsonl"\nage = 0.2\nmost = 500\n'
        if self.nats is not None:
            text += f'[[sink]]\nname = "bus"\nurl = "nats://127.0.0.1:{self.nats.port}"\nage = 0.1\n'
            text += 'subject = "plant.{device}"\nstream = "PLANT"\n'
        return text

    def _write(self, period: float) -> None:
        (self.folder / "plant.toml").write_text(self._text.replace("PERIOD", str(period)))

    # What happens.

    def run(self, turns: int) -> None:
        self.collecting.start()
        until(self._is_up, self.log)
        deeds: list[Callable[[], None]] = [
            *(self.kill,) * 3,
            self.terminate,
            self.reload,
            self.pause,
            self.query,
            self.look,
            self.look,
            self.back_up,
            self.take_file_away,
        ]
        if self.nats is not None:
            deeds.append(self.take_server_away)
        for turn in range(turns):
            if self._is_up():
                self._world.wait_for_answers(self.chance.choice((5, 50, 150)))
            else:
                time.sleep(self.chance.uniform(0, 0.5))  # any moment of its start; nothing tells of each
            deed = self.chance.choice(deeds)
            print(f"{turn} {deed.__name__}")
            deed()
            assert self.collecting.process.poll() is None, self.log()

    def kill(self) -> None:
        now = time.time_ns()
        self.collecting.end(signal.SIGKILL)
        self.excused.append((now - 2 * SECOND, time.time_ns()))
        self._again()

    def terminate(self) -> None:
        was_up, now = self._is_up(), time.time_ns()
        assert self.collecting.end(signal.SIGTERM) in ([0] if was_up else [0, -signal.SIGTERM]), self.log()
        self.excused.append((now - SECOND // 10, time.time_ns()))
        self._again()

    def _again(self) -> None:
        self.ends.append(time.time_ns())
        self.collecting.start()
        if self.chance.random() < 0.8:  # or else it may end again while it starts
            until(self._is_up, self.log)

    def reload(self) -> None:
        """Other periods: the reads that are on their way then are given up."""
        now = time.time_ns()
        self._write(self.chance.choice((0.03, 0.05, 0.1)))
        if self._is_up():  # before that a signal ends the process
            told = self.log().count(AGAIN)
            self.collecting.process.send_signal(signal.SIGHUP)
            until(lambda: self.log().count(AGAIN) > told, self.log)
            self.excused.append((now, time.time_ns() + SECOND))

    def pause(self) -> None:
        """The process stands still, as on a machine that sleeps: for some time nothing happens at all."""
        self.collecting.process.send_signal(signal.SIGSTOP)
        time.sleep(self.chance.uniform(0.1, 0.6))
        self.collecting.process.send_signal(signal.SIGCONT)

    def look(self) -> None:
        """Look at the page: what it shows is in the store, also if the process ends now."""
        if not self._is_up():
            return
        points = self._ask("points")["points"]
        for point, value, quality in zip(points, *(self._ask("values")[k] for k in ("value", "quality")), strict=True):
            if quality == "good" and value is not None:
                self.shown.add((point["device"], point["point"], int(value)))
        if self.chance.random() < 0.5:
            self.kill()

    def query(self) -> None:
        out = self.busway("query", str(self.folder / "data"), "*", "--csv")
        self.seen.append(("query", {key: int(value) for key, value in of_csv(out).items()}))

    def back_up(self) -> None:
        before = set(self.lines().values)
        number = len(self.restored)
        copy, again = self.folder / f"copy{number}", self.folder / f"restored{number}"
        self.busway("store", "backup", str(self.folder / "data"), str(copy))
        self.busway("store", "restore", str(copy), str(again))
        kept, twice = good_samples(busway.Store(again).read())
        assert twice == []
        self.restored.append((kept, before))

    def take_file_away(self) -> None:
        """Where the lines go there is no folder for a while."""
        away = self.out.with_name("away")
        self.out.rename(away)
        self.out.write_text("in the way")
        self._until_it_is_missed("lines")
        if self.chance.random() < 0.5:
            self.kill()
        self.out.unlink()
        away.rename(self.out)

    def take_server_away(self) -> None:
        assert self.nats is not None
        self.nats.stop()
        self._until_it_is_missed("bus")
        if self.chance.random() < 0.5:
            self.kill()
        self.nats.start()

    def _until_it_is_missed(self, name: str) -> None:
        """Wait until the page says that a sink cannot deliver; not while the collector starts."""
        if self._is_up():
            until(lambda: any(each["error"] for each in self._sinks() if each["name"] == name), self.log)

    # What is there.

    def busway(self, *arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "busway", *arguments], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, f"busway {' '.join(arguments)}: {done.stderr}"
        return done.stdout

    def lines(self) -> Delivered:
        file = self.out / "lines.jsonl"
        return of_lines(file.read_text() if file.exists() else "")

    def log(self) -> str:
        return (self.folder / "collect.log").read_text()

    def settle(self) -> None:
        """Let the devices fall silent, and wait until the sinks have all there is."""
        for device in self.devices.values():
            device.is_dead = True
        until(self._is_up, self.log)
        self.excused.append((time.time_ns() - SECOND, time.time_ns() + 600 * SECOND))
        # What was read before is committed: the page shows of each point that its device is silent.
        until(lambda: "good" not in self._ask("values")["quality"], self.log)
        until(lambda: not self._not_handed_on(), lambda: f"never handed on: {self._not_handed_on()[:5]}\n{self.log()}")
        assert self.collecting.end(signal.SIGTERM) == 0, self.log()

    def _not_handed_on(self) -> list[object]:
        """Samples that are not in the file, and sinks that are behind."""
        kept, _ = good_samples(busway.Store(self.folder / "data").read())
        behind = [sink for sink in self._sinks() if sink["behind"] or sink["error"]]
        return [*(kept.keys() - self.lines().values.keys()), *behind]

    def _sinks(self) -> list[dict[str, Any]]:
        return list(self._ask("sinks")["sinks"])

    def _is_up(self) -> bool:
        try:
            self._ask("collector")
        except OSError:
            return False
        return True

    def _ask(self, what: str) -> Any:  # Any: whatever JSON holds
        with urllib.request.urlopen(f"http://127.0.0.1:{self.page}/api/{what}", timeout=5) as answer:
            return json.loads(answer.read())

    # What is wrong.

    def problems(self) -> list[str]:
        table = busway.Store(self.folder / "data").read()
        kept, wrong = good_samples(table)
        lines = self.lines()
        wrong += lines.problems()
        handed = {key: values for key, values in lines.values.items() if values != {None}}
        oldest = min(key[2] for key in kept) if self.drops else 0
        everything = {**{key: min(values, key=str) for key, values in handed.items()}, **kept}
        wrong += self._same("a file", {key: values for key, values in handed.items() if key[2] >= oldest}, kept)
        wrong += [f"{key} never reached the file" for key in kept if key not in lines.values]
        for name, seen in self.seen:
            late = [key for key in seen if key[2] >= oldest]
            wrong += [f"{key} was in a {name} and is {kept.get(key)}" for key in late if kept.get(key) != seen[key]]
        wrong += self._queries_that_differ(kept)
        held = {(device, point, value) for (device, point, _), value in everything.items()}
        wrong += [f"{value} was shown and is not in the store" for value in self.shown - held]
        for number, (restored, before) in enumerate(self.restored):
            wrong += self._no_prefix(f"backup {number}", restored, before, everything, lines)
        answers = {name: self._world.answers[device.number] for name, device in self.devices.items()}
        wrong += missing_answers(everything, bad_samples(table), answers, self.excused)
        wrong += [
            f"no gap has the end at {end}"
            for end in self.ends
            if end >= oldest and not any(gap.begin <= end <= gap.end for gap in table.gaps)
        ]
        print(
            f"{len(kept)} samples kept, {lines.copies} handed on, {len(self.ends)} ends, {len(self.restored)} backups"
        )
        return wrong

    def _queries_that_differ(self, kept: dict[Key, Any]) -> list[str]:
        """What the command line says in each format."""
        data, file = str(self.folder / "data"), self.folder / "all.parquet"
        of_json = {}
        for line in self.busway("query", data, "*", "--json").splitlines():
            row = json.loads(line)
            if row["quality"] == "good":
                device, _, point = row["point"].partition("/")
                of_json[device, point, nanoseconds(row["time"])] = row["value"]
        found: dict[str, dict[Key, Any]] = {"JSON": of_json}
        found["CSV"] = {key: int(value) for key, value in of_csv(self.busway("query", data, "*", "--csv")).items()}
        if importlib.util.find_spec("pyarrow") is not None:
            self.busway("query", data, "*", "--parquet", str(file))
            found["Parquet"] = of_parquet(file)
        return [f"the query in {name} differs from the store" for name, rows in found.items() if rows != kept]

    def _same(self, where: str, seen: dict[Key, set[Any]], kept: dict[Key, Any]) -> list[str]:
        return [
            f"{key} was {values} in {where} and is {kept.get(key)}"
            for key, values in seen.items()
            if values != {kept.get(key)}
        ]

    def _no_prefix(
        self, name: str, restored: dict[Key, Any], before: set[Key], kept: dict[Key, Any], lines: Delivered
    ) -> list[str]:
        wrong = [f"{key} of {name} is another" for key, value in restored.items() if kept.get(key) != value]
        last = max((min(lines.commits[key]) for key in restored if key in lines.commits), default=0)
        oldest = min((key[2] for key in restored), default=0) if self.drops else 0
        due = {key for key in kept if key[2] >= oldest and key in lines.commits and min(lines.commits[key]) <= last}
        wrong += [f"{key} of commit {min(lines.commits[key])} is missing in {name}" for key in due - restored.keys()]
        wrong += [
            f"{key} was handed on before {name}"
            for key in before & kept.keys()
            if key not in restored and key[2] >= oldest
        ]
        return wrong


def until(holds: Callable[[], bool], story: Callable[[], str]) -> None:
    limit = time.monotonic() + LIMIT
    while not holds():
        assert time.monotonic() < limit, story()
        time.sleep(0.1)


async def messages(port: int) -> list[dict[str, Any]]:
    """All messages of the stream."""
    nats = pytest.importorskip("nats")
    client = await nats.connect(f"nats://127.0.0.1:{port}")
    try:
        stream = client.jetstream()
        count = (await stream.stream_info("PLANT")).state.messages
        found: list[dict[str, Any]] = []
        subscription = await stream.subscribe("plant.>", stream="PLANT", ordered_consumer=True)
        for _ in range(count):
            message = await subscription.next_msg(10)
            found.append(json.loads(message.data))
        return found
    finally:
        await client.close()


def stream_problems(found: list[dict[str, Any]], lines: Delivered) -> list[str]:
    """What the stream has twice, or not."""
    wrong, keys, samples = [], set(), set()
    for message in found:
        if message["key"] in keys:
            wrong.append(f"{message['key']} is there twice")
        keys.add(message["key"])
        for read in message["reads"]:
            for point, value in read["values"].items():
                key = (message["device"], point, read["time"])
                if key in samples:
                    wrong.append(f"{key} is there twice in the stream")
                samples.add(key)
                if lines.values.get(key) != {value}:
                    wrong.append(f"{key} is {value} in the stream and {lines.values.get(key)} in the file")
    wanted = {key for key, values in lines.values.items() if values != {None}}
    return wrong + [f"{key} never reached the stream" for key in wanted - samples]


def check_a_walk(folder: Path, seed: int, turns: int, collector: str = "") -> None:
    """Walk, and fail with what was lost, doubled or changed."""
    print(f"seed {seed}, {turns} turns")
    with Field(seed) as world, nats_where_there(folder) as nats:
        walk = Walk(folder, world, seed, segment=60_000, nats=nats, collector=collector)
        try:
            walk.run(turns)
            walk.settle()
            wrong = walk.problems()
            if nats is not None:
                wrong += stream_problems(asyncio.run(messages(nats.port)), walk.lines())
            walk.busway("store", "check", str(folder / "data"))
        finally:
            walk.collecting.close()
    assert wrong[:20] == []


def nats_where_there(folder: Path) -> contextlib.AbstractContextManager[ForeignServer | None]:
    """A server with JetStream; None where there is none, so that the walk is made without it."""
    if importlib.util.find_spec("nats") is None or shutil.which("nats-server", path=PLACES) is None:
        return contextlib.nullcontext()
    return nats_server(folder)


@pytest.mark.real_time
def test_what_was_shown_or_handed_on_is_kept_once_and_sinks_have_it_all(tmp_path: Path) -> None:
    check_a_walk(tmp_path, SEED, 10)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(SEED, SEED + 5))
def test_the_same_over_long_walks(tmp_path: Path, seed: int) -> None:
    check_a_walk(tmp_path, seed, 150)


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_retention_takes_the_oldest_and_nothing_that_sinks_lack(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    check_a_walk(tmp_path, SEED, 75, "keep_days = 2\n")
