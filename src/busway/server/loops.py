"""Runs the event loops that this library starts itself: uvloop's if it is installed, otherwise asyncio's.

A program that runs its own event loop chooses the loop itself; this library does not change it.
"""

import asyncio
from collections.abc import Coroutine
from importlib import import_module
from typing import Any, TypeVar

Result = TypeVar("Result")


def run(main: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine to its end on a new event loop and return its result."""
    try:
        with asyncio.Runner(loop_factory=_loop_factory()) as runner:
            return runner.run(main)
    finally:
        main.close()  # it has not begun if the system has no descriptors for another event loop


def _loop_factory() -> Any:  # a callable that makes an event loop, or None
    try:
        return import_module("uvloop").new_event_loop
    except ImportError:
        return None
