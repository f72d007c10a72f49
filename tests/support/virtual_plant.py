"""A whole collector in virtual time: its event loop, its wall clock, its links and its devices belong to the test.

Only the store and its threads are real. Hours pass in a second, and nothing depends on how fast the machine is.

1. Time of the loop moves in `VirtualPlant.advance` alone, from timer to timer. The wall clock is that time plus what
   the test set (`VirtualPlant.step_clock`).
2. A device is a table of registers and of bits, and what it does with a request (`VirtualDevice.mode`). A transaction
   takes `VirtualDevice.takes` seconds.
3. `VirtualPlant.kill` is what `kill -9` leaves: a copy of the folder as it is between two commits, in which the next
   collector starts. What was not committed is lost.
"""

import asyncio
import contextlib
import selectors
import shutil
import struct
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.apps.collector import collector as collector_module
from busway.apps.collector.store import committer as committer_module
from busway.codes import Table
from busway.errors import ExceptionReply, LinkDown, ModbusError, NoReply
from busway.pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters

NANOSECONDS = 1_000_000_000
BASE = 1_800_000_000 * NANOSECONDS
"""The wall clock where the loop's time is 0, if the test sets no other."""
LONGEST_SELECT = 0.001
"""Real seconds that the loop waits for threads before it looks again."""

MOST_TURNS = 100
"""Turns of the loop at one time after which that time moves a little."""
RESOLUTION = 1e-9

_TABLES: dict[type, Table] = {
    ReadCoils: Table.COILS,
    ReadDiscreteInputs: Table.DISCRETE_INPUTS,
    ReadHoldingRegisters: Table.HOLDING_REGISTERS,
    ReadInputRegisters: Table.INPUT_REGISTERS,
}


class _ShortSelector(selectors.DefaultSelector):
    """Never waits long, because time passes only where the test lets it."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        return super().select(LONGEST_SELECT if timeout is None else min(timeout, LONGEST_SELECT))


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop whose time stands still until a test moves it."""

    def __init__(self, start: float = 1000.0) -> None:
        self.now = start
        super().__init__(_ShortSelector())

    def time(self) -> float:
        return self.now

    async def settle(self) -> None:
        """Let everything run that is ready.

        A loop calls timers up to `RESOLUTION` early. Who then waits for the rest is called at once again, for ever
        where time stands still: it moves a little.
        """
        turns = 0
        for _ in range(3):
            await asyncio.sleep(0)
            while self._ready:  # type: ignore[attr-defined]
                turns += 1
                if turns > MOST_TURNS:
                    self.now += RESOLUTION
                assert turns < MOST_TURNS + 1000, "something is called again and again, and time does not pass"
                await asyncio.sleep(0)

    async def advance(self, seconds: float) -> None:
        """Let time pass, from timer to timer."""
        await self.advance_to(self.now + seconds)

    async def advance_to(self, end: float) -> None:
        while True:
            await self.settle()
            due = [handle.when() for handle in self._scheduled if not handle.cancelled()]  # type: ignore[attr-defined]
            if not due or min(due) > end:
                break
            self.now = max(self.now, min(due))
        self.now = max(self.now, end)
        await self.settle()


