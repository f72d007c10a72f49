"""Signals: Ctrl-C and SIGTERM end commands that run until they are stopped; SIGHUP lets them read their files again."""

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def stop_event() -> Iterator[asyncio.Event]:
    """Context manager that yields an event set by Ctrl-C or SIGTERM; a second Ctrl-C interrupts as usual.

    Enter it in the running event loop. Outside the main thread, which alone has signals, the event is never set.
    """
    loop = asyncio.get_running_loop()
    event = asyncio.Event()
    before: dict[int, object] = {}

    def stop(number: int, frame: object) -> None:
        loop.call_soon_threadsafe(event.set)
        signal.signal(number, before[number])  # type: ignore[arg-type]  # what signal.signal gave

    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # only the main thread has signals
            before[number] = signal.signal(number, stop)
    try:
        yield event
    finally:
        for installed, handler in before.items():
            signal.signal(installed, handler)  # type: ignore[arg-type]


@contextlib.contextmanager
def stop_events() -> Iterator[tuple[asyncio.Event, asyncio.Event]]:
    """Context manager that yields two events: the first Ctrl-C or SIGTERM sets one, the next signal sets the other.

    A third signal interrupts as usual.
    """
    loop = asyncio.get_running_loop()
    first, second = asyncio.Event(), asyncio.Event()
    left = [first, second]
    before: dict[int, Any] = {}  # what signal.signal gave

    def stop(number: int, frame: object) -> None:
        loop.call_soon_threadsafe(left.pop(0).set)
        if not left:
            for installed, handler in before.items():
                signal.signal(installed, handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # only the main thread has signals
            before[number] = signal.signal(number, stop)
    try:
        yield first, second
    finally:
        for installed, handler in before.items():
            signal.signal(installed, handler)


@contextlib.contextmanager
def on_hangup(call: Callable[[], None]) -> Iterator[None]:
    """Context manager that calls a function in the running event loop at each SIGHUP.

    Without effect on systems without SIGHUP and outside the main thread.
    """
    number = getattr(signal, "SIGHUP", None)
    if number is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    loop = asyncio.get_running_loop()
    before = signal.signal(number, lambda number, frame: loop.call_soon_threadsafe(call))
    try:
        yield
    finally:
        signal.signal(number, before)


@contextlib.contextmanager
def stop_flag() -> Iterator[threading.Event]:
    """Context manager that yields a flag set by Ctrl-C or SIGTERM, without an event loop; a second Ctrl-C interrupts.

    The first signal does not interrupt the running code, so nothing that was received is lost.
    """
    flag = threading.Event()
    before: dict[int, Any] = {}  # what signal.signal gave

    def stop(number: int, frame: object) -> None:
        flag.set()
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # only the main thread has signals
            before[number] = signal.signal(number, stop)
    try:
        yield flag
    finally:
        for installed, handler in before.items():
            signal.signal(installed, handler)
