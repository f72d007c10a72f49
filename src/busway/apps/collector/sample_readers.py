"""The programs that follow the samples of a running collector, each with a queue of those it has not read.

Knows batches of samples; knows no store. A reader that is too slow loses the oldest batches, which is counted; it never
slows polling down.
"""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Sequence
from typing import Final

from .samples import SampleBatch

MOST_WAITING: Final = 10_000
"""Batches that wait for one reader, at most."""


class _Reader:
    """One program that follows samples, with the queue of those it has not read."""

    def __init__(self, devices: frozenset[str] | None) -> None:
        self.devices = devices
        self.waiting: deque[SampleBatch] = deque(maxlen=MOST_WAITING)
        self.arrived = asyncio.Event()
        self.lost = 0

    def take(self, batches: Sequence[SampleBatch]) -> None:
        for batch in batches:
            if self.devices is None or batch.device in self.devices:
                self.lost += len(self.waiting) == MOST_WAITING
                self.waiting.append(batch)
        self.arrived.set()


class SampleReaders:
    """All programs that iterate over the samples of one collector. For one event loop.

    Attributes:
        lost: batches that readers which have ended were too slow for.
    """

    def __init__(self) -> None:
        self.lost: int = 0
        self._readers: list[_Reader] = []
        self._has_begun = False

    def __bool__(self) -> bool:
        return bool(self._readers)

    def begin(self) -> None:
        """Let iterations wait for new samples; before this, and after `end`, they return what is queued and stop."""
        self._has_begun = True

    async def read(self, devices: frozenset[str] | None) -> AsyncGenerator[SampleBatch, None]:
        """Yield the samples of these devices (None: of all devices) from now on, until `end`."""
        reader = _Reader(devices)
        self._readers.append(reader)
        try:
            while True:
                while reader.waiting:
                    yield reader.waiting.popleft()
                if not self._has_begun:
                    return
                reader.arrived.clear()
                await reader.arrived.wait()
        finally:
            self._readers.remove(reader)
            self.lost += reader.lost

    def take(self, batches: Sequence[SampleBatch]) -> None:
        """Queue new samples for all iterations that want them."""
        for reader in self._readers:
            reader.take(batches)

    def end(self) -> None:
        """End each iteration over samples after those already queued for it."""
        self._has_begun = False
        for reader in self._readers:
            reader.arrived.set()