@dataclass(slots=True)
class VirtualDevice:
    """A device of the plant.

    Attributes:
        words, bits: what its registers and its bits hold, by table and offset; 0 where nothing is said.
        mode: ``answers``, ``silent``, ``down``, or the exception code that it answers with.
        takes: seconds of a transaction.
        asked: when it was asked, in time of the loop.
        before: called before each answer with its number, to change what it answers.
    """

    words: dict[int, int] = field(default_factory=dict)
    bits: dict[int, bool] = field(default_factory=dict)
    mode: str | int = "answers"
    takes: float = 0.0
    asked: list[float] = field(default_factory=list)
    before: Callable[["VirtualDevice"], None] = lambda device: None

    def set_float(self, start: int, value: float) -> None:
        self.words[start], self.words[start + 1] = struct.unpack(">HH", struct.pack(">f", value))

    def set_number(self, start: int, value: int, registers: int) -> None:
        for place in range(registers):
            self.words[start + place] = value >> 16 * (registers - 1 - place) & 0xFFFF

    def answer(self, request: Any) -> Any:
        self.before(self)
        if isinstance(self.mode, int):
            return ExceptionReply(self.mode)
        if self.mode == "silent":
            return NoReply("no reply")
        if self.mode == "down":
            return LinkDown("no connection")
        items = range(request.address, request.address + request.count)
        if _TABLES[type(request)].holds_bits:
            number = sum(self.bits.get(item, False) << place for place, item in enumerate(items))
            return type(request).Reply(number.to_bytes((request.count + 7) // 8, "little"))
        return type(request).Reply(b"".join(struct.pack(">H", self.words.get(item, 0) & 0xFFFF) for item in items))


class VirtualLink:
    """The link of a collector to devices of the plant."""

    def __init__(self, plant: "VirtualPlant", url: str) -> None:
        self._plant, self._url = plant, url

    async def run(self, unit: int, requests: Sequence[Any], call_options: Any) -> list[Any]:
        device, began = self._plant.device(self._url, unit), self._plant.loop.time()
        answers = []
        for request in requests:
            device.asked.append(self._plant.loop.time())
            if device.takes:
                await asyncio.sleep(device.takes)
            answers.append(device.answer(request))
        self._plant.transaction(began, self._plant.loop.time())
        if len(answers) == 1 and isinstance(answers[0], LinkDown):
            raise answers[0]
        assert all(isinstance(each, ModbusError) or hasattr(each, "data") for each in answers)
        return answers

    async def close(self) -> None:
        await self._plant.link_closes(self._url)


class VirtualPlant:
    """The plant of one test: loop, clock, devices, folder. Made by `run_virtually`.

    Attributes:
        folder: of the files and the store.
        loop: the event loop.
        link_closes: awaited while a link closes.
        transaction: told of each transaction before its samples are made: begin and end, in time of the loop.
    """

    def __init__(self, folder: Path, loop: VirtualLoop, base: int) -> None:
        self.folder, self.loop = folder, loop
        self._base, self._started = base, loop.now
        self._devices: dict[tuple[str, int], VirtualDevice] = {}
        self._copies = 0
        self._looked = threading.local()
        self.link_closes: Callable[[str], Coroutine[Any, Any, None]] = _at_once
        self.transaction: Callable[[float, float], None] = lambda began, ended: None

    def device(self, url: str, unit: int) -> VirtualDevice:
        """The device at an endpoint, made at the first look."""
        return self._devices.setdefault((url.partition("?")[0], unit), VirtualDevice())

    def time_ns(self) -> int:
        """The wall clock."""
        self._looked.at = now = self.loop.now
        return self._base + round((now - self._started) * NANOSECONDS)

    def moment(self) -> float:
        """The time of the loop when this thread last looked at the wall clock: it may have passed since."""
        return getattr(self._looked, "at", self.loop.now)

    def step_clock(self, seconds: float) -> None:
        """Set the wall clock forth or back."""
        self._base += round(seconds * NANOSECONDS)

    def set_clock(self, to: int) -> None:
        """Set the wall clock to nanoseconds since 1970."""
        self._base += to - self.time_ns()

    def write(self, **files: str) -> Path:
        """Write files ``name.toml``; the path of ``plant.toml``."""
        for name, text in files.items():
            (self.folder / f"{name}.toml").write_text(text)
        return self.folder / "plant.toml"

    @contextlib.asynccontextmanager
    async def collecting(self) -> AsyncIterator[busway.Collector]:
        """A collector by ``plant.toml``."""
        async with busway.collect(self.folder / "plant.toml") as collector:
            yield collector

    async def committed(self, collector: busway.Collector) -> None:
        """Wait until all that was read so far is in the store, and told."""
        assert collector._committer is not None
        assert await asyncio.to_thread(collector._committer.flush, 30.0)
        await self.loop.settle()

    def kill(self) -> None:
        """From now on the folder is a copy of what it is at this moment. Call it after `committed`."""
        self._copies += 1
        copy = self.folder.with_name(f"{self.folder.name.partition('~')[0]}~{self._copies}")
        for _ in range(100):
            try:
                shutil.copytree(self.folder, copy)
                break
            except shutil.Error:  # a log of SQLite ended in the middle of the copy: that was no moment
                shutil.rmtree(copy)
        self.folder = copy


async def _at_once(url: str) -> None:
    return None


def run_virtually(
    main: Callable[[VirtualPlant], Coroutine[Any, Any, Any]],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    base: int = BASE,
    start: float = 1000.0,
) -> None:
    """Run a test with a plant, in an event loop and by clocks of its own."""
    loop = VirtualLoop(start)
    folder = folder / "plant"
    folder.mkdir()
    plant = VirtualPlant(folder, loop, base)

    def opened(url: str, **options: Any) -> VirtualLink:
        return VirtualLink(plant, str(url))

    defaults = committer_module.Committer.__init__.__kwdefaults__
    assert defaults is not None
    with monkeypatch.context() as patched:
        patched.setattr(time, "time_ns", plant.time_ns)
        patched.setattr(collector_module, "open_link", opened)
        patched.setitem(defaults, "now", plant.time_ns)
        patched.setitem(defaults, "interval", 0.002)
        patched.setattr(committer_module, "ALIVE", 1e6)
        patched.setattr(committer_module, "UPKEEP", 1e6)
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(main(plant))
            left = asyncio.all_tasks(loop)
            assert not left, f"the test left tasks behind: {left}"
