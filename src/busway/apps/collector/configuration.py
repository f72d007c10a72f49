"""A collector file → links, devices with their points, and plans; everything that is wrong is said at once.

Knows which section becomes which part of a collector; opens no port and no store. It reads the file, and the profiles
that this names.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any, Final

from pydantic import ValidationError

from ...client.checks import default_unit
from ...client.settings import LinkSettings
from ...codes import Table
from ...config.files.collector import CollectedDeviceSection, CollectorFile, SinkSection, read_collector_file
from ...config.files.device import UnitSection
from ...config.files.lines import Path
from ...config.files.problems import FileError
from ...config.files.schema import Source, faults_of, in_order, read_source
from ...config.files.simulation import SimulatedUnitSection
from ...config.links import NamedLink
from ...config.parameters import FilledSource, declared_parameters
from ...config.paths import within
from ...config.profiles import DEVICES, PREFIX, read_included
from ...config.reading import read_text
from ...config.report import ConfigurationReport
from ...errors import ConfigError, InvalidRequest
from ...framing.timing import Parity, SerialTiming
from ...points.point import Point
from ...points.rules import ItemRange, ReadRules
from ..server.configuration import Configuration, put_together
from .admission import LinkLoad, admit
from .cost import ReadCost, baud_cost, line_cost, network_cost
from .knowledge import DeviceKnowledge, Knowledge
from .plans import PlanBook
from .samples import PointDescription

LINK_DEFAULTS: Final[Mapping[str, Any]] = {"port_wait": 0.0, "retries": 0, "open_after": 0}
"""Options of links that have another default here: nobody waits for a port that is not there, and silent devices are
repeated and suspended by the schedule, which knows what else is due."""
LEARNT_FILE: Final = "learnt.json"
"""The file beside the store that keeps what was learnt."""


@dataclass(frozen=True, slots=True)
class CollectedDevice:
    """A device of a collector file.

    Attributes:
        name, link, unit: its name, that of its link, and its unit identifier.
        profile, firmware: what kind of device it is; empty for unknown.
        points: all its points, computed ones too.
        rules: what it allows.
        items: the points that are read, by class.
        cost: what its reads cost until that is known.
        fixed: whether the price of a register is known.
    """

    name: str
    link: str
    unit: int
    profile: str
    firmware: str
    points: Sequence[Point]
    rules: ReadRules
    items: Mapping[str, Sequence[Point]]
    cost: ReadCost
    fixed: bool

    def book(self, known: DeviceKnowledge) -> PlanBook:
        """Its plans, with what is known of it."""
        return PlanBook(self.items, self.rules, self.cost, fixed=self.fixed, knowledge=known)

    def descriptions(self) -> list[PointDescription]:
        """What the store keeps of its points."""
        return [
            PointDescription(self.name, point.name, point.unit_of_measure, point.type == "bit", point.was or None)
            for point in self.points
        ]


@dataclass(frozen=True, slots=True)
class CollectorConfiguration:
    """Everything that a collector file says, checked as a whole.

    Attributes:
        common: what it has in common with other configurations: links, security, control, metrics.
        file: its sections.
        text: the file as it was read.
        store: the folder of the store.
        periods: seconds by class.
        devices: by name.
    """

    common: Configuration
    file: CollectorFile
    text: str
    store: str
    periods: Mapping[str, float]
    devices: Mapping[str, CollectedDevice] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.common.name

    @property
    def links(self) -> Mapping[str, NamedLink]:
        """The links by name."""
        return self.common.links

    @property
    def sinks(self) -> Sequence[SinkSection]:
        """The sinks."""
        return self.file.sink

    @property
    def learnt_path(self) -> FilePath:
        """Where what was learnt is kept."""
        return FilePath(self.store) / LEARNT_FILE

    def devices_of(self, link: str) -> list[CollectedDevice]:
        """The devices behind a link."""
        return [device for device in self.devices.values() if device.link == link]

    def loads(self, knowledge: Knowledge) -> list[LinkLoad]:
        """The admission test of each link."""
        found = []
        for name, link in self.links.items():
            books = [
                (each.name, each.book(knowledge.of(each.name, each.profile, each.firmware)), self.periods)
                for each in self.devices_of(name)
            ]
            found.append(admit(name, books, link.settings.parameters.timeout))
        return found


def load_collector(path: str | os.PathLike[str]) -> CollectorConfiguration:
    """The collector that a file declares.

    Raises:
        ConfigError: the file cannot be read, or something in it or in a profile cannot be; then it has all
            ``problems``, each with file, line and key.
    """
    name = os.fspath(path)
    return parse_collector(read_text(name), name)


def parse_collector(text: str, name: str) -> CollectorConfiguration:
    """The collector that a text declares.

    Args:
        text: the content of the file.
        name: its name, for sentences; paths in it are relative to its folder.

    Raises:
        FileError: all that is wrong, each with file, line and key.
    """
    file, source = read_collector_file(text, name)
    report = ConfigurationReport(source)
    common = put_together(file, name, report, link_defaults=LINK_DEFAULTS)
    devices: dict[str, CollectedDevice] = {}
    profiles = _Profiles(name)
    for index, section in enumerate(file.device):
        made = _device(file, section, ("device", index), common.links, profiles, source, report)
        if made is not None:
            devices[made.name] = made
    report.end()
    periods = {key: each.period for key, each in file.poll_class.items()}
    return CollectorConfiguration(common, file, text, within(name, file.collector.store), periods, devices)


@dataclass(frozen=True, slots=True)
class _Profile:
    points: tuple[Point, ...]
    rules: ReadRules


class _Profiles:
    """Profiles that were read, so that devices of one kind share their points."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._read: dict[tuple[str, tuple[tuple[str, Any], ...]], _Profile] = {}

    def of(self, section: CollectedDeviceSection, asked: tuple[Source, Path]) -> _Profile:
        """The profile of a device. Raises `FileError`."""
        key = (section.profile, tuple(sorted(section.with_.items())))
        if key not in self._read:
            unit = _unit_of(self._file(section.profile), section.with_, asked)
            self._read[key] = _Profile(tuple(unit.described()), _rules_of(unit))
        return self._read[key]

    def _file(self, profile: str) -> str:
        if profile.startswith(PREFIX) or profile in DEVICES:
            return PREFIX + profile.removeprefix(PREFIX)
        return within(self._name, profile)


