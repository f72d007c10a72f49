"""The sections of a file whose changes a reload applies without a restart; other changes wait for the next start.

The lists for server, simulator and gateway. The collector has its own in `busway.apps.collector.reload`.

1. Certificates are read again at each reload, and the audit log is reopened, whether their sections changed or not.
2. Units, and the options of a server or a simulation, never change without a restart.
"""

from typing import Final

SERVER_SECTIONS: Final = frozenset({"policy"})
"""Sections of a server's or a simulation's file that a reload applies."""
GATEWAY_SECTIONS: Final = SERVER_SECTIONS | {"listen", "listener", "link", "route", "client", "security"}
"""Sections of a gateway's file that a reload applies."""
LISTENER_KEYS: Final = frozenset({"allow", "deny", "secure"})
"""Keys of ``[[listener]]`` that a reload applies whatever the file is: its address lists."""
