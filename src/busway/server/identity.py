"""Checks of a device's identification: what functions 07, 17 and 43/14 answer.

Knows the objects and their limits; knows no request.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

from ..errors import ConfigError
from ..values.unfit_values import shown
from ..version import __version__

OBJECT_LIMIT: Final = 244
"""Most bytes of an identification object: what fits one reply (Application Protocol V1.1b3 §6.21)."""
SERVER_ID_LIMIT: Final = 251
"""Most bytes of the data of function 17: what fits one reply (Application Protocol V1.1b3 §6.13)."""

MANDATORY_OBJECTS: Final[Mapping[int, bytes]] = MappingProxyType(
    {0: b"busway", 1: b"device", 2: __version__.encode("ascii")}
)
"""Default vendor name, product code and revision: every device must have these objects (§6.21)."""
DEFAULT_SERVER_ID: Final = b"busway\xff"
"""Default data of function 17: the server id, and the run indicator FF (on) (§6.13)."""

ExceptionStatus = int | Callable[[], int]


def identification_objects(declared: Mapping[int, str | bytes] | None) -> Mapping[int, bytes]:
    """Return the declared identification objects by number, with defaults for the mandatory ones.

    Raises `ConfigError` for an invalid object.
    """
    if not declared:
        return MANDATORY_OBJECTS  # one object for all such devices
    objects = dict(MANDATORY_OBJECTS)
    for number, value in declared.items():
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= 255:
            raise ConfigError(f"an object has a number 0…255, not {shown(number)}", key="identification")
        key = f"identification[{number}]"
        if not isinstance(value, str | bytes | bytearray):
            raise ConfigError(f"an object is text or bytes, not {shown(value)}", key=key)
        objects[number] = value.encode("utf-8") if isinstance(value, str) else bytes(value)
        if len(objects[number]) > OBJECT_LIMIT:
            raise ConfigError(f"an object has at most {OBJECT_LIMIT} bytes, not {len(objects[number])}", key=key)
    return MappingProxyType(dict(sorted(objects.items())))


def server_id_data(declared: bytes) -> bytes:
    """Check and return the data of a reply to function 17. Raises `ConfigError` if they are not bytes, or too long."""
    if not isinstance(declared, bytes | bytearray) or len(declared) > SERVER_ID_LIMIT:
        raise ConfigError(f"a server id is at most {SERVER_ID_LIMIT} bytes, not {shown(declared)}", key="server_id")
    return bytes(declared)


def status_source(declared: ExceptionStatus) -> Callable[[], int]:
    """Return a function that returns the status bits of function 07: ``declared`` itself if it is a function.

    Raises `ConfigError` for any other object than a function or an integer 0…255.
    """
    if callable(declared):
        return declared
    if isinstance(declared, bool) or not isinstance(declared, int) or not 0 <= declared <= 255:
        raise ConfigError(f"the exception status is 0…255, not {shown(declared)}", key="exception_status")
    return declared.__index__  # with a third of the memory of a closure
