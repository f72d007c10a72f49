"""Passes the samples of a running collector to the programs that follow them, through one queue for each program.

Knows batches of samples; knows no store. A program that is too slow loses the oldest batches, which are counted; it
never slows polling down.
"""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Sequence
from typing import Final

from .samples import SampleBatch

MOST_WAITING: Final = 10_000
"""Most batches that wait for one program; beyond them the oldest is dropped."""


class _Reader:
    """One program that follows samples, with the queue of batches that it has not read.

    Attributes:
        devices: names of the devices whose samples the program gets; None for all.
        waiting: the batches that it has not read, oldest first.
        arrived: set when there may be new batches, or when reading ends.
        lost: number of batches that were dropped because the queue was full.
    """

    def __init__(self, devices: frozenset[str] | None) -> None:
        self.devices = devices
        self.waiting: deque[SampleBatch] = deque(maxlen=MOST_WAITING)
        self.arrived = asyncio.Event()
        self.lost = 0

    def take(self, batches: Sequence[SampleBatch]) -> None:
        """Queue the batches of this reader's devices; a full queue drops its oldest one."""
        for batch in batches:
            if self.devices is None or batch.device in self.devices:
                self.lost += len(self.waiting) == MOST_WAITING
                self.waiting.append(batch)
        self.arrived.set()


class SampleReaders:
    """The programs that follow the samples of one collector; passes new samples to each. Used in one event loop only.

    ``bool()`` of the object is True while at least one program follows.

    Attributes:
        lost: number of batches that were dropped because a program was too slow; counted when the program ends its
            iteration of `read`.
    """

    def __init__(self) -> None:
        self.lost: int = 0
        self._readers: list[_Reader] = []
        self._has_begun = False

    def __bool__(self) -> bool:
        return bool(self._readers)

    def begin(self) -> None:
        """Let `read` wait for new samples. Before this call, and after `end`, `read` ends when its queue is empty."""
        self._has_begun = True

    async def read(self, devices: frozenset[str] | None) -> AsyncGenerator[SampleBatch, None]:
        """Yield the batches that `take` gets from the first iteration on, until `end` is called.

        Args:
            devices: names of the devices whose samples are wanted; None for all.
        """
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
        """Queue new samples for all programs that follow their devices. Never waits.

        A full queue drops its oldest batches.
        """
        for reader in self._readers:
            reader.take(batches)

    def end(self) -> None:
        """Let each `read` end after the samples that are in its queue now."""
        self._has_begun = False
        for reader in self._readers:
            reader.arrived.set()
