"""The framer types of pymodbus: each is only the name of a framing, which busway's sessions implement.

Knows no bytes.
"""

import enum
from typing import Any, ClassVar

from .exceptions import ParameterException


class FramerType(str, enum.Enum):
    """Framings by pymodbus' names: ``SOCKET`` is MBAP over TCP or UDP, ``TLS`` is MBAP over TLS."""

    ASCII = "ascii"
    RTU = "rtu"
    SOCKET = "socket"
    TLS = "tls"


class FramerBase:
    """Base of the framer classes: a program passes one to a client or server to name a framing."""

    framer_type: ClassVar[FramerType]

    def __init__(self, *_arguments: Any, **_names: Any) -> None:  # whatever a release of pymodbus took
        pass


class FramerAscii(FramerBase):
    """Name of the framing ASCII, as a class."""

    framer_type: ClassVar[FramerType] = FramerType.ASCII


class FramerRTU(FramerBase):
    """Name of the framing RTU, as a class."""

    framer_type: ClassVar[FramerType] = FramerType.RTU


class FramerSocket(FramerBase):
    """Name of the framing MBAP over TCP or UDP, as a class."""

    framer_type: ClassVar[FramerType] = FramerType.SOCKET


class FramerTLS(FramerBase):
    """Name of the framing MBAP over TLS, as a class."""

    framer_type: ClassVar[FramerType] = FramerType.TLS


# Names in releases before 3.7.
ModbusAsciiFramer = FramerAscii
ModbusRtuFramer = FramerRTU
ModbusSocketFramer = FramerSocket
ModbusTlsFramer = FramerTLS
Framer = FramerType


def framer_type_of(framer: object) -> FramerType:
    """Return the framing that a program names: by a `FramerType`, its text, a framer class or an instance of one.

    Raises:
        ParameterException: the object names no framing.
    """
    kind = getattr(framer, "framer_type", framer)
    try:
        return FramerType(kind)
    except ValueError:
        raise ParameterException(f"framer must be a FramerType or a framer class, not {framer!r}") from None


__path__: list[str] = []
"""Empty: it makes this module a package for Python, so that `aliases` can serve names of modules below it."""
