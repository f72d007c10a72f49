"""The control service of a running server or gateway: shows its status to its own user, resets counters and reloads.

`addresses` knows where such sockets are, `control_socket` creates them, `service` answers requests, `client` sends
them; `json_status` turns a status into JSON.

1. The socket is a Unix domain socket of mode 0600 in a directory of mode 0700. On systems without Unix sockets, or if
   the user asks for it, it is HTTP on loopback, with a token in a file of mode 0600. Other hosts cannot reach it, and
   of the users of this host only its own and root.
2. The status is collected in the event loop of the program, and sent by another thread.

Where it is decided: at which path or address the socket is: `addresses`. Who can connect: `control_socket` (modes),
`service` (the token). What is answered, and how long the program is waited for: `service`. Which running programs a
command finds: `client`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .addresses import (
        ControlAddress,
        LoopbackAddress,
        UnixAddress,
        control_directories,
        control_directory,
        parse_control_address,
    )
    from .client import Running, ask, find_one, find_running
    from .service import Control, Reloadable, Resettable, Subject, open_control

__all__ = [
    "Control",
    "ControlAddress",
    "LoopbackAddress",
    "Reloadable",
    "Resettable",
    "Running",
    "Subject",
    "UnixAddress",
    "ask",
    "control_directories",
    "control_directory",
    "find_one",
    "find_running",
    "open_control",
    "parse_control_address",
]

_HOME = {
    "Control": "service",
    "ControlAddress": "addresses",
    "LoopbackAddress": "addresses",
    "Reloadable": "service",
    "Resettable": "service",
    "Running": "client",
    "Subject": "service",
    "UnixAddress": "addresses",
    "ask": "client",
    "control_directories": "addresses",
    "control_directory": "addresses",
    "find_one": "client",
    "find_running": "client",
    "open_control": "service",
    "parse_control_address": "addresses",
}


def __getattr__(name: str) -> Any:  # any public name; imported at need, so that a server loads no client
    module = _HOME.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{module}", __name__), name)
