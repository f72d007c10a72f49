"""A collector on machines whose clock is wrong until a time service sets it, and wrong again when that is lost.

1. A device counts its answers, one each second, at times that a clock set by whole seconds gives twice.
2. Machines begin with a clock that is wrong by a second, an hour, a day or decades. A time service sets it, or never;
   it is lost, and the clock is stepped meanwhile. Processes end, and are killed, also while samples are mended.
3. In the end each sample is in the store once. A good one has the time of a right clock, in the store, as last value
   and in a sink; each of a process that learnt the time, from before that, is good.
"""

import json
import os
import random
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from killed_mending import killed_while_mending
from virtual_plant import BASE, NANOSECONDS, VirtualDevice, VirtualPlant, run_virtually

import busway
from busway.apps.collector import time_service
from busway.apps.collector.samples import Reason
from busway.apps.collector.sinks import delivery
from busway.apps.collector.time_service import Synchronisation

SEEDS = [int(each) for each in os.environ.get("BUSWAY_TRUST_SEEDS", "1 2 3").split()]
LATE = NANOSECONDS // 2
"""Most nanoseconds that a good sample may be ahead after a clock was set back."""
ROUNDING = 2_000
"""Most nanoseconds that a time may be wrong because a monotonic clock is a float."""
OFFSETS = (-86_400, -3600, -5, -1, 0, 1, 5, 3600, 86_400, None)
"""Seconds that a machine's clock is ahead when it begins; None: it begins in 1970."""
PROFILE = """\
[[unit]]
unit = 1
point = [
    { name = "count", address = "4x1", type = "uint32" },
    { name = "twice", formula = "count * 2" },
]
"""
PLANT = """\
[collector]
store = "data"
clock = "TRUST"
[poll_class]
all.period = 1.0
[[link]]
name = "a"
url = "tcp://127.0.0.1:1"
[[device]]
name = "one"
link = "a"
unit = 1
profile = "profile.toml"
[[sink]]
name = "lines"
url = "file://lines.jsonl"
age = 0.02
"""


@dataclass(slots=True)
class Answer:
    """An answer of the device: its right time, and the number of the process that read it."""

    right: int
    life: int


