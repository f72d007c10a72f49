"""A user of pymodbus who is told what to do, and says what he sees: values, an exception code, or an error in words.

::

    pymodbus_user.py MILLISECONDS          waits so long for a reply, and asks once

It understands ``open PORT``, ``close``, ``read UNIT ADDRESS COUNT`` (holding registers) and ``write UNIT ADDRESS
VALUE…`` (function 06 for one value, 16 for several). One program talks to one server after the other.
"""

import logging
import sys
from typing import Any

from conversation import Refused, converse
from pymodbus.client import ModbusTcpClient
from pymodbus.pdu import ModbusPDU


class User:
    """What he does, each as a command."""

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._client: ModbusTcpClient | None = None

    def open(self, port: int) -> dict[str, Any]:
        """Connect to a server on this machine."""
        self.close()
        self._client = ModbusTcpClient("127.0.0.1", port=port, timeout=self._timeout, retries=0)
        return {"connected": self._client.connect()}

    def close(self) -> dict[str, Any]:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
        return {}

    def read(self, unit: int, address: int, count: int) -> dict[str, Any]:
        """Read holding registers."""
        assert self._client is not None
        reply = self._client.read_holding_registers(address, count=count, device_id=unit)
        return {"values": list(self._checked(reply).registers)}

    def write(self, unit: int, address: int, *values: int) -> dict[str, Any]:
        """Write one register, or several."""
        assert self._client is not None
        if len(values) == 1:
            self._checked(self._client.write_register(address, values[0], device_id=unit))
        else:
            self._checked(self._client.write_registers(address, list(values), device_id=unit))
        return {}

    @staticmethod
    def _checked(reply: ModbusPDU) -> Any:
        if reply.isError():
            raise Refused(reply.exception_code, type(reply).__name__)
        return reply


def main() -> None:
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)
    user = User(int(sys.argv[1]) / 1000)
    converse({"open": user.open, "close": user.close, "read": user.read, "write": user.write})
    user.close()


main()
