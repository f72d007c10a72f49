"""Reserve of file descriptors: the last ones that the process may open are kept for Modbus connections.

Knows the system's limit; knows no socket. The web page, the status and the metrics ask this file before they keep a
connection. The system gives out the lowest free number, so a high number shows that few are left.
"""

import sys
from typing import Final

RESERVED: Final = 128
"""Number of descriptors that are kept for Modbus connections; at most half of all that the process may open."""


def is_reserved(descriptor: int) -> bool:
    """Whether a file descriptor is one of those kept for Modbus: then a connection for anything else must be closed.

    ``descriptor`` is the number that the system gave to the new connection. Always False on Windows, and where the
    number of descriptors has no limit.
    """
    if sys.platform == "win32":
        return False
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return limit != resource.RLIM_INFINITY and descriptor >= limit - min(RESERVED, limit // 2)
