"""A whole collector on a machine whose clock is set late, again, or never: seeded walks in virtual time.

1. A device counts its answers, so each sample tells which answer it is of, and the test knows when that was.
2. Processes begin in 1970 or with the right time; in some of those the clock is set after a while. They end or are
   killed, also while samples are mended. Devices are maintained and fall silent meanwhile, alarms come and go.
3. In the end each sample is in the store once, good and with the right time where its process learnt that, and as it
   was written otherwise; intervals, alarms, buckets and what a sink got say the same.
"""

import asyncio
import json
import os
import random
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from killed_mending import killed_while_mending
from virtual_plant import BASE, NANOSECONDS, VirtualDevice, VirtualPlant, run_virtually

import busway
from busway.apps.collector.samples import Reason
from busway.apps.collector.sinks import delivery
from busway.apps.collector.store.writer import Commit

SEEDS = [int(each) for each in os.environ.get("BUSWAY_CLOCK_SEEDS", "2 5 6").split()]
YEAR_2026 = 1_767_225_600 * NANOSECONDS
TOLERANCE = 2_000
"""Most nanoseconds that a time may be wrong because a monotonic clock is a float."""
PROFILE = """\
[[unit]]
unit = 1
point = [
    { name = "count", address = "4x1", type = "uint32" },
    { name = "phase", formula = "count % 10", alarm = [{ kind = "H", limit = 4.5 }] },
]
"""
PLANT = """\
[collector]
store = "data"
[poll_class]
all.period = 5.0
[[link]]
name = "a"
url = "tcp://127.0.0.1:1"
[[device]]
name = "one"
link = "a"
unit = 1
profile = "profile.toml"
[[device]]
name = "two"
link = "a"
unit = 2
profile = "profile.toml"
[[sink]]
name = "lines"
url = "file://OUT/lines.jsonl"
age = 0.02
"""


@dataclass(slots=True)
class Life:
    """One process: the difference of its clock to the truth, and from when on that is known."""

    behind: int
    is_right: bool
    is_killed: bool = False


@dataclass(frozen=True, slots=True)
class Answered:
    """One answer of a device: at which time of the loop, in which process, and whether its clock was right by then."""

    middle: int
    life: int


