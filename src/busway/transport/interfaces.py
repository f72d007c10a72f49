"""The network interfaces of this host: names, addresses, netmasks and gateways, for display.

Works on Linux only; on other systems there are none. The operating system configures the interfaces; this file only
reads them (Messaging on TCP/IP V1.0b §4.3.3).
"""

import contextlib
import socket
import struct
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_SIOCGIFADDR: Final = 0x8915
_SIOCGIFNETMASK: Final = 0x891B
_ROUTES: Final = Path("/proc/net/route")
_IPV6_ADDRESSES: Final = Path("/proc/net/if_inet6")


@dataclass(frozen=True, slots=True)
class Interface:
    """One address of one network interface of this host, with netmask and gateway.

    Attributes:
        name: the system's name of the interface: ``eth0``.
        address: numeric IP address.
        netmask: ``255.255.255.0``, or ``/64`` for IPv6.
        gateway: address of the default gateway of the interface; empty without one, and always for IPv6.
    """

    name: str
    address: str
    netmask: str
    gateway: str = ""


def interfaces_with(host: str) -> tuple[Interface, ...]:
    """Return the network interfaces that have the address ``host``; for ``0.0.0.0`` and ``::`` all of that family.

    Only the first IPv4 address of each interface is found. Empty on systems other than Linux.
    """
    if sys.platform != "linux":
        return ()
    found = _ipv6_interfaces() if ":" in host else _ipv4_interfaces()
    wanted = host.partition("%")[0]
    return tuple(one for one in found if wanted in ("0.0.0.0", "::", one.address))


def _ipv4_interfaces() -> list[Interface]:
    gateways = _gateways()
    found = []
    # Without a descriptor left, as where too many connect, there is nothing to show; the caller goes on.
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # one that has no such address
                address, netmask = (_asked(asking, what, name) for what in (_SIOCGIFADDR, _SIOCGIFNETMASK))
                found.append(Interface(name, address, netmask, gateways.get(name, "")))
    return found


def _asked(asking: socket.socket, what: int, name: str) -> str:
    from fcntl import ioctl  # not on every system

    return socket.inet_ntoa(ioctl(asking.fileno(), what, struct.pack("256s", name.encode()[:15]))[20:24])


def _gateways() -> dict[str, str]:
    """Return the default gateway of each network interface, by the interface's name."""
    found: dict[str, str] = {}
    for line in _lines(_ROUTES)[1:]:
        name, destination, gateway, flags = line.split()[:4]
        if destination == "00000000" and int(flags, 16) & 2:
            found.setdefault(name, socket.inet_ntoa(int(gateway, 16).to_bytes(4, sys.byteorder)))
    return found


def _ipv6_interfaces() -> list[Interface]:
    found = []
    for line in _lines(_IPV6_ADDRESSES):
        address, _, prefix, _, _, name = line.split()
        numeric = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(address))
        found.append(Interface(name, numeric, f"/{int(prefix, 16)}"))
    return found


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
