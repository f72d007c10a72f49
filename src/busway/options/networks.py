"""Lists of IPv4 and IPv6 addresses and networks, whether a host is in one, and the texts of clients' addresses.

Knows the texts of addresses; asks no name server, because a name server must not decide who may connect.

1. ``::ffff:10.0.0.7`` is 10.0.0.7, in a list and as a host: a socket for both families gives IPv4 clients such names.
2. An entry with a zone (``fe80::1%eth0``) fits only in that zone; an entry without one fits in every zone.
3. A text that is no address, such as the name of a serial line, is in no list.
"""

import ipaddress
from collections.abc import Iterable, Iterator
from typing import Final

from ..errors import ConfigError
from ..values.unfit_values import shown

_MEMO_LIMIT: Final = 1024
_MAPPED: Final = 0xFFFF << 32
"""``::ffff:0:0``, the first of the IPv4 addresses among the IPv6 ones (RFC 4291 §2.5.5.2)."""
_MAPPED_LENGTH: Final = 96


class Networks:
    """A set of IP addresses and networks: ``"10.0.0.7" in networks``. It cannot be changed.

    Sets with the same entries, as texts and in any order, are equal. An empty set is falsy.

    Args:
        entries: texts such as ``10.0.0.7``, ``10.0.0.0/8``, ``fe80::/64``, ``fe80::1%eth0``.
        key: name of the option with the entries, for errors.

    Attributes:
        entries: the entries as they were given.

    Raises:
        ConfigError: an entry is no address or network, or has bits set beyond its length; the error names it.
    """

    __slots__ = ("_found", "_lengths", "entries")

    def __init__(self, entries: Iterable[str] = (), *, key: str | None = None) -> None:
        if isinstance(entries, str):
            raise ConfigError(f"a list of addresses is needed, not {shown(entries)}", key=key)
        self.entries: tuple[str, ...] = tuple(entries)
        # (version, length) → (network, zone) → entry: as many look-ups as there are lengths, however long the list is.
        self._lengths: dict[tuple[int, int], dict[tuple[int, str], str]] = {}
        for entry in self.entries:
            version, length, network, zone = _parsed(entry, key)
            self._lengths.setdefault((version, length), {}).setdefault((network, zone), entry)
        self._lengths = dict(sorted(self._lengths.items(), reverse=True))
        self._found: dict[str, str | None] = {}

    @classmethod
    def parse(cls, entries: Iterable[str], *, key: str | None = None) -> "Networks":
        """Return ``Networks(entries, key=key)``; `busway.options.text` calls this to build the value of an option."""
        return cls(entries, key=key)

    def __contains__(self, host: object) -> bool:
        return isinstance(host, str) and self.find(host) is not None

    def find(self, host: str) -> str | None:
        """Return the most specific entry that contains a numeric address, as it was written.

        None if no entry contains it, or if ``host`` is no numeric address.
        """
        found = self._found.get(host, "")
        if found != "":
            return found
        if len(self._found) >= _MEMO_LIMIT:
            self._found.clear()
        found = self._found[host] = self._look_up(host)
        return found

    def _look_up(self, host: str) -> str | None:
        try:
            version, number, zone = _number_of(host)
        except ValueError:
            return None
        for (family, length), networks in self._lengths.items():
            if family == version:
                spare = (32 if family == 4 else 128) - length
                network = number >> spare << spare
                found = networks.get((network, zone)) or networks.get((network, ""))
                if found is not None:
                    return found
        return None

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Networks) and self._lengths == other._lengths

    def __hash__(self) -> int:
        return hash(frozenset(self._lengths))

    def __repr__(self) -> str:
        return f"Networks({list(self.entries)!r})"


