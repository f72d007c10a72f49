"""Importer for SunSpec: models in JSON.

Knows the types of the SunSpec Device Information Model Specification, and the value of each that means "not
implemented".

1. A model begins with its registers ``ID`` and ``L`` (length); it does not say at which address they are in a device.
2. The count of a group may be the name of a point, or 0 for as many members as fit into ``L``. If no registers follow
   the group, the device file takes the count from the device. If registers follow, their addresses depend on the count:
   then the user has to give it.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from ...errors import ConfigError
from ...points.conversion import LARGEST_EXPONENT
from ...values.unfit_values import shown
from .imported import WRONG_VALUE, ImportedDevice

FIRST_MODEL: Final = 40002
"""0-based address of the first model in devices whose map begins at 40000, after the marker "SunS"."""
MOST: Final = 20
"""Number of members that a repeated group gets in the device file if the device reports how many it has."""

_ABSENT: Final[Mapping[str, tuple[str, int | None]]] = {
    "int16": ("int16", 0x8000),
    "uint16": ("uint16", 0xFFFF),
    "count": ("uint16", 0xFFFF),
    "acc16": ("uint16", None),
    "enum16": ("uint16", 0xFFFF),
    "bitfield16": ("uint16", 0xFFFF),
    "sunssf": ("int16", 0x8000),
    "int32": ("int32", 0x80000000),
    "uint32": ("uint32", 0xFFFFFFFF),
    "acc32": ("uint32", None),
    "enum32": ("uint32", 0xFFFFFFFF),
    "bitfield32": ("uint32", 0xFFFFFFFF),
    "int64": ("int64", 0x8000000000000000),
    "uint64": ("uint64", 0xFFFFFFFFFFFFFFFF),
    "acc64": ("uint64", None),
    "bitfield64": ("uint64", 0xFFFFFFFFFFFFFFFF),
    "float32": ("float32", None),
    "float64": ("float64", None),
    "ipaddr": ("ipv4", None),
    "ipv6addr": ("ipv6", None),
    "eui48": ("eui64", None),
}
"""For each SunSpec type: the value type in a device file, and the number that means "not implemented".