def _unit_of(name: str, given: Mapping[str, Any], asked: tuple[Source, Path]) -> UnitSection:
    """The one unit of a profile, its parameters put in. Raises `FileError` with the lines of the profile."""
    parent, at = asked
    try:
        text = read_included(name)
    except ConfigError as error:
        ready = ", ".join(DEVICES)
        raise FileError(
            [parent.problem((*at, "profile"), f"{error.message}; ready-made profiles are {ready}")]
        ) from error
    source = read_source(text, name)
    parameters = declared_parameters(source, given, asked)
    filled = FilledSource(source, {**parameters, "unit": 1, "index": 0})
    sections = source.data.get("unit")
    if not isinstance(sections, list) or len(sections) != 1 or not isinstance(sections[0], dict):
        raise FileError([parent.problem((*at, "profile"), f"needs a file with one [[unit]]: {name}")])
    data = {"unit": 1, **filled.filled(sections[0], ("unit", 0))}
    try:
        return SimulatedUnitSection.model_validate(data)
    except ValidationError as error:
        raise FileError(
            in_order(
                source.problem(("unit", 0, *path), sentence)
                for each in error.errors()
                for path, sentence in faults_of(each, SimulatedUnitSection)
            )
        ) from None


def _rules_of(unit: UnitSection) -> ReadRules:
    """How a unit may be read. A table that it declares exists as a whole, so that holes in it may be read."""
    rules = unit.read.rules()
    readable = dict(rules.readable)
    for table in Table:
        declared = unit.table(table)
        if declared is not None and declared.size and table not in readable:
            readable[table] = [ItemRange(declared.first, declared.end)]
    return replace(rules, readable=readable)


def _device(
    file: CollectorFile,
    section: CollectedDeviceSection,
    at: Path,
    links: Mapping[str, NamedLink],
    profiles: _Profiles,
    source: Source,
    report: ConfigurationReport,
) -> CollectedDevice | None:
    try:
        profile = profiles.of(section, (source, at))
    except FileError as error:
        report.problems += error.problems
        return None
    items = _by_class(file, section, profile.points, at, report)
    link = links.get(section.link)
    if link is None or items is None:
        return None
    try:
        unit = default_unit(link.settings.endpoint, section.unit)
    except InvalidRequest as error:
        report.refuse((*at, "unit"), error.message.replace(": link.unit(1)", ""))
        return None
    cost, fixed = _cost(link.settings, section.line_baud, profile.rules.pause)
    return CollectedDevice(
        section.name,
        section.link,
        unit,
        section.profile,
        section.firmware,
        profile.points,
        profile.rules,
        items,
        cost,
        fixed,
    )


def _by_class(
    file: CollectorFile, section: CollectedDeviceSection, points: Sequence[Point], at: Path, report: ConfigurationReport
) -> dict[str, list[Point]] | None:
    """The points that are read, by class; None and a word to the judge where a class is missing."""
    usual = file.class_of(section)
    found: dict[str, list[Point]] = {}
    for point in points:
        if not point.formula:
            found.setdefault(point.poll_class or usual, []).append(point)
    there = ", ".join(file.poll_class)
    for name, of_class in found.items():
        if not name:
            report.refuse((*at, "poll_class"), f"is missing: {of_class[0].name} is in no class; there are {there}")
        elif name not in file.poll_class:
            report.refuse((*at, "profile"), f"{of_class[0].name} is in class {name!r}, which is not there, but {there}")
        else:
            continue
        return None
    if not found:
        report.refuse((*at, "profile"), f"{section.profile} has no points")
        return None
    return found


def _cost(settings: LinkSettings, line_baud: int | None, pause: float) -> tuple[ReadCost, bool]:
    """What reads over a link cost, and whether the price of a register is known."""
    if line_baud is not None:
        return baud_cost(line_baud), True
    port = None if settings.line is None else settings.line.port
    if port is None:
        return network_cost(), False
    timing = SerialTiming.of_line(
        port.baud, data_bits=port.data_bits, parity=Parity(port.parity), stop_bits=port.stop_bits
    )
    framing: Any = settings.endpoint.framing  # rtu or ascii, where there is a port
    gap = max(settings.parameters.request_gap, settings.line.conversation.unit_switch_gap if settings.line else 0.0)
    return line_cost(timing, framing, gap=max(gap, pause)), True