class NetworkIndex:
    """Finds which of many sets of networks contain a host, with one search for all sets.

    Args:
        networks: pairs of a number that the caller chooses and a set of networks.
    """

    __slots__ = ("_lengths",)

    def __init__(self, networks: Iterable[tuple[int, Networks]]) -> None:
        self._lengths: dict[tuple[int, int], dict[tuple[int, str], list[int]]] = {}
        for number, each in networks:
            for length, entries in each._lengths.items():
                found = self._lengths.setdefault(length, {})
                for network in entries:
                    found.setdefault(network, []).append(number)

    def find(self, host: str) -> set[int]:
        """Return the numbers of the sets that contain a numeric address; an empty set if ``host`` is no address."""
        try:
            version, address, zone = _number_of(host)
        except ValueError:
            return set()
        found: set[int] = set()
        for (family, length), networks in self._lengths.items():
            if family == version:
                spare = (32 if family == 4 else 128) - length
                network = address >> spare << spare
                found.update(networks.get((network, ""), ()))
                if zone:
                    found.update(networks.get((network, zone), ()))
        return found


def host_of(address: object) -> str:
    """Return the host of a socket address; an address that is no tuple as text, empty for none."""
    return str(address[0]) if isinstance(address, tuple) and address else str(address or "")


def peer_name(address: object) -> str:
    """Return a socket address as text: ``host:port``, or ``[host]:port`` for IPv6; ``?`` if there is no address."""
    if isinstance(address, tuple) and len(address) >= 2:
        host, port = address[0], address[1]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(address or "?")


def host_of_peer(peer: str) -> str:
    """Return the host of a peer such as ``10.0.0.7:50012`` or ``[fe80::1%eth0]:50012``; the port may be missing.

    An IPv4-mapped address (``::ffff:10.0.0.7``) becomes the IPv4 address, so that one host has one name. An IPv6
    address has no brackets in the result. The name of a serial line is returned unchanged.
    """
    host, colon, port = peer.rpartition(":")
    if not colon or not port.isdecimal() or (":" in host and not host.startswith("[")):
        host = peer
    host = host.removeprefix("[").removesuffix("]")
    if ":" in host:
        try:
            version, number, _ = _number_of(host)
        except ValueError:
            return host
        if version == 4:
            return str(ipaddress.IPv4Address(number))
    return host


def _number_of(host: str) -> tuple[int, int, str]:
    """Return version (4 or 6), number and zone (empty for none) of a numeric IP address. Raises `ValueError`."""
    plain, _, zone = host.partition("%")
    address = ipaddress.ip_address(plain)
    number = int(address)
    if address.version == 6 and number >> 32 == _MAPPED >> 32:
        return 4, number & 0xFFFF_FFFF, ""
    return address.version, number, zone


def _parsed(entry: str, key: str | None) -> tuple[int, int, int, str]:
    """Return version, prefix length, network and zone of an entry such as ``10.0.0.0/8``.

    Raises:
        ConfigError: the entry is no address or network, or has bits set beyond its length.
    """
    if not isinstance(entry, str):
        raise ConfigError(f"{shown(entry)} is no text such as '10.0.0.0/8'", key=key)
    text = entry.strip()
    host, slash, mask = text.partition("/")
    plain, percent, zone = host.partition("%")
    try:
        network = ipaddress.ip_network(f"{plain}{slash}{mask}", strict=False)
    except ValueError:
        raise ConfigError(f"{shown(entry)} is no address or network such as 10.0.0.7 or 10.0.0.0/8", key=key) from None
    if percent and (not zone or network.version == 4):
        raise ConfigError(f"{shown(entry)}: only an IPv6 address has a zone, and it is not empty", key=key)
    number, length = int(network.network_address), network.prefixlen
    if int(ipaddress.ip_address(plain)) != number:
        raise ConfigError(
            f"{shown(entry)} has bits set beyond its length; the network is {network}, the address alone {plain}",
            key=key,
        )
    if network.version == 6 and length >= _MAPPED_LENGTH and number >> 32 == _MAPPED >> 32:
        return 4, length - _MAPPED_LENGTH, number & 0xFFFF_FFFF, ""
    return network.version, length, number, zone
