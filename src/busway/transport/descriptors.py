"""Reserve of file descriptors: the last ones that the process may open are kept for Modbus connections.

Knows the system's limit; knows no socket. Page, status and metrics ask here before they keep a connection: the system
gives the lowest free number, so a high one says that few are left.
"""

import sys
from typing import Final

RESERVED: Final = 128
"""Descriptors that are for Modbus alone; where the limit is low, half of all."""


def is_reserved(descriptor: int) -> bool:
    """Whether a new file descriptor is one of the last, kept for Modbus connections: other users must close it."""
    if sys.platform == "win32":
        return False
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return limit != resource.RLIM_INFINITY and descriptor >= limit - min(RESERVED, limit // 2)
