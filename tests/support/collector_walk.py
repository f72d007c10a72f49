"""A plant on plain sockets, a collector that is killed, paused and starved, and the judge of what came of it.

1. Devices are sockets of our own that remember what they answered.
2. What happens is drawn by a seeded generator, or done by who uses the walk.
"""

import contextlib
import importlib.util
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import shifted_clock
from foreign_servers import free_port
from full_disk import fill
from kept_once import (
    SECOND,
    Delivered,
    Key,
    bad_samples,
    missing_answers,
    nanoseconds,
    of_csv,
    of_lines,
    of_parquet,
    profile,
    valued_samples,
)
from lying_devices import Field, Lies, LyingDevice
from sink_receivers import Receiver, receivers_that_are_there

import busway
from busway.apps.collector.samples import Reason

SUPPORT = Path(__file__).parent
LIMIT = 60.0
SILENCE = 150.0
"""Seconds after which devices that were all silent for a while, on a busy machine, are asked again: the bound that the
documentation states, a minute and twenty timeouts for each, and as much again for the machine."""
AGAIN = "read again"


class Collecting:
    """``busway collect`` with small segments, which tests end and start again."""

    def __init__(self, file: Path, segment: int, clock: Path) -> None:
        self._command = [sys.executable, os.fspath(SUPPORT / "small_segments.py"), str(segment), "collect", str(file)]
        self._log = file.with_name("collect.log").open("ab")
        self._environment = {**os.environ, shifted_clock.VARIABLE: str(clock)}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            env=self._environment,
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
        self,
        folder: Path,
        world: Field,
        seed: int,
        *,
        segment: int,
        receivers: Sequence[Receiver] = (),
        collector: str = "",
    ) -> None:
        self.folder, self.chance, self.receivers, self._world = folder, random.Random(seed), receivers, world
        self.page = free_port()
        self.devices: dict[str, LyingDevice] = {}
        self.excused: list[tuple[int, int]] = []
        self.seen: list[tuple[str, dict[Key, Any]]] = []
        self.shown: set[tuple[str, str, int]] = set()
        self.restored: list[tuple[dict[Key, Any], set[Key]]] = []
        self.ends: list[int] = []
        self.shared_ends = 0
        self._is_down = False
        self.maintained: list[str] = []
        self.wrong: list[str] = []
        self.drops = bool(collector)
        self.out = folder / "out"
        self.out.mkdir()
        self._text = self._configured(world, collector)
        (folder / "profile.toml").write_text(profile())
        self.write(0.03)
        self.disk_is_small = os.path.ismount(folder / "data")
        self._clock, self._shift = folder / "clock", 0
        shifted_clock.set_shift(self._clock, 0)
        self.collecting = Collecting(folder / "plant.toml", segment, self._clock)

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
        return text + "".join(receiver.section for receiver in self.receivers)

    def write(self, period: float) -> None:
        (self.folder / "plant.toml").write_text(self._text.replace("PERIOD", str(period)))

    # What happens.

    def run(self, turns: int) -> None:
        """Start, and do what is drawn so many times."""
        self._begin()
        deeds: list[Callable[[], None]] = [*(self.kill,) * 3, self.look, *self.deeds()]
        for _ in range(turns):
            self._do(self.chance.choice(deeds))

    def run_through(self) -> None:
        """Start, and do what is most likely to cost a sample once, in an order that is drawn."""
        self._begin()
        worst = {self.kill, self.look, self.back_up, self.take_server_away, self.step_clock, self.fill_disk}
        deeds = [deed for deed in self.deeds() if deed in worst]
        self.chance.shuffle(deeds)
        for deed in deeds:
            self._do(deed)

    def deeds(self) -> list[Callable[[], None]]:
        """What may happen here."""
        always = [
            self.kill,
            self.terminate,
            self.reload,
            self.pause,
            self.query,
            self.look,
            self.back_up,
            self.take_file_away,
            self.maintain,
        ]
        if not self.drops:  # a stepped clock makes new samples the oldest ones
            always.append(self.step_clock)
        return always + [self.take_server_away] * bool(self.receivers) + [self.fill_disk] * self.disk_is_small

    def _begin(self) -> None:
        self.collecting.start()
        self._began = time.monotonic()
        until(self.is_up, self.log)

    def _do(self, deed: Callable[[], None]) -> None:
        if self.is_up():
            self._is_down = False
            self._world.wait_for_answers(self.chance.choice((5, 50, 150)), SILENCE)
        else:
            time.sleep(self.chance.uniform(0, 0.5))  # any moment of its start; nothing tells of each
        print(f"{time.monotonic() - self._began:8.2f} {deed.__name__}", flush=True)
        deed()
        assert self.collecting.process.poll() is None, self.log()

    def kill(self) -> None:
        now = time.time_ns()
        self.collecting.end(signal.SIGKILL)
        self.excused.append((now - 2 * SECOND, time.time_ns()))
        self._again()

    def terminate(self) -> None:
        was_up, now = self.is_up(), time.time_ns()
        assert self.collecting.end(signal.SIGTERM) in ([0] if was_up else [0, -signal.SIGTERM]), self.log()
        self.excused.append((now - SECOND // 10, time.time_ns()))
        self._again()

    def _again(self) -> None:
        self._note_end()
        self.collecting.start()
        if self.chance.random() < 0.8:  # or else it may end again while it starts
            until(self.is_up, self.log)

    def _note_end(self) -> None:
        """Note when the process ended, by the clock of then. Before it was up again there may be no gap of its own."""
        self.shared_ends += self._is_down
        self._is_down = True
        self.ends.append(time.time_ns() + self._shift)

    def reload(self) -> None:
        """Other periods: the reads that are on their way then are given up."""
        now = time.time_ns()
        self.write(self.chance.choice((0.03, 0.05, 0.1)))
        if self.is_up():  # before that a signal ends the process
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
        if not self.is_up():
            return
        points = self.ask("points")["points"]
        for point, value, quality in zip(points, *(self.ask("values")[k] for k in ("value", "quality")), strict=True):
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
        kept, twice = valued_samples(busway.Store(again).read())
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
        receiver = self.chance.choice(self.receivers)
        receiver.server.stop()
        self._until_it_is_missed(receiver.name)
        if self.chance.random() < 0.5:
            self.kill()
        receiver.server.start()

    def _until_it_is_missed(self, name: str) -> None:
        """Wait until the page says that a sink cannot deliver; not while the collector starts."""
        if self.is_up():
            until(lambda: any(each["error"] for each in self.sinks() if each["name"] == name), self.log)

    def step_clock(self) -> None:
        """The system's clock is set: an hour ahead, an hour back, or right."""
        hour = 3600 * SECOND
        self.shared_ends += self._is_down  # the gap of the last end has the clock that is set now
        self._shift = self.chance.choice([shift for shift in (-hour, 0, hour) if shift != self._shift])
        shifted_clock.set_shift(self._clock, self._shift)
        if self.chance.random() < 0.3:
            self.kill()

    def fill_disk(self) -> None:
        """The store has no room for a while: it says so, and goes on when it has; or it ends meanwhile."""
        filler, begin = self.folder / "data" / "filler", time.time_ns()
        fill(filler)
        if self.is_up() and self.chance.random() < 0.7:
            until(lambda: self.ask("collector")["error"], lambda: f"a full disk is not told\n{self.log()}")
            time.sleep(self.chance.uniform(0.1, 2))
            filler.unlink()
            until(lambda: self.ask("collector")["error"] is None, lambda: f"the store stays unwritten\n{self.log()}")
            return
        self.collecting.end(signal.SIGKILL)
        self._note_end()
        self.collecting.start()
        until(lambda: self.collecting.process.poll() is not None or self.is_up(), self.log)
        filler.unlink()
        if self.collecting.process.poll() is not None:  # it cannot begin without room
            assert "the store cannot be written" in self.log().splitlines()[-1], self.log()
            self.collecting.start()
        until(self.is_up, self.log)
        self.excused.append((begin - 2 * SECOND, time.time_ns()))

    def maintain(self) -> None:
        """A device is left alone for a while, also by the next process: that is one interval."""
        if not self.is_up():
            return
        device = self.chance.choice(sorted(self.devices))
        begin = time.time_ns()
        self._set_maintenance(device, on=True)
        time.sleep(0.2)
        asked = len(self._world.answers[self.devices[device].number])
        if self.chance.random() < 0.7:
            self.kill()
        time.sleep(self.chance.uniform(0.2, 1))
        until(self.is_up, self.log)
        if len(self._world.answers[self.devices[device].number]) != asked:
            self.wrong.append(f"{device} was asked in maintenance")
        self._set_maintenance(device, on=False)
        self.maintained.append(device)
        self.excused.append((begin, time.time_ns()))

    def _set_maintenance(self, device: str, *, on: bool) -> None:
        tokens = (self.folder / "data" / "page-tokens").read_text().splitlines()
        token = next(words[1] for words in map(str.split, tokens) if words[:1] == ["operate"])
        self.ask(f"devices/{device}/maintenance", {"on": on, "reason": "a walk"}, token)

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

    def settle(self, seconds: float = LIMIT) -> None:
        """Let the devices fall silent, and wait until the sinks have all there is."""
        for device in self.devices.values():
            device.is_dead = True
        until(self.is_up, self.log)
        self.excused.append((time.time_ns() - SECOND, time.time_ns() + 600 * SECOND))
        # What was read before is committed: the page shows of each point that its device is silent.
        until(lambda: "good" not in self.ask("values")["quality"], self.log)
        until(
            lambda: not self.not_handed_on(),
            lambda: f"never handed on: {self.not_handed_on()[:5]}\n{self.log()}",
            seconds,
        )
        assert self.collecting.end(signal.SIGTERM) == 0, self.log()

    def not_handed_on(self) -> list[object]:
        """Samples that are not in the file, and sinks that are behind."""
        kept, _ = valued_samples(busway.Store(self.folder / "data").read())
        behind = [sink for sink in self.sinks() if sink["behind"] or sink["error"]]
        return [*(kept.keys() - self.lines().values.keys()), *behind]

    def sinks(self) -> list[dict[str, Any]]:
        """How each sink does, as the page says it."""
        return list(self.ask("sinks")["sinks"])

    def is_up(self) -> bool:
        try:
            self.ask("collector")
        except OSError:
            return False
        return True

    def ask(self, what: str, question: object = None, token: str = "") -> Any:  # Any: whatever JSON holds
        asked = urllib.request.Request(f"http://127.0.0.1:{self.page}/api/{what}")
        if question is not None:
            asked.data = json.dumps(question).encode()
            asked.add_header("Content-Type", "application/json")
            asked.add_header("Authorization", f"Bearer {token}")
        with urllib.request.urlopen(asked, timeout=5) as answer:
            return json.loads(answer.read())

    # What is wrong.

    def problems(self) -> list[str]:
        table = busway.Store(self.folder / "data").read()
        kept, wrong = valued_samples(table)
        lines = self.lines()
        wrong += [*self.wrong, *lines.problems()]
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
        lost = [gap for gap in table.gaps if gap.reason == Reason.LOST]
        excused = [
            *self.excused,
            (0, oldest),
        ]  # what was lost before the oldest sample was told so until it was dropped
        wrong += missing_answers(everything, bad_samples(table), lost, answers, excused)
        without = [end for end in self.ends if not any(gap.begin <= end <= gap.end for gap in table.gaps)]
        set_back = [gap for gap in table.gaps if gap.begin == gap.end]  # the clock, between the last commit and the end
        if len(without) > len(set_back) + self.shared_ends:
            wrong += [f"no gap has the end at {end}" for end in without if end >= oldest]
        for receiver in self.receivers:
            wrong += receiver.problems(lines)
        kept_alone = [each.device for each in table.intervals if each.reason == Reason.MAINTENANCE and each.end]
        if not self.drops and sorted(kept_alone) != sorted(self.maintained):
            wrong.append(f"maintenance of {kept_alone} is in the store, and {self.maintained} were in it")
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
            if row["quality"] != "bad":
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


def until(holds: Callable[[], bool], story: Callable[[], str], seconds: float = LIMIT) -> None:
    limit = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < limit, story()
        time.sleep(0.1)


def check_a_walk(folder: Path, seed: int, turns: int | None, collector: str = "") -> None:
    """Walk so many turns, or through the worst deeds once, and fail with what was lost, doubled or changed.

    Where a small file system of its own can be made for the store, it is a program in a namespace that has one; all
    that it starts ends with it.
    """
    own_system = [shutil.which("unshare") or "", "-Urmpf", "--kill-child", "--mount-proc"]
    if not own_system[0] or subprocess.run([*own_system, "true"], capture_output=True, check=False).returncode:
        judge_a_walk(folder, seed, turns, collector)
        return
    (folder / "data").mkdir()
    mount = f"mount -t tmpfs -o size=48m tmpfs '{folder / 'data'}'"
    words = [sys.executable, __file__, str(folder), str(seed), str(turns or 0), collector]
    script = f"{mount} && exec {shlex.join(words)}"
    limit = 110 if turns is None else 300 + 10 * turns
    done = subprocess.run([*own_system, "sh", "-c", script], timeout=limit, check=False, env=_with_paths())
    assert done.returncode == 0, "see what the walk printed"


def _with_paths() -> dict[str, str]:
    """The environment of a program that imports what this one can."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


def judge_a_walk(folder: Path, seed: int, turns: int | None, collector: str) -> None:
    """Walk in this process."""
    print(f"seed {seed}, {'the worst deeds once' if turns is None else f'{turns} turns'}")
    with walked(folder, seed, segment=60_000 if turns else 200_000, collector=collector) as walk:
        if turns is None:
            walk.run_through()
        else:
            walk.run(turns)
        walk.settle()
        wrong = walk.problems()
        if wrong and walk.disk_is_small:
            shutil.copytree(folder / "data", folder / "looked-at")  # the small file system ends with this process
        walk.busway("store", "check", str(folder / "data"))
    assert wrong == [], "\n".join(wrong[:20])


@contextlib.contextmanager
def walked(
    folder: Path, seed: int, *, segment: int = 60_000, collector: str = "", database: bool = False
) -> Iterator[Walk]:
    """A walk that has not begun, with the receivers that are installed; all is ended afterwards."""
    with Field(seed) as world, receivers_that_are_there(folder, database=database) as receivers:
        walk = Walk(folder, world, seed, segment=segment, receivers=receivers, collector=collector)
        try:
            yield walk
        finally:
            walk.collecting.close()


if __name__ == "__main__":
    judge_a_walk(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) or None, sys.argv[4])
