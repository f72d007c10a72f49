"""The words for the states of a connection in the ``repr`` of a link."""

from typing import Final

from ..session.reconnect import ConnectionState

SHOWN_STATE: Final[dict[str, str]] = {state.value: state.value for state in ConnectionState} | {
    ConnectionState.UP.value: "connected",
    ConnectionState.DOWN.value: "not connected",
}
"""Word for each state, by the value of `ConnectionState`."""
