"""Control of a running server or gateway from outside: what it does, read over a socket that only its user reaches.

`addresses` says where such sockets are, `binding` makes them, `service` answers, `asking` asks; `plain` turns a status
into JSON.

1. A Unix domain socket of mode 0600 in a directory of mode 0700; where there is none, or by choice, HTTP on loopback
   with a token that stands in a file of mode 0600. There is no way to offer it to other hosts.
2. The status is gathered in the event loop of whoever is asked, and written in a thread of its own.
"""

from .addresses import (
    ControlAddress,
    LoopbackAddress,
    UnixAddress,
    control_directories,
    control_directory,
    parse_control_address,
)
from .asking import Running, ask, find_one, find_running
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
