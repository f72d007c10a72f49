"""Callbacks that a program has registered for changes of a connection's state; both kinds of link call them.

Knows states and reasons; knows no connection.

1. A callback is called once for each change, after it, in the thread or event loop that noticed the change.
2. An error of a callback is logged and harms neither the link nor the other callbacks.
"""

import logging
from collections.abc import Callable
from typing import Final

from ..session.reconnect import ConnectionState

_log = logging.getLogger("busway.client")

DISCONNECTED: Final = "the program disconnected it"
"""The reason that callbacks get when the program itself closed the connection by `disconnect`."""
OnState = Callable[[str, str], None]
"""Called as ``callback(state, reason)`` with the new state, such as ``up``, and its reason in words, or empty."""


class StateObservers:
    """The callbacks of one link, which `notify` calls for each new state.

    ``state`` is the state of the connection when the object is created; no callback is called for it.
    """

    __slots__ = ("_callbacks", "_state")

    def __init__(self, state: ConnectionState) -> None:
        self._callbacks: list[OnState] = []
        self._state = state

    def add(self, callback: OnState) -> Callable[[], None]:
        """Register a callback. Returns a function that removes it again; calling that twice does no harm."""
        entry: list[OnState] = [callback]
        self._callbacks.append(callback)

        def remove() -> None:
            if entry:
                self._callbacks.remove(entry.pop())

        return remove

    def notify(self, state: ConnectionState, reason: str) -> None:
        """Call the callbacks with the new state and its reason; do nothing if the state is the same as before."""
        if state is self._state:
            return
        self._state = state
        for callback in tuple(self._callbacks):
            try:
                callback(state.value, reason)
            except Exception:
                _log.exception("a callback of on_state failed")
