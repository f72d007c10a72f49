"""Conversion between registers and network addresses: IPv4, IPv6, EUI-48 (MAC) and EUI-64.

Knows how each is written; the most significant byte is sent first unless the order says otherwise.
"""

import ipaddress
import re
from typing import Any, Final

from .orders import ByteOrder, BytesLike, swapped
from .unfit_values import unfit

_SIZES: Final = {"ipv4": 4, "ipv6": 16, "eui48": 6, "eui64": 8}
_EXPECTS: Final = {
    "ipv4": "an address such as 192.168.1.20",
    "ipv6": "an address such as 2001:db8::1",
    "eui48": "an address such as 00:1B:44:11:3A:B7",
    "eui64": "an address such as 00:1B:44:FF:FE:11:3A:B7",
}
_SEPARATORS: Final = re.compile(r"[:-]")
_EUI_BYTE: Final = re.compile(r"[0-9A-Fa-f]{2}")

NETWORK_TYPES: Final = tuple(_SIZES)


def network_size(name: str) -> int:
    """Return the number of bytes of a kind of network address: ``ipv4``, ``ipv6``, ``eui48`` or ``eui64``.

    Raises ``KeyError`` for other names.
    """
    return _SIZES[name]


class NetworkCodec:
    """Converts registers to network addresses as texts (IPv4, IPv6, EUI-48, EUI-64), and back."""

    def __init__(self, name: str, order: ByteOrder) -> None:
        self._name = name
        self._size = _SIZES[name]
        self._swaps = order.swaps
        self.expects: str = _EXPECTS[name]

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the network addresses that registers in wire order hold, as texts such as ``00:1B:44:11:3A:B7``."""
        whole = swapped(data, self._swaps)
        return [self._written(whole[at : at + self._size]) for at in range(0, len(whole), self._size)]

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold network addresses given as texts.

        Raises:
            InvalidRequest: a value is no address of the codec's kind. Nothing was sent.
        """
        parts = []
        for index, value in enumerate(values):
            try:
                parts.append(self._packed(value))
            except ValueError as error:
                raise unfit(values, index, self._name, self.expects) from error
        return swapped(b"".join(parts), self._swaps)

    def parse(self, text: str) -> str:
        """Return a network address, given as text, in the form in which `decode` returns it.

        Raises ``ValueError`` if the text is no address of the codec's kind. An EUI may have ``-`` for ``:``.
        """
        return self._written(self._packed(text))

    def _written(self, part: bytes) -> str:
        if self._name == "ipv4":
            return str(ipaddress.IPv4Address(part))
        return str(ipaddress.IPv6Address(part)) if self._name == "ipv6" else part.hex(":").upper()

    def _packed(self, value: object) -> bytes:
        if not isinstance(value, str):
            raise ValueError(value)
        if self._name == "ipv4":
            return ipaddress.IPv4Address(value).packed
        if self._name == "ipv6":
            if "%" in value:  # a zone (fe80::1%eth0) is of one host, and registers have no place for it
                raise ValueError(value)
            return ipaddress.IPv6Address(value).packed
        parts = _SEPARATORS.split(value)
        if len(parts) != self._size or not all(map(_EUI_BYTE.fullmatch, parts)):
            raise ValueError(value)
        return bytes.fromhex("".join(parts))