class TrustWalk:
    """A plant, its machines and processes one after the other."""

    def __init__(self, plant: VirtualPlant, seed: int) -> None:
        self.plant, self.chance = plant, random.Random(seed)
        self.trust = self.chance.choice(("auto", "synchronised"))
        self.start = self.boot = plant.loop.now
        self.says = Synchronisation.YES
        self.answers: list[Answer] = []
        self.learnt: dict[int, int] = {}
        self.lossy: set[int] = set()
        self.excused: set[int] = set()
        self.life = -1
        self.done: list[str] = [self.trust]
        plant.write(profile=PROFILE, plant=PLANT.replace("TRUST", self.trust))
        device = plant.device("tcp://127.0.0.1:1", 1)
        device.takes = self.chance.choice((0.125, 0.25))
        device.before = self.before

    def before(self, device: VirtualDevice) -> None:
        device.set_number(0, len(self.answers), 2)
        middle = self.plant.loop.now - device.takes / 2
        self.answers.append(Answer(self.truth(middle), self.life))

    def truth(self, at: float | None = None) -> int:
        return BASE + round(((self.plant.loop.now if at is None else at) - self.start) * NANOSECONDS)

    async def run(self) -> None:
        left, is_mended = self.chance.choice((2, 3, 3)), True
        while left > 0 or not is_mended:
            is_mended = await self.process()
            await self.plant.loop.advance(self.chance.choice((1.0, 30.0, 4000.0)))
            left -= 1

    def begin(self) -> None:
        """A machine begins with a clock that was not set, or a process begins on a machine whose clock is right."""
        if self.chance.random() < 0.8:
            self.boot, self.says = self.plant.loop.now - self.chance.choice((5.0, 20.0)), Synchronisation.NO
            offset = self.chance.choice(OFFSETS)
            self.plant.set_clock(100 * NANOSECONDS if offset is None else self.truth() + offset * NANOSECONDS)
            self.done.append(f"boots, wrong by {offset}")
        else:
            self.set_right("a process begins")

    def set_right(self, why: str) -> None:
        self.plant.set_clock(self.truth())
        self.says = Synchronisation.YES
        self.done.append(why)

    async def process(self) -> bool:
        """One process; return False if it dies while it mends, which the next one completes."""
        self.life += 1
        self.begin()
        if self.says is Synchronisation.YES:
            self.learnt[self.life] = len(self.answers)
        async with self.plant.collecting() as collector:
            for _ in range(self.chance.randrange(3, 8)):
                if await self.something(collector):
                    return False
                await self.plant.committed(collector)
                self.check_last(collector)
                if self.chance.random() < 0.12:
                    self.plant.kill()
                    self.done.append("killed")
                    return True
            await self.plant.committed(collector)
        return True

    async def something(self, collector: busway.Collector) -> bool:
        """Do one thing; return whether the process was killed over it."""
        loop, deed = self.plant.loop, self.chance.choice(("time", "time", "roll", "set", "lose", "silence"))
        if deed == "set" and self.says is Synchronisation.NO:
            return await self.set_clock(collector)
        elif deed == "lose" and self.says is Synchronisation.YES and self.trust == "synchronised":
            self.done.append("lost, and stepped")
            self.says = Synchronisation.NO
            self.lossy.add(self.life)
            await loop.advance(self.chance.uniform(0.0, 3.0))
            self.plant.step_clock(self.chance.choice((-3600.0, -5.0, -1.0, 1.0, 5.0, 3600.0)))
            await loop.advance(self.chance.uniform(0.0, 20.0))
        elif deed == "roll":
            assert collector._committer is not None
            await self.plant.committed(collector)
            collector._committer.writer.roll()
        elif deed == "silence":
            device = self.plant.device("tcp://127.0.0.1:1", 1)
            device.before, device.mode = lambda device: None, "silent"
            await loop.advance(self.chance.uniform(2.0, 20.0))
            device.before, device.mode = self.before, "answers"
            await loop.advance(40.0)
        else:
            await loop.advance(self.chance.uniform(1.0, 40.0))
        return False

    async def set_clock(self, collector: busway.Collector) -> bool:
        """A time service sets the clock, which is noticed within five seconds; return whether the process dies over it.

        What it reads after its folder was copied is not in the copy.
        """
        assert collector._committer is not None
        dies_at = self.chance.randrange(3) if self.chance.random() < 0.4 and self.life not in self.learnt else None
        await self.plant.committed(collector)
        with killed_while_mending(self.plant, collector._committer.writer, dies_at) as kill:
            number = len(self.answers)
            self.learnt.setdefault(self.life, number)
            self.set_right("set")
            await self.plant.loop.advance(6.0)
            await self.plant.committed(collector)
        if kill.is_done:
            self.done.append(f"killed at call {dies_at}")
            self.excused |= set(range(number, len(self.answers)))
        return kill.is_done

    # What must hold.

    def limit(self, answer: Answer) -> int:
        return LATE + ROUNDING if answer.life in self.lossy else ROUNDING

    def check_last(self, collector: busway.Collector) -> None:
        last = collector.values.last("one", "count")
        if last is not None and last[1] == 0 and last[0] is not None:
            self.check_time(int(last[0]), last[2], "last value")

    def check_time(self, number: int, time: int, where: str) -> None:
        wrong = time - self.answers[number].right
        assert abs(wrong) <= self.limit(self.answers[number]), f"{where} {number} is wrong by {wrong} ns: {self.done}"

    def check(self) -> None:
        store = busway.Store(self.plant.folder / "data")
        table = store.read("one/count")
        kept = [(t, int(v), r) for t, v, r in zip(table.time, table.value, table.reason, strict=True) if v is not None]
        counts = Counter(number for _, number, _ in kept)
        assert set(counts.values()) <= {1}, f"twice: {[n for n, c in counts.items() if c > 1]} {self.done}"
        lost = set(range(len(self.answers))) - counts.keys() - self.excused
        assert not lost, f"lost: {sorted(lost)[:5]}: {self.done}"
        times = {number: (time, reason) for time, number, reason in kept}
        for number, (time, reason) in times.items():
            answer = self.answers[number]
            if reason == 0:
                self.check_time(number, time, "sample")
            else:
                assert reason == Reason.CLOCK
                learnt = self.learnt.get(answer.life)
                is_mended = learnt is not None and (number < learnt or answer.life not in self.lossy)
                assert not is_mended, f"{number} of process {answer.life} was not mended: {self.done}"
        derived = store.read("one/twice")
        for time, value, reason in zip(derived.time, derived.value, derived.reason, strict=True):
            if value is not None:
                number = int(value) // 2
                assert (time, reason) == times[number], f"{number} and twice {number} differ: {self.done}"
        for life in {each.life for each in self.answers}:
            mine = [times[number][0] for number in sorted(times) if self.answers[number].life == life]
            assert mine == sorted(set(mine)), f"order of process {life}: {self.done}"
        good = [time for number, (time, reason) in sorted(times.items()) if reason == 0]
        assert self.lossy or good == sorted(good), self.done
        for gap in table.gaps:
            assert gap.begin <= gap.end
        if self.learnt.keys() == set(range(self.life + 1)) and not self.lossy:
            for gap in table.gaps:
                inside = [n for n, (t, _) in times.items() if gap.begin < t < gap.end and n not in self.excused]
                assert not inside, f"{inside[:4]} are in {gap}: {self.done}"

    def check_sink(self) -> None:
        file = self.plant.folder / "lines.jsonl"
        for line in file.read_text().splitlines() if file.exists() else ():
            each: dict[str, Any] = json.loads(line)
            if each["point"] == "count" and each["value"] is not None and each["quality"] == "good":
                self.check_time(each["value"], each["time"], "line of a sink")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_good_sample_has_the_right_time_and_none_is_lost_whatever_clocks_do(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "CLOCK_WAIT", 1e9)

    async def main(plant: VirtualPlant) -> None:
        walk = TrustWalk(plant, seed)
        monkeypatch.setattr(time_service, "kernel_synchronisation", lambda: walk.says)
        monkeypatch.setattr(time_service, "seconds_since_boot", lambda: plant.loop.now - walk.boot)
        try:
            await walk.run()
            walk.check()
            walk.check_sink()
        finally:
            print(walk.done)  # shown where the test fails

    run_virtually(main, tmp_path, monkeypatch)
