"""Claims of serial ports: which ones this process has open, so that a second user of one is refused.

Knows names of ports; opens none and knows no Modbus.

1. A port belongs to one user in a process: two event loops, or an event loop and a thread, would take each other's
   bytes. The system's own lock does not help where it is switched off.
2. A claim ends with `PortClaim.release`, or when its object is no longer referenced.
"""

import os
import threading
import weakref

from ...errors import ConfigError
from ...extras import require


class PortClaim:
    """The exclusive right of one user in this process to a serial port, until `release`."""

    __slots__ = ("__weakref__", "port", "user")

    def __init__(self, port: str, user: str) -> None:
        """Claim a serial port for one user in this process.

        Args:
            port: the name to open it with.
            user: who uses it; the error for the next one that wants the port shows this text.

        Raises:
            ConfigError: another user in this process has claimed the port, or `serialx` is not installed. Nothing was
                opened.
        """
        require("serialx", "a serial port")
        self.port: str = _key(port)
        self.user: str = user
        with _lock:
            holder = _claims.get(self.port)
            if holder is not None:
                raise ConfigError(
                    f"{port} is in use in this process already, by {holder.user}; a serial port has one user",
                    key="port",
                )
            _claims[self.port] = self

    def release(self) -> None:
        """Allow others in this process to use the serial port. A second call does nothing."""
        with _lock:
            if _claims.get(self.port) is self:
                del _claims[self.port]


_lock = threading.Lock()
_claims: "weakref.WeakValueDictionary[str, PortClaim]" = weakref.WeakValueDictionary()


def _key(port: str) -> str:
    """Return the path of a serial port with symbolic links resolved, so that one device has one name.

    A name that is no existing path, such as a USB identity, is returned unchanged.
    """
    return os.path.realpath(port) if port.startswith("/") and os.path.exists(port) else port
