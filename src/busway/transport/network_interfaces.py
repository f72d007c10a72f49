"""The network interfaces of this host: names, addresses, netmasks and gateways, for display.

Works on Linux only; on other systems there are none. The operating system configures the interfaces; this file only
reads them (Messaging on TCP/IP V1.0b §4.3.3).
"""

import array
import contextlib
import os
import socket
import struct
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_SIOCGIFCONF: Final = 0x8912
_SIOCGIFNETMASK: Final = 0x891B
_ENTRY: Final = struct.Struct("16sLLHBBB0L")
"""Layout of `ifreq` by its longest member, the memory map of an interface; only its size is of use."""
_ADDRESS: Final = struct.Struct("16sH2x4s")
"""The beginning of an `ifreq` with an IPv4 address: name, family, port (0), address."""
_MOST: Final = 1024  # addresses; more are left out
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

    One element for each address. ``host`` is a numeric address, an IPv6 one in its shortest form; a zone (``%eth0``) is
    ignored. Empty on systems other than Linux.
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
        for label, address in _ipv4_addresses(asking):
            with contextlib.suppress(OSError):  # one that was removed meanwhile
                name = os.fsdecode(label).partition(":")[0]  # eth0:1 is a second address of eth0
                netmask = _netmask(asking, label, address)
                found.append(Interface(name, socket.inet_ntoa(address), netmask, gateways.get(name, "")))
    return found


def _ipv4_addresses(asking: socket.socket) -> list[tuple[bytes, bytes]]:
    """Return label and address of each IPv4 address of this host, secondary ones too."""
    from fcntl import ioctl  # not on every system

    entries = array.array("B", bytes(_MOST * _ENTRY.size))
    address, size = entries.buffer_info()
    (filled, _) = struct.unpack("iP", ioctl(asking.fileno(), _SIOCGIFCONF, struct.pack("iP", size, address)))
    found = (_ADDRESS.unpack_from(entries, at) for at in range(0, filled, _ENTRY.size))
    return [(label.rstrip(b"\0"), ip) for label, _, ip in found]


def _netmask(asking: socket.socket, label: bytes, address: bytes) -> str:
    from fcntl import ioctl

    asked = _ADDRESS.pack(label, socket.AF_INET, address).ljust(_ENTRY.size, b"\0")
    return socket.inet_ntoa(_ADDRESS.unpack_from(ioctl(asking.fileno(), _SIOCGIFNETMASK, asked))[2])


def _gateways() -> dict[str, str]:
    """Return the default IPv4 gateway of each network interface that has one, by the interface's name."""
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