class ClockWalk:
    """A plant, its collectors one after the other, and what the devices answered."""

    def __init__(self, plant: VirtualPlant, seed: int, *, steps: bool = False) -> None:
        self.plant, self.chance, self.steps = plant, random.Random(seed), steps
        self.start = plant.loop.now
        self.lives: list[Life] = []
        self.answers: dict[str, list[Answered]] = {"one": [], "two": []}
        self.devices = {name: plant.device("tcp://127.0.0.1:1", unit) for name, unit in (("one", 1), ("two", 2))}
        self.lost: set[tuple[str, int]] = set()
        self.maintained: set[str] = set()
        self.done: list[str] = []
        self.newest = 0
        self.out = plant.folder.parent / "out"
        self.out.mkdir()
        plant.write(profile=PROFILE, plant=PLANT.replace("OUT", str(self.out)))
        for name, device in self.devices.items():
            device.takes = self.chance.choice((0.0625, 0.25))
            device.before = self._answering(name)

    def _answering(self, name: str) -> Any:
        def before(device: VirtualDevice) -> None:
            if device.mode == "answers":
                number = len(self.answers[name])
                device.set_number(0, number, 2)
                middle = round((self.plant.loop.now - device.takes / 2) * NANOSECONDS)
                self.answers[name].append(Answered(middle, len(self.lives) - 1))
                if name in self.maintained:
                    self.lost.add((name, number))  # maintenance began while the read was under way

        return before

    def truth(self, loop_time: float) -> int:
        """What a right wall clock shows."""
        return BASE + round((loop_time - self.start) * NANOSECONDS)

    # What happens.

    async def run(self) -> None:
        lives = self.chance.choice((2, 3, 4))
        for number in range(lives):
            await self.live(is_last=number == lives - 1)
            await self.plant.loop.advance(self.chance.choice((1.0, 30.0, 2000.0)))

    async def live(self, *, is_last: bool) -> None:
        """One process, from its start to its end or its death."""
        now = self.truth(self.plant.loop.now)
        unset = self.chance.random() < 0.75
        shown = round(self.chance.uniform(20, 90) * NANOSECONDS) if unset else now
        self.plant.set_clock(shown)
        life = Life(now - shown, not unset)
        self.lives.append(life)
        self.done.append(f"a process begins, {'behind' if unset else 'right'}")
        sets_at = self.chance.randrange(1, 6) if is_last or self.chance.random() < 0.75 else 99
        dies: str = self.chance.choice(("ends", "is killed", "is killed while it mends"))
        async with self.plant.collecting() as collector:
            collector.subscribe(self.note)
            for step in range(7):
                if step == sets_at and unset:
                    await self.set_clock(collector, dies)
                    if life.is_killed:
                        break
                await self.something(collector)
            if dies == "is killed" and not is_last and not life.is_killed:
                await self.plant.committed(collector)
                self.plant.kill()
                life.is_killed = True
                self.done.append("killed")
            elif not life.is_killed:
                self.done.append("ends")
                if is_last:
                    await self.plant.committed(collector)
                    await self.delivered(collector)
        if life.is_killed and is_last:
            await self.live(is_last=True)

    async def set_clock(self, collector: busway.Collector, dies: str) -> None:
        """The clock is set, which is noticed within five seconds; perhaps the process dies over it."""
        assert collector._committer is not None
        life = self.lives[-1]
        await self.plant.committed(collector)
        dies_at = self.chance.randrange(4) if dies == "is killed while it mends" else None
        with killed_while_mending(self.plant, collector._committer.writer, dies_at) as kill:
            self.plant.set_clock(self.truth(self.plant.loop.now))
            before = {name: len(each) for name, each in self.answers.items()}
            await self.plant.loop.advance(5.0)
            late = {name: range(before[name], len(each)) for name, each in self.answers.items()}
            await self.plant.committed(collector)
        life.is_killed = kill.is_done
        life.is_right = True
        if life.is_killed:  # what was committed after the copy is lost
            self.done.append(f"killed while it mends, at call {dies_at}")
            for name, numbers in late.items():
                self.lost |= {(name, number) for number in numbers}
        else:
            self.done.append("the clock is set")
            self.check_life(len(self.lives) - 1)

    async def something(self, collector: busway.Collector) -> None:
        deed = self.chance.choice(("time", "time", "time", "long", "silence", "maintenance", "no answer"))
        self.done.append(deed)
        device = self.chance.choice(list(self.devices))
        if deed == "time":
            await self.plant.loop.advance(self.chance.uniform(3.0, 60.0))
        elif deed == "long":
            await self.plant.loop.advance(self.chance.uniform(600.0, 1900.0))
        elif deed == "silence":
            self.devices[device].mode = self.chance.choice(("silent", "down"))
            await self.plant.loop.advance(self.chance.uniform(3.0, 60.0))
            self.devices[device].mode = "answers"
            await self.plant.loop.advance(60.0)
        elif deed == "no answer":  # so segments have no samples
            for each in self.devices.values():
                each.mode = "silent"
            await self.plant.loop.advance(self.chance.uniform(600.0, 1900.0))
            for each in self.devices.values():
                each.mode = "answers"
            await self.plant.loop.advance(60.0)
        else:
            begins = device not in collector.in_maintenance()
            (self.maintained.add if begins else self.maintained.discard)(device)
            collector.maintenance(device, begins=begins, by="otto", why="a walk")
        await self.plant.committed(collector)

    def note(self, commit: Commit) -> None:
        """Remember the newest commit."""
        self.newest = commit.number

    async def delivered(self, collector: busway.Collector) -> None:
        """Wait until the sink has everything; it need not wait for a clock that an earlier process never had."""
        delivery.CLOCK_WAIT = 0.0  # type: ignore[misc]
        for _ in range(2000):
            (status,) = collector.sink_statuses()
            if status.cursor >= self.newest:
                return
            await asyncio.sleep(0)
            await asyncio.to_thread(asyncio.run, asyncio.sleep(0.01))
        raise AssertionError(f"the sink does not get everything: {status}")

    # What must hold.

    def wanted_time(self, answer: Answered) -> int:
        life = self.lives[answer.life]
        return self.truth(answer.middle / NANOSECONDS) - (0 if life.is_right else life.behind)

    def check_life(self, number: int) -> None:
        """What a process has written is right at once when the clock is set."""
        self.check(number)

    def check(self, only: int | None = None) -> None:
        """Each answer is there once, with its right time and quality."""
        store = busway.Store(self.plant.folder / "data")
        for device in self.devices:
            table = store.read(f"{device}/count")
            found = Counter(value for value in table.value if value is not None)
            assert set(found.values()) <= {1}, f"twice: {[n for n, count in found.items() if count > 1]}"
            times = {
                value: (time, reason) for time, value, reason in zip(table.time, table.value, table.reason, strict=True)
            }
            for number, answer in enumerate(self.answers[device]):
                if only is not None and answer.life != only:
                    continue
                if (device, number) in self.lost and number not in times:
                    continue
                assert number in times, f"{device} {number} of process {answer.life} is lost: {self.done}"
                time, reason = times[number]
                wrong = time - self.wanted_time(answer)
                assert abs(wrong) <= TOLERANCE, f"{device} {number} of process {answer.life}: {wrong} ns, {self.done}"
                assert reason == (0 if self.lives[answer.life].is_right else Reason.CLOCK), self.done
            if only is None:
                assert table.time == sorted(table.time)

    def check_alarms(self) -> None:
        """Each event of the journal has the time of the sample that caused it, each once."""
        store = busway.Store(self.plant.folder / "data")
        for device in self.devices:
            table = store.read(f"{device}/phase")
            number_at = dict(zip(*self._counted(store, device), strict=True))
            in_order = sorted(
                (number_at[time], time, value)
                for time, value in zip(table.time, table.value, strict=True)
                if time in number_at
            )
            wanted, active = [], False
            for _, time, value in in_order:
                if (value > 4.5) is not active:  # type: ignore[operator]
                    active = not active
                    wanted.append(("raised" if active else "cleared", time))
            found = [(str(each.kind), each.at) for each in store.alarms(f"{device}/phase")]
            assert found == wanted, self.done

    def _counted(self, store: busway.Store, device: str) -> tuple[list[int], list[int]]:
        """Times and numbers of the answers of a device that are in the store."""
        table = store.read(f"{device}/count")
        kept = [(time, value) for time, value in zip(table.time, table.value, strict=True) if value is not None]
        return [time for time, _ in kept], [int(value) for _, value in kept]

    def check_intervals(self) -> None:
        """Intervals are where no sample is."""
        store = busway.Store(self.plant.folder / "data")
        for device in self.devices:
            table = store.read(f"{device}/count")
            samples = {time: value for time, value in zip(table.time, table.value, strict=True) if value is not None}
            for gap in table.gaps:
                assert gap.begin >= YEAR_2026 or gap.end < YEAR_2026, (
                    f"{gap} begins and ends at two clocks: {self.done}"
                )
            for each in table.intervals:
                if each.reason == Reason.SKIPPED:  # a round; a probe may have been answered in that time
                    continue
                end = each.end if each.end is not None else 2**63
                assert each.begin <= end
                if each.begin < YEAR_2026:  # of a process that never knew the time, and so may have others of these
                    assert end < YEAR_2026, f"{each} ends at another clock: {self.done}"
                    assert not all(life.is_right for life in self.lives), f"{each} was not mended: {self.done}"
                    continue
                inside = [value for time, value in samples.items() if each.begin <= time < end]
                assert not inside, f"{device} was read in {each}: {inside[:5]}, {self.done}"

    def check_buckets(self) -> None:
        """Buckets are what the samples are."""
        store = busway.Store(self.plant.folder / "data")
        for size in (60, 600):
            for device in self.devices:
                table = store.read(f"{device}/count", since=BASE, bucket=size)
                sums: dict[int, list[int]] = defaultdict(list)
                samples = store.read(f"{device}/count", since=BASE)
                for time, value, reason in zip(samples.time, samples.value, samples.reason, strict=True):
                    if value is not None and reason < 16:
                        sums[time // (size * NANOSECONDS) * size * NANOSECONDS].append(int(value))
                found = {
                    time: (low, high, count)
                    for time, low, high, count in zip(
                        table.time, table.minimum, table.maximum, table.count, strict=True
                    )
                    if count
                }
                assert found == {time: (min(each), max(each), len(each)) for time, each in sums.items()}, self.done

    def check_sink(self) -> None:
        """The sink got each sample with the time that it has in the store, and never with another one."""
        stored: dict[tuple[str, Any], int] = {}  # a value is a number here
        store = busway.Store(self.plant.folder / "data")
        for device in self.devices:
            table = store.read(f"{device}/count")
            stored |= {
                (device, value): time for time, value in zip(table.time, table.value, strict=True) if value is not None
            }
        got: dict[tuple[str, int], list[int]] = defaultdict(list)
        for line in (self.out / "lines.jsonl").read_text().splitlines():
            each = json.loads(line)
            if each["point"] == "count" and each["value"] is not None:
                got[each["device"], each["value"]].append(each["time"])
        for key, time in stored.items():
            assert got[key], f"{key} was not handed on: {self.done}"
            assert set(got[key]) == {time}, f"{key}: {got[key]} is not {time}: {self.done}"


@pytest.mark.parametrize("seed", SEEDS)
def test_samples_from_before_the_clock_was_set_are_mended_once_and_none_is_lost(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "CLOCK_WAIT", 1e9)

    async def main(plant: VirtualPlant) -> None:
        walk = ClockWalk(plant, seed)
        try:
            await walk.run()
            walk.check()
            walk.check_alarms()
            walk.check_intervals()
            walk.check_buckets()
            walk.check_sink()
        finally:
            print(walk.done)  # shown where the test fails

    run_virtually(main, tmp_path, monkeypatch)


@dataclass(frozen=True, slots=True)
class Shown:
    """An answer: what the wall clock showed in its middle, and how long it had shown it without a step."""

    wall: int
    steady: float


@pytest.mark.parametrize("seed", SEEDS)
def test_steps_of_the_clock_lose_and_double_nothing_and_keep_the_order(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that was right is set by an hour, by little, and to 1970 and back, over processes that end and die."""
    chance = random.Random(seed)
    steps = (3600.0, -3600.0, 3600.0, -3600.0, 0.4, -0.4, 7.0, -7.0)
    shown: list[Shown] = []
    done: list[str] = []

    async def main(plant: VirtualPlant) -> None:
        device = plant.device("tcp://127.0.0.1:1", 1)
        plant.device("tcp://127.0.0.1:1", 2).mode = "silent"
        device.takes = 0.125
        stepped_at = 0.0

        def before(device: VirtualDevice) -> None:
            device.set_number(0, len(shown), 2)
            half = round(device.takes / 2 * NANOSECONDS)
            shown.append(Shown(plant.time_ns() - half, plant.loop.now - stepped_at))

        device.before = before
        plant.write(profile=PROFILE, plant=PLANT.partition("[[sink]]")[0])
        lives = []
        for _ in range(3):
            lives.append(len(shown))
            async with plant.collecting() as collector:
                for _ in range(12):
                    deed = chance.choice(("step", "time", "time", "long", "to 1970"))
                    done.append(deed)
                    if deed == "step":
                        plant.step_clock(chance.choice(steps))
                        stepped_at = plant.loop.now
                    elif deed == "to 1970":
                        now, stepped_at = plant.time_ns(), plant.loop.now
                        plant.set_clock(50 * NANOSECONDS)
                        await plant.loop.advance(chance.choice((1.0, 20.0, 700.0)))
                        plant.set_clock(now)
                        stepped_at = plant.loop.now
                    await plant.loop.advance(chance.uniform(600, 5000) if deed == "long" else chance.uniform(1, 60))
                await plant.committed(collector)
                if chance.random() < 0.5:
                    plant.kill()
            await plant.loop.advance(chance.choice((1.0, 3000.0)))
        table = busway.Store(plant.folder / "data").read("one/count")
        kept = {
            int(value): (time, reason)
            for time, value, reason in zip(table.time, table.value, table.reason, strict=True)
            if value is not None
        }
        assert sum(value is not None for value in table.value) == len(kept), "a sample is there twice"
        assert sorted(kept) == list(range(len(shown))), "a sample is lost"
        for number, (time, reason) in kept.items():
            assert reason in (0, Reason.CLOCK)
            if number and number not in lives:
                assert time > kept[number - 1][0], f"sample {number} comes before the one before it"
            if reason == 0 and shown[number].steady > 6.0:
                ahead = time - shown[number].wall
                assert -TOLERANCE <= ahead <= NANOSECONDS // 2, (number, ahead)
        assert any(reason == 0 for _, reason in kept.values())

    try:
        run_virtually(main, tmp_path, monkeypatch)
    finally:
        print(done)  # shown where the test fails
