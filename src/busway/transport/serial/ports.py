"""Finds serial ports by path, by name under ``by-id``, or by USB identity.

Knows how ports are named and listed; opens none and knows no Modbus. A name is looked up each time a port is opened, so
a USB adapter is found again even if its path has changed.

::

    /dev/ttyUSB0   /dev/serial/by-id/usb-FTDI_…-if00-port0   COM3
    usb:0403:6001            the only adapter of this maker and product
    usb:0403:6001:A50285BI   the one with this serial number

A slash may stand before each of them, because the path of a URL begins with one.
"""

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ...errors import ConfigError, LinkDown
from ...extras import require

_USB = re.compile(r"/?(?:usb:)?(?P<vendor>[0-9A-Fa-f]{4}):(?P<product>[0-9A-Fa-f]{4})(?::(?P<serial>[^/]+))?")
_WINDOWS = re.compile(r"/?(?P<name>COM[0-9]+)", re.IGNORECASE)

UNIX98_PTY_MAJORS = range(136, 144)
"""Device numbers that Linux keeps for the far ends of pseudo-terminals."""

BSD_PTY_PATHS = ("/dev/pts/", "/dev/ttys00", "/dev/ttys01", "/dev/ttys02")
"""How the paths of pseudo-terminals begin on other systems; macOS numbers them with three digits."""


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A serial port of this machine: its path, and what is known of its USB adapter.

    Attributes:
        path: the name to open it with; where possible one that does not change (``by-id``).
        device: the present name of the device: ``/dev/ttyUSB0``.
        vendor, product: USB identity, 0…65 535; None for ports that are not on USB.
        serial_number: serial number that the USB device reports; None if it reports none.
        description: maker and product in words; empty if unknown.
    """

    path: str
    device: str
    vendor: int | None = None
    product: int | None = None
    serial_number: str | None = None
    description: str = ""

    @property
    def identity(self) -> str | None:
        """The USB identity of the port, which can be given in place of its name; None for a port that is not on USB."""
        if self.vendor is None or self.product is None:
            return None
        name = f"usb:{self.vendor:04x}:{self.product:04x}"
        return f"{name}:{self.serial_number}" if self.serial_number else name


def list_ports() -> list[FoundPort]:
    """Return the serial ports of this machine, sorted by path. Opens none; leaves out pseudo-terminals.

    Raises:
        MissingExtra: `serialx` is not installed.
    """
    require("serialx", "finding serial ports")
    import serialx

    found = []
    for port in serialx.list_serial_ports():
        words = [word for word in (port.manufacturer, port.product) if word]
        found.append(
            FoundPort(port.device, port.resolved_device, port.vid, port.pid, port.serial_number, " ".join(words))
        )
    return sorted(found, key=lambda port: port.path)


def resolve_port(name: str, listing: Callable[[], Iterable[FoundPort]] = list_ports) -> str:
    """Return the path with which to open a port that is given by path, ``by-id`` name or USB identity.

    A USB identity, with or without ``usb:``, is looked up in ``listing``. Any other name is returned unchanged, whether
    it exists or not; only a Windows name such as ``/com3`` becomes ``COM3``.

    Raises:
        LinkDown: no device with this USB identity is plugged in now.
        ConfigError: several devices have this USB identity, the name is empty, or `serialx` is needed for a USB
            identity and not installed.
    """
    if not name:
        raise ConfigError("the name of the serial port is missing, as in /dev/ttyUSB0", key="port")
    identity = _USB.fullmatch(name)
    if identity is not None:
        return _by_identity(name, identity, listing)
    windows = _WINDOWS.fullmatch(name)
    if windows is not None:
        return windows["name"].upper()
    return name


def _by_identity(name: str, identity: re.Match[str], listing: Callable[[], Iterable[FoundPort]]) -> str:
    vendor, product, serial_number = int(identity["vendor"], 16), int(identity["product"], 16), identity["serial"]
    fitting = [
        port
        for port in listing()
        if (port.vendor, port.product) == (vendor, product) and serial_number in (None, port.serial_number)
    ]
    if not fitting:
        raise LinkDown(f"no serial port with the USB identity {name.lstrip('/')} is plugged in", kind="missing")
    if len(fitting) > 1:
        choices = ", ".join(port.path for port in fitting)
        raise ConfigError(
            f"{name.lstrip('/')} is the identity of {len(fitting)} ports; choose one: {choices}", key="port"
        )
    return fitting[0].path


def is_pseudo_terminal(path: str) -> bool:
    """Whether a serial port is a pseudo-terminal, which has no wire and so neither parity nor 7-bit characters.

    False for a path that does not exist.
    """
    try:
        device = os.stat(path).st_rdev
    except OSError:
        return False
    if os.path.realpath(path).startswith(BSD_PTY_PATHS):
        return True
    return os.name == "posix" and os.major(device) in UNIX98_PTY_MAJORS
