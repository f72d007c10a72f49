"""Keeps the garbage collector from pausing the event loop while many objects are created or freed.

Knows the garbage collector and lists; knows nothing of what is in them.

A thread shares the interpreter with the event loop, and lets the event loop run every few milliseconds
(``sys.getswitchinterval``), but neither while the garbage collector looks at all objects nor while one large container
is freed.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

_AT_ONCE: Final = 256
"""Number of elements that are freed in one step; between two steps other threads can run."""


@contextmanager
def collecting_paused() -> Iterator[None]:
    """Context manager that switches the garbage collector off, for code that creates or frees many objects.

    Afterwards it is on again if it was on before.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def let_go(lists: list[list[Any]]) -> None:  # Any: nothing is asked of them
    """Empty lists in small steps, so that other threads can run while their elements are freed.

    Args:
        lists: the lists; the caller must hold the only references to them and to their elements.
    """
    for each in lists:
        while each:
            del each[-_AT_ONCE:]


def keep_uncollected() -> None:
    """Exclude all existing objects from the garbage collector's work: they are freed by reference counting only.

    Meant for a program that has read much data which stays in memory. Reference cycles among the existing objects are
    never freed.
    """
    gc.freeze()
