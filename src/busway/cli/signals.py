"""Ctrl-C and SIGTERM for commands that run until they are stopped."""

import asyncio
import contextlib
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def stop_event() -> Iterator[asyncio.Event]:
    """An event that Ctrl-C and SIGTERM set, inside a coroutine; a second Ctrl-C interrupts as usual."""
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
def terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM raise `KeyboardInterrupt`, as Ctrl-C does, in a command that waits without an event loop."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # only the main thread has signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
