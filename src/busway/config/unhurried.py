"""Work with many objects beside an event loop that must not wait for it.

Knows the garbage collector and lists; knows nothing of what is in them.

A thread shares the interpreter with the event loop, and gives it up every few milliseconds (``sys.getswitchinterval``),
but neither while the garbage collector looks at all objects nor while one large container is freed.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

_AT_ONCE: Final = 256
"""Elements that are freed without letting others on."""


@contextmanager
def collecting_paused() -> Iterator[None]:
    """Let the garbage collector rest while many objects are made that all stay, or go by themselves."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def let_go(lists: list[list[Any]]) -> None:  # Any: nothing is asked of them
    """Free the elements of lists in small steps. Nothing else may hold the lists."""
    for each in lists:
        while each:
            del each[-_AT_ONCE:]


def keep_uncollected() -> None:
    """Take all that exists from the garbage collector: it is freed when nothing refers to it, but no circle of it is.

    For a program that has read much which stays. What is in a circle now, and goes later, costs its memory.
    """
    gc.freeze()
