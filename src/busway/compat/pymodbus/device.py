"""Identification of a server of pymodbus: its identification objects by number and by name. Knows no server."""

from collections.abc import Iterator, Mapping
from typing import Any

NAMES = (
    "VendorName",
    "ProductCode",
    "MajorMinorRevision",
    "VendorUrl",
    "ProductName",
    "ModelName",
    "UserApplicationName",
)
"""The names of the objects 0…6 (MODBUS Application Protocol V1.1b3 §6.21)."""


def _named(number: int) -> Any:
    def get(self: "ModbusDeviceIdentification") -> Any:
        return self[number]

    def put(self: "ModbusDeviceIdentification", value: Any) -> None:
        self[number] = value

    return property(get, put, doc=f"Object {number}.")


class ModbusDeviceIdentification:
    """Identification objects of a server: texts or bytes by number, those of `NAMES` as attributes too.

    An object that is not set reads as an empty text. Iterating yields number and value.

    Args:
        info: objects by number.
        info_name: objects 0…6 by their names in `NAMES`; ``ValueError`` is raised for another name.
    """

    VendorName: Any = _named(0)
    ProductCode: Any = _named(1)
    MajorMinorRevision: Any = _named(2)
    VendorUrl: Any = _named(3)
    ProductName: Any = _named(4)
    ModelName: Any = _named(5)
    UserApplicationName: Any = _named(6)

    def __init__(self, info: Mapping[int, Any] | None = None, info_name: Mapping[str, Any] | None = None) -> None:
        self._objects: dict[int, Any] = dict(info or {})
        for name, value in (info_name or {}).items():
            self._objects[NAMES.index(name)] = value

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        return iter(self._objects.items())

    def __getitem__(self, number: int) -> Any:
        return self._objects.get(number, "")

    def __setitem__(self, number: int, value: Any) -> None:
        self._objects[number] = value

    def update(self, other: Any) -> None:
        """Add the objects of another identification or mapping, replacing those with the same numbers."""
        self._objects.update(dict(other))

    def summary(self) -> dict[str, Any]:
        """Return the objects 0…6 by name; empty texts for those that are not set."""
        return {name: self[number] for number, name in enumerate(NAMES)}

    def encoded(self) -> dict[int, bytes]:
        """Return the value of each object that is not empty as bytes, by number; texts are encoded in UTF-8."""
        texts = {number: value for number, value in self._objects.items() if value}
        return {number: value if isinstance(value, bytes) else str(value).encode() for number, value in texts.items()}