The number is None for types without one, and for floats, where it is NaN.
"""
_UNITS: Final = {"C": "°C", "Secs": "s", "Pct": "%", "Degrees": "°", "deg": "°", "VAr": "var", "Var": "var"}
_SAYING_NOTHING: Final = ("mandatory", "static", "standards", "detail", "comments")


def read_sunspec(
    text: str, name: str, *, first: int = FIRST_MODEL, counts: Mapping[str, int] | None = None
) -> ImportedDevice:
    """Import the points of a SunSpec model, all as unit 1.

    Args:
        text: the model in JSON.
        name: the file's name, for errors.
        first: 0-based address of the model's register ``ID`` in the device.
        counts: how many members a repeated group has, 1 or more, by the name of the group or of the point that holds
            its count.

    Returns:
        The points and groups; and as ``omissions`` what could not be carried over.

    Raises:
        ConfigError: the text is no SunSpec model, the user has to give the count of a repeated group, or a given count
            is less than 1.
    """
    for group_name, count in (counts or {}).items():
        if count < 1:
            raise ConfigError(
                f"a repeated group is there at least once, not {count} times", key=f"--count {group_name}"
            )
    try:
        model = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is no JSON: {error}", file=name) from None
    group = model.get("group") if isinstance(model, dict) else None
    if not isinstance(group, dict) or not isinstance(group.get("points"), list):
        raise ConfigError("is no SunSpec model: it has no group with points", file=name)
    found = ImportedDevice()
    found.remarks += [
        f"SunSpec model {model.get('id', '?')}, {group.get('label', group.get('name', ''))}.",
        f"Its register ID is assumed at offset {first}; --address says where a device has it.",
    ]
    try:
        _Model(found, name, dict(counts or {})).take(group, first)
    except ConfigError:
        raise
    except WRONG_VALUE as error:  # where the following points are is not known then
        raise ConfigError(f"is no SunSpec model: it has a value that cannot be read: {error}", file=name) from error
    found.omit("", ", ".join(_SAYING_NOTHING), "say nothing about values")
    return found


class _Model:
    """Converts the points and groups of a SunSpec model to those of a device file, and finds their addresses."""

    def __init__(self, found: ImportedDevice, name: str, counts: dict[str, int]) -> None:
        self._found = found
        self._name = name
        self._counts = counts

    def take(self, group: Mapping[str, Any], first: int) -> None:
        """Import the top-level group of the model, with all groups in it; ``first`` is the 0-based address of ``ID``.

        Raises:
            ConfigError: the user has to give the count of a repeated group.
        """
        points, at = self._points(group, first, ())
        for keys in points:
            self._found.add(1, keys, keys["name"])
        names = [keys["name"] for keys in points]
        groups, _ = self._groups(group, at, names, first, is_last=True)
        if groups:
            self._found.groups[1] = groups

    def _groups(
        self, group: Mapping[str, Any], at: int, around: Sequence[str], first: int, *, is_last: bool
    ) -> tuple[list[dict[str, Any]], int]:
        inner = group.get("groups", [])
        sections = []
        for place, each in enumerate(inner):
            section, at = self._group(each, at, around, first, is_last=is_last and place == len(inner) - 1)
            sections.append(section)
        return sections, at

    def _group(
        self, group: Mapping[str, Any], at: int, around: Sequence[str], first: int, *, is_last: bool
    ) -> tuple[dict[str, Any], int]:
        name, declared = str(group.get("name", "group")), group.get("count", 1)
        given = self._counts.get(name, self._counts.get(str(declared)))
        count = given if given is not None else declared if isinstance(declared, int) and declared > 0 else None
        if count is None and not is_last:
            raise ConfigError(
                f"group {name} has as many places as {declared or 'L'} says, and what follows moves with it:"
                f" say how many, --count {declared or name}=N",
                file=self._name,
            )
        points, end = self._points(group, at, around)
        known = [*(keys["name"] for keys in points), *around]
        groups, end = self._groups(group, end, known, first, is_last=is_last and count == 1)
        section: dict[str, Any] = {"name": name}
        if count != 1 or given is not None:
            section |= {"count": count or MOST, "stride": end - at}
        if count is None:
            section["count_from"] = declared or self._count_by_length(name, at, end - at, first)
        section["point"] = points
        if groups:
            section["group"] = groups
        return section, at + (count or MOST) * (end - at)

    def _count_by_length(self, name: str, at: int, size: int, first: int) -> str:
        """Add a computed point: the number of members of a group, from the model's length ``L``. Return its name.

        Args:
            name: name of the group.
            at: 0-based address of the group's first register.
            size: number of registers of one member.
            first: 0-based address of the model's register ``ID``.

        Raises:
            ConfigError: a member has no registers, so no number of them follows from a length.
        """
        if not size:
            raise ConfigError(f"group {name} is there as often as L says, and has no registers", file=self._name)
        counting = f"{name}_count"
        self._found.add(1, {"name": counting, "formula": f"(L - {at - first - 2}) // {size}"}, name)
        return counting

    def _points(self, group: Mapping[str, Any], at: int, around: Sequence[str]) -> tuple[list[dict[str, Any]], int]:
        points: list[dict[str, Any]] = []
        there = {str(each.get("name")) for each in group.get("points", [])} | set(around)
        for each in group.get("points", []):
            size = int(each.get("size", 1))
            keys = self._point(each, at, there)
            if keys is not None:
                points.append(keys)
            at += size
        return points, at

    def _point(self, point: Mapping[str, Any], at: int, there: set[str]) -> dict[str, Any] | None:
        name, kind, size = str(point.get("name", "")), str(point.get("type", "")), int(point.get("size", 1))
        if kind == "pad":
            return None
        keys: dict[str, Any] = {"name": name, "address": f"holding:{at}"}
        if kind == "string":
            keys["type"] = f"string:{2 * size}"
        elif kind in _ABSENT:
            keys["type"], absent = _ABSENT[kind]
            symbols = dict(_symbols(point, name, self._found))
            if kind.startswith("enum") and symbols:
                keys["enumeration"] = symbols
            elif kind.startswith("bitfield") and symbols:
                keys["flags"] = symbols
            if absent is not None and absent not in symbols.values():
                keys["invalid"] = [absent]
        else:
            self._found.omit(name, name, f"has a type that there is not: {shown(kind)}")
            return None
        if kind.startswith("acc"):
            keys["rollover"] = True
        scale = self._scale(point, name, there)
        if scale is None:
            return None
        keys |= scale
        units = str(point.get("units", ""))
        said = point.get("desc", point.get("label", ""))
        if units:
            keys["unit_of_measure"] = _UNITS.get(units, units)
        if said:
            keys["description"] = str(said)
        if point.get("access") != "RW":
            keys["access"] = "read"
        return keys

    def _scale(self, point: Mapping[str, Any], name: str, there: set[str]) -> dict[str, Any] | None:
        """Return the keys for the scale factor of a point; None if the model does not have it, which is reported.

        Without it the values would be wrong by a power of ten, so the point is to be left out.
        """
        factor = point.get("sf")
        if factor is None or (isinstance(factor, int) and not factor):
            return {}
        if isinstance(factor, int):
            if abs(factor) > LARGEST_EXPONENT:
                raise ValueError(f"{name}.sf is -{LARGEST_EXPONENT}…{LARGEST_EXPONENT}, not {shown(factor)}")
            return {"scale": float(f"1e{factor}")}
        if factor not in there:
            self._found.omit(name, name, f"has a scale factor (sf) that the model does not have: {shown(factor)}")
            return None
        return {"scale_from": factor}


def _symbols(point: Mapping[str, Any], name: str, found: ImportedDevice) -> Iterator[tuple[str, int]]:
    """Yield name and number of each symbol of a point: a value of an enumeration, or a bit of a bit field.

    A symbol whose number is no integer, or has a name already, is reported and left out.
    """
    seen: set[int] = set()
    for each in point.get("symbols", []):
        value = each.get("value")
        if not isinstance(value, int) or value in seen:
            found.omit(name, f"{name}.{each.get('name')}", f"names {shown(value)}, which has a name already")
            continue
        seen.add(value)
        yield str(each.get("name")), value
