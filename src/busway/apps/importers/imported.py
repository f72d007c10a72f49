"""The result of an import: collects points in units, checks them, and writes them as a device file.

Knows the schema of device files and reports; knows no format of other programs.

1. Nothing is dropped in silence: each key, point or section that is not carried over is a line of the report, with its
   place in the file and the reason.
2. An invalid point is left out and reported; the others are kept. Points may share registers.
3. A unit of the result is one device. Points of a unit with the same number behind another connection are left out and
   reported: their values are those of another device.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

from pydantic import ValidationError

from ...config.files.error_wording import faults_in
from ...config.files.simulation import SimulatedPointSection, SimulatedUnitSection
from ...errors import ConfigError
from ..simulator.device_text import device_text

WRONG_VALUE: Final = (ValueError, TypeError, AttributeError, OverflowError)
"""Exceptions that mean: a value in an imported file has another type or form than the importer expects."""


@dataclass(frozen=True, slots=True)
class Omission:
    """A part of the imported file that was not carried over, and why.

    Attributes:
        where: place in the imported file: a line or a name; empty for the whole file.
        what: the point, key or section that was left out.
        why: the reason, as a sentence without subject (``what`` is its subject): "has no address".
    """

    where: str
    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.why}" if self.where else f"{self.what}: {self.why}"


@dataclass(frozen=True, slots=True)
class ImportedPoint:
    """An imported point: its keys as in a device file, and its place in the imported file, for reports (``where``)."""

    keys: dict[str, Any]  # what TOML has
    where: str = ""


@dataclass(slots=True)
class ImportedDevice:
    """The result of an import: the points found in a file of another program, and what was not carried over.

    An importer fills it by `add`, `omit` and `reporting`; `sections` and `text` then make a device file of it.

    Attributes:
        points: the points, by unit number; not checked yet.
        groups: the ``[[unit.group]]`` tables of the device file, by unit number.
        remarks: comment lines for the head of the device file.
        omissions: the parts of the imported file that were not carried over.
    """

    points: dict[int, list[ImportedPoint]] = field(default_factory=dict)
    groups: dict[int, list[dict[str, Any]]] = field(default_factory=dict)  # Any: what TOML has
    remarks: list[str] = field(default_factory=list)
    omissions: list[Omission] = field(default_factory=list)
    _connections: dict[int, str] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The connection that leads to each unit, in the words of the imported file (rule 3)."""
    _invalid: list[Omission] = field(default_factory=list, init=False, repr=False, compare=False)
    """Those of ``omissions`` that `sections` has added."""

    def add(self, unit: int, keys: Mapping[str, Any], where: str = "", *, connection: str = "") -> None:
        """Add a point to a unit. It is not checked: `sections` does that later.

        Args:
            unit: the unit number.
            keys: the keys of the point as in a device file; keys whose value is None are left out.
            where: place of the point in the imported file, for reports.
            connection: how the imported file says that the device is reached. If the unit has points behind another
                connection, the point is left out and reported.
        """
        first = self._connections.setdefault(unit, connection)
        if first != connection:
            other = f"another device, at {first or 'another connection'}"
            why = f"unit {unit} is {other}: convert each from a file of its own"
            self.omit(where, str(keys.get("name", "")) or "a point", why)
            return
        kept = {key: value for key, value in keys.items() if value is not None}
        self.points.setdefault(unit, []).append(ImportedPoint(kept, where))

    def omit(self, where: str, what: str, why: str) -> None:
        """Record that a part of the imported file is not carried over; arguments: the attributes of `Omission`."""
        self.omissions.append(Omission(where, what, why))

    @contextmanager
    def reporting(self, where: str, what: str) -> Iterator[None]:
        """Context manager that reports a part of the imported file as left out if a value in it cannot be read.

        An exception of `WRONG_VALUE` ends the block and is not raised further. ``where`` and ``what`` are those of
        `Omission`.
        """
        try:
            yield
        except WRONG_VALUE as error:
            self.omit(where, what, f"has a value that cannot be read: {error}")

    def sections(self) -> list[SimulatedUnitSection]:
        """Check the imported points, and return the units that they form, sorted by number.

        Invalid points are left out and added to ``omissions``, in place of those of an earlier call. Of several points
        of a unit with one name, all but the first get a number appended.

        Raises:
            ConfigError: no valid point is left, or a unit is invalid as a whole.
        """
        self.omissions = [each for each in self.omissions if not any(each is one for one in self._invalid)]
        self._invalid = []
        found = [self._unit(number) for number in sorted({*self.points, *self.groups})]
        if not any(section.point or section.group for section in found):
            why = f": {self.omissions[0]}" if self.omissions else ""
            raise ConfigError(f"there is no point in it that could be carried over{why}")
        return found

    def _leave_out(self, where: str, what: str, why: str) -> None:
        self.omit(where, what, why)
        self._invalid.append(self.omissions[-1])

    def _unit(self, number: int) -> SimulatedUnitSection:
        kept: list[ImportedPoint] = []
        names: set[str] = set()
        for point in self.points.get(number, []):
            keys = {**point.keys, "name": _once(str(point.keys.get("name", "")), names)}
            try:
                SimulatedPointSection.model_validate(keys)
            except ValidationError as error:
                why = "; ".join(dict.fromkeys(sentence for _, sentence in faults_in(error, SimulatedPointSection)))
                self._leave_out(point.where, keys["name"] or "a point without a name", why)
                continue
            names.add(keys["name"])
            kept.append(ImportedPoint(keys, point.where))
        return self._together(number, kept)

    def _together(self, number: int, kept: list[ImportedPoint]) -> SimulatedUnitSection:
        """Return the section of one unit, with those of its points that are valid together.

        Points that share registers with others are marked for that (``overlaps``); other invalid ones are reported and
        left out.

        Raises:
            ConfigError: the unit is invalid for another reason than its points.
        """
        groups = self.groups.get(number, [])
        while True:
            data = {"unit": number, "point": [each.keys for each in kept]} | ({"group": groups} if groups else {})
            try:
                return SimulatedUnitSection.model_validate(data)
            except ValidationError as error:
                faults = faults_in(error, SimulatedUnitSection)
            wrong: dict[Any, str] = {
                path[1]: sentence for path, sentence in faults if path[:1] == ("point",) and len(path) > 1
            }
            if not wrong:
                raise ConfigError("; ".join(sentence for _, sentence in faults))
            for place, sentence in wrong.items():
                if "is taken by" in sentence:
                    kept[place].keys["overlaps"] = True
                else:
                    self._leave_out(kept[place].where, kept[place].keys["name"], sentence)
            kept = [each for at, each in enumerate(kept) if at not in wrong or "is taken by" in wrong[at]]

    def text(self, source: str) -> str:
        """Return the text of the device file; comment lines at its top list what was not carried over.

        The points are checked first, as by `sections`.

        Args:
            source: name of the imported file, for the first comment line.

        Raises:
            ConfigError: no valid point is left, or a unit is invalid as a whole.
        """
        units = self.sections()
        remarks = [f"Converted from {source} by busway points convert.", *self.remarks]
        if self.omissions:
            remarks += ["", "Not carried over:", *(f"  {each}" for each in self.omissions)]
        return device_text(units, remarks=remarks, compact=True)


def tables_in(value: object) -> Iterator[tuple[int, Mapping[str, Any]]]:  # Any: what the file has
    """Yield the tables of a list from an imported file (TOML tables or YAML mappings), each with its index in the list.

    Elements that are no tables are skipped; if ``value`` is no list, nothing is yielded.
    """
    return ((at, each) for at, each in enumerate(value if isinstance(value, list) else []) if isinstance(each, dict))


def others_of(table: Mapping[str, object], known: Collection[str]) -> list[str]:
    """Return the keys of a table that are not in ``known``, in the order of the file."""
    return [key for key in table if key not in known]


def _once(name: str, taken: set[str]) -> str:
    """Return ``name`` if it is not in ``taken``, otherwise the name with the first free number appended: ``name_2``."""
    if name not in taken:
        return name
    number = 2
    while f"{name}_{number}" in taken:
        number += 1
    return f"{name}_{number}"
