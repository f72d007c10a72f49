"""Signals: Ctrl-C and SIGTERM end commands that run until stopped; SIGHUP makes them read their files again."""

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def stop_event() -> Iterator[asyncio.Event]:
    """Context manager that yields an event, which Ctrl-C (SIGINT) or SIGTERM sets.

    The first Ctrl-C and the first SIGTERM only set the event; the second of the same signal has its usual effect. Enter
    it in the running event loop. Outside the main thread, which alone gets signals, the event is never set.
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
    """Context manager that yields two events: the first Ctrl-C or SIGTERM sets the first, the next signal the second.

    A third signal has its usual effect. Enter it in the running event loop. Outside the main thread, which alone gets
    signals, the events are never set.
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
    """Context manager during which each SIGHUP makes the running event loop call a function.

    Has no effect on systems without SIGHUP and outside the main thread.
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
    """Context manager that yields a flag, which Ctrl-C (SIGINT) or SIGTERM sets; for code without an event loop.

    The first Ctrl-C and the first SIGTERM do not interrupt the running code, so no received data are lost; the second
    of the same signal has its usual effect. Outside the main thread, the flag is never set.
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
