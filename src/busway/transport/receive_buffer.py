"""The one receive buffer that all connections of an event loop share.

The event loop calls ``get_buffer``, receives and calls ``buffer_updated`` without a break between, so the bytes of one
connection are processed before the next one receives. 1000 idle connections then need one buffer instead of 1000. An
event loop that passes a buffer to the system to be filled later (Windows' proactor) gives each connection its own.
"""

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    import asyncio

RECEIVE_SIZE = 65_536
"""Size of the shared buffer, and so the most bytes that one receive call returns: some 5000 read requests."""

_shared: "WeakKeyDictionary[asyncio.AbstractEventLoop, bytearray]" = WeakKeyDictionary()
_windows: dict[int, memoryview] = {}
"""For each size the view created last: a view takes 312 bytes, so connections share it."""


def receive_buffer(loop: "asyncio.AbstractEventLoop") -> bytearray:
    """Return the buffer of `RECEIVE_SIZE` bytes into which all connections of an event loop receive.

    For an event loop of the kind ``Proactor`` (Windows) return a new one of 4096 bytes for each call.
    """
    if "Proactor" in type(loop).__name__:
        return bytearray(4096)
    try:
        return _shared[loop]
    except KeyError:
        buffer = _shared[loop] = bytearray(RECEIVE_SIZE)
        return buffer


def receive_window(buffer: bytearray, size: int) -> memoryview:
    """Return a view of the first ``size`` bytes of a buffer; connections with the same buffer and size share it."""
    window = _windows.get(size)
    if window is None or window.obj is not buffer:
        window = _windows[size] = memoryview(buffer)[:size]
    return window
