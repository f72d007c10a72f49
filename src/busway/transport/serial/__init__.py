"""Serial ports: bytes in, bytes out, over a UART, a USB adapter or a pseudo-terminal. Knows no Modbus.

Each file has one subject: which port is meant (`ports`), who holds it (`lock`),
what the driver is asked beside that (`rs485`, `marks`, `counters`, `overruns`, through `ioctl`), when the last
character has left (`emission`), how descriptors are waited for (`waiting`), what foreign errors mean (`errors`), when a
lost port is tried again (`reopen`), and the two ways to use one (`device`): `connection` under asyncio, `blocking`
without it.

`serialx` opens the ports. It is imported when the first one is opened, so that programs without one do not wait for it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .blocking import BlockingSerialPort
    from .connection import SerialConnection
    from .counters import LineCounters
    from .ports import FoundPort, list_ports
    from .reopen import ReopenPolicy

__all__ = [
    "BlockingSerialPort",
    "FoundPort",
    "LineCounters",
    "ReopenPolicy",
    "SerialConnection",
    "list_ports",
]

_HOME = {
    "BlockingSerialPort": "blocking",
    "FoundPort": "ports",
    "LineCounters": "counters",
    "ReopenPolicy": "reopen",
    "SerialConnection": "connection",
    "list_ports": "ports",
}


def __getattr__(name: str) -> Any:  # any public name; imported at need, so that a setting loads no event loop
    module = _HOME.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{module}", __name__), name)
