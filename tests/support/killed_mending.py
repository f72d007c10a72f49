"""A process of a virtual plant that is killed while it corrects times from before its clock was set."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from virtual_plant import VirtualPlant

from busway.apps.collector.store.writer import StoreWriter


@dataclass(slots=True)
class Kill:
    """Whether the process was killed so far; the thread that commits sets it."""

    is_done: bool = False


@contextmanager
def killed_while_mending(plant: VirtualPlant, writer: StoreWriter, call: int | None) -> Iterator[Kill]:
    """Context manager in which a process is killed just before it mends one more segment.

    Args:
        plant: the plant.
        writer: the store of the process.
        call: number of the call of `StoreWriter.mend_next`, from 0 on, that is not made before the kill; None for none.
    """
    mend_next, kill, calls = writer.mend_next, Kill(), 0

    def mend_next_or_die() -> bool:
        nonlocal calls
        if calls == call:
            plant.kill()
            kill.is_done = True
        calls += 1
        return mend_next()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(writer, "mend_next", mend_next_or_die)
        yield kill
