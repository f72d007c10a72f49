"""The framer types of pymodbus: each only names a framing, which busway's own sessions do. Knows no bytes."""

import enum
from typing import Any, ClassVar

from .exceptions import ParameterException


class FramerType(str, enum.Enum):
    """Framings by pymodbus' names."""

    ASCII = "ascii"
    RTU = "rtu"
    SOCKET = "socket"
    TLS = "tls"


class FramerBase:
    """Base of the framer classes; programs pass them to clients, and nothing else is done with them."""

    framer_type: ClassVar[FramerType]

    def __init__(self, *_arguments: Any, **_names: Any) -> None:  # whatever a release of pymodbus took
        pass


class FramerAscii(FramerBase):
    """Names the framing ASCII."""

    framer_type: ClassVar[FramerType] = FramerType.ASCII


class FramerRTU(FramerBase):
    """Names the framing RTU."""

    framer_type: ClassVar[FramerType] = FramerType.RTU


class FramerSocket(FramerBase):
    """Names the framing MBAP over TCP or UDP."""

    framer_type: ClassVar[FramerType] = FramerType.SOCKET


class FramerTLS(FramerBase):
    """Names the framing MBAP over TLS."""

    framer_type: ClassVar[FramerType] = FramerType.TLS


# Names in releases before 3.7.
ModbusAsciiFramer = FramerAscii
ModbusRtuFramer = FramerRTU
ModbusSocketFramer = FramerSocket
ModbusTlsFramer = FramerTLS
Framer = FramerType


def framer_type_of(framer: object) -> FramerType:
    """The framing that a program named: a `FramerType`, its text, a framer class or one of its instances."""
    kind = getattr(framer, "framer_type", framer)
    try:
        return FramerType(kind)
    except ValueError:
        raise ParameterException(f"framer must be a FramerType or a framer class, not {framer!r}") from None


__path__: list[str] = []
"""Names of modules below this one are served by `aliases`."""
