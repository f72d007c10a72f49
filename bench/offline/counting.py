"""The work of a script, counted and not timed, so that it is the same on a busy machine as on a quiet one.

Three figures per transaction:

* ``calls``: functions of busway that are entered, and functions in C that busway's own code calls;
* ``instructions``: bytecode instructions of busway's own code;
* ``bytes``: the most memory that a turn held at a time above what it found, as `tracemalloc` counts it.

1. Only code of the package counts, without `busway.testing`: neither the script nor the event loop.
2. An instruction of bytecode differs between versions of Python, so the figures of each are kept apart.
"""

import gc
import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import busway
from offline.layers import layer_of
from offline.scripts import TRANSACTIONS, Script, Turn
from offline.wire import MemoryLoop

HOUSE = f"{Path(busway.__file__).parent}/"
TESTING = f"{HOUSE}testing/"
WARMING = 3
"""Turns before those that count."""


@dataclass(frozen=True, slots=True)
class Work:
    """What one transaction of a script takes.

    Attributes:
        calls, instructions, bytes: as the module says.
        layers: instructions by layer.
    """

    calls: float
    instructions: float
    bytes: float
    layers: dict[str, float]


def count(script: Script) -> Work:
    """Count a script on a loop of its own."""
    loop = MemoryLoop()
    try:
        return loop.run_until_complete(_counted(loop, script))
    finally:
        loop.close()


async def _counted(loop: MemoryLoop, script: Script) -> Work:
    async with script(loop) as turn:
        for _ in range(WARMING):
            await turn()
        calls = await _calls(turn)
        layers = await _instructions(turn)
        most = await _bytes(turn)
    return Work(
        calls / TRANSACTIONS,
        sum(layers.values()) / TRANSACTIONS,
        most / TRANSACTIONS,
        {name: number / TRANSACTIONS for name, number in sorted(layers.items())},
    )


def _is_of_house(name: str) -> bool:
    return name.startswith(HOUSE) and not name.startswith(TESTING)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Garbage collection takes place before, not within."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


async def _calls(turn: Turn) -> int:
    calls = 0

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal calls
        if event in ("call", "c_call") and _is_of_house(frame.f_code.co_filename):
            calls += 1

    with _uncollected():
        sys.setprofile(profile)
        try:
            await turn()
        finally:
            sys.setprofile(None)
    return calls


async def _instructions(turn: Turn) -> Counter[str]:
    """By layer."""
    found: Counter[str] = Counter()
    with _uncollected():
        if sys.version_info >= (3, 12):
            await _monitored(turn, found)
        else:
            await _traced(turn, found)
    return found


async def _monitored(turn: Turn, found: Counter[str]) -> None:
    """Python 3.12 traces the instructions of a function only from its second call on; `sys.monitoring` sees all."""
    layers: dict[str, str | None] = {}
    monitoring = sys.monitoring
    tool = monitoring.PROFILER_ID

    def step(code: CodeType, offset: int) -> object:
        name = code.co_filename
        if name not in layers:
            layers[name] = layer_of(name.removeprefix(HOUSE)) if _is_of_house(name) else None
        layer = layers[name]
        if layer is None:
            return monitoring.DISABLE
        found[layer] += 1
        return None

    monitoring.use_tool_id(tool, "busway-bench")
    try:
        monitoring.register_callback(tool, monitoring.events.INSTRUCTION, step)
        monitoring.set_events(tool, monitoring.events.INSTRUCTION)
        await turn()
    finally:
        monitoring.set_events(tool, 0)
        monitoring.free_tool_id(tool)


async def _traced(turn: Turn, found: Counter[str]) -> None:
    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        if not _is_of_house(name):
            return None
        layer = layer_of(name.removeprefix(HOUSE))
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False

        def step(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "opcode":
                found[layer] += 1
            return step

        return step

    sys.settrace(trace)
    try:
        await turn()
    finally:
        sys.settrace(None)


async def _bytes(turn: Turn) -> int:
    with _uncollected():
        tracemalloc.start(1)
        try:
            await turn()  # what is made once and kept is there now
            return min([await _most_of_a_turn(turn) for _ in range(5)])
        finally:
            tracemalloc.stop()


async def _most_of_a_turn(turn: Turn) -> int:
    """Bytes of one turn. On a busy machine what a thread has not written yet is among them, in some turns."""
    gc.collect()
    before, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    await turn()
    return tracemalloc.get_traced_memory()[1] - before
