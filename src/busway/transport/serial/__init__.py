"""Serial ports: bytes in, bytes out, over a UART, a USB adapter or a pseudo-terminal. Knows no Modbus.

=================  =====================================================================================================
`blocking`         A serial port for blocking programs: read, write, drain, close
`connection`       A serial port under asyncio: received bytes are passed to a function
`device`           An open serial port, but reading and writing: settings, damage marks, counters, RS-485 direction
`driver_counters`  Error counters that a port's driver keeps since the system started (`struct serial_icounter_struct`)
`end_of_sending`   Computes when the last character written to a serial port has left it
`errors`           Translates errors of serial ports into the errors of busway
`exact_timer`      A timer of an event loop that is exact to less than a millisecond
`ioctl`            All ioctl calls to the driver of a serial port, in one place so that a test can replace the driver
`lock`             Lock of a serial port against other programs, and the name of the program that holds it
`marks`            Removes the marks that the system puts before characters that arrived damaged (`PARMRK`)
`overruns`         Detects characters that a serial port has lost, by the counters of its driver
`port_claims`      Claims of serial ports: which ones this process has open, so that a second user of one is refused
`ports`            Finds serial ports by path, by name under `by-id`, or by USB identity
`reopen`           Opens a serial port that may be missing for now, with pauses between the attempts
`rs485`            Direction control of an RS-485 adapter: by the port's driver, or by the RTS signal
`rts_switching`    When RTS is switched to sending, and back after the last character, under asyncio
`waiting`          Waits until file descriptors are ready, as exactly as the system can
=================  =====================================================================================================

There are two ways to use a port: `connection` under asyncio, `blocking` without it; `device` is their common part.

`serialx` opens the ports. It is imported when the first one is opened, so that programs without one do not wait for it.

Where it is decided: which port is meant: `ports`. Whether a port is taken: `lock` by other programs, `port_claims` by
this one. How it is set (``exclusive``, ``low_latency``, ``mark_errors``): `device`. When a lost port is tried again
(``reopen_first``, ``reopen_most``): `reopen`. When the last character has left: `end_of_sending`. Who switches the
direction (``rs485``): `rs485`. When RTS switches back (``delay_before_send``, ``delay_after_send``): `rts_switching`;
for blocking programs, ``write`` of `blocking`. Which characters are damaged or lost: `marks`, `overruns`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .blocking import BlockingSerialPort
    from .connection import SerialConnection
    from .driver_counters import DriverCounters
    from .ports import FoundPort, list_ports
    from .reopen import ReopenPolicy

__all__ = [
    "BlockingSerialPort",
    "DriverCounters",
    "FoundPort",
    "ReopenPolicy",
    "SerialConnection",
    "list_ports",
]

_HOME = {
    "BlockingSerialPort": "blocking",
    "FoundPort": "ports",
    "DriverCounters": "driver_counters",
    "ReopenPolicy": "reopen",
    "SerialConnection": "connection",
    "list_ports": "ports",
}


def __getattr__(name: str) -> Any:  # any public name; imported at need, so that a setting loads no event loop
    module = _HOME.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{module}", __name__), name)
