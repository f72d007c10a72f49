"""Reads a collector file into links, devices with their points, and read plans; reports all errors at once.

Knows which section becomes which part of a collector; opens no port and no store. It reads the collector file, and the
device profiles that the file names.
"""

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from ...client.assumed_settings import default_unit
from ...client.settings import LinkSettings
from ...codes import Table
from ...config.file_text import read_text
from ...config.files.collector import CollectedDeviceSection, CollectorFile
from ...config.files.device import UnitSection
from ...config.files.file_error import FileError
from ...config.files.key_lines import KeyPath
from ...config.files.section import keys_of
from ...config.files.sinks import PrometheusSinkSection, SentSection, SinkSection
from ...config.files.toml_source import Source, parse_with_source
from ...config.links import NamedLink
from ...config.paths import within
from ...config.profiles import DEVICES, PREFIX, read_profile
from ...config.profiles.loading import load_profile
from ...config.report import ConfigurationReport
from ...errors import ConfigError, InvalidRequest
from ...framing.character_times import Parity, SerialTiming
from ...options.declaration import Mark
from ...options.sinks import DeliveryOptions
from ...points.name_patterns import is_meant
from ...points.point import Point
from ...points.point_rules import ItemRange, ReadRules
from ..service.configuration import Configuration, put_together
from .admission import LinkLoad, load_of_link
from .commands.command_messages import CommandInput
from .commands.input_options import make_input
from .cost import ReadCost, baud_cost, line_cost, network_cost
from .held_values import hold_limits
from .knowledge import DeviceKnowledge, Knowledge
from .plan_cache import PlanBook
from .samples import PointDescription
from .sinks.interface import OwnTopicSink, Sink, TopicSink
from .sinks.options import make_sink

LINK_DEFAULTS: Final[Mapping[str, Any]] = {"port_wait": 0.0, "retries": 0, "open_after": 0}
"""Defaults of link options that differ for collectors: a link neither waits for a missing port, nor repeats requests to
silent devices, nor suspends them. The schedule does this instead, because it knows what else is due."""
LEARNT_FILE: Final = "learnt.json"
"""Name of the file in the store's folder in which a collector keeps what it learns about devices."""


@dataclass(frozen=True, slots=True)
class CollectedDevice:
    """A device of a collector file, with its points and how they are read.

    Attributes:
        name: name of the device.
        link: name of its link.
        unit: its unit identifier.
        profile: its device profile, as the file names it.
        firmware: its firmware version, as the file says; empty for unknown.
        points: all its points, computed ones included.
        rules: which reads the device allows: ranges, and most registers and bits.
        items: the points that are read, by poll class; computed points are not among them.
        cost: the assumed cost of its reads, used until the real one is learnt.
        fixed: whether the seconds per register in ``cost`` are certain, because the baud rate of its line is known.
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
        """Return a new, empty cache of the device's read plans.

        Args:
            known: what was learnt about the device; its plans keep to that.
        """
        return PlanBook(self.items, self.rules, self.cost, fixed=self.fixed, knowledge=known)

    def hold_limits(self, periods: Mapping[str, float]) -> dict[str, float]:
        """Return the seconds without a read after which the value of each point is held, by name (`held_values`).

        Args:
            periods: poll periods in seconds, by poll class.
        """
        return hold_limits(self.points, self.items, periods)

    def descriptions(self) -> list[PointDescription]:
        """Return what the store keeps of each of the device's points beside samples, such as the unit of measure."""
        return [
            PointDescription(
                self.name,
                point.name,
                point.unit_of_measure,
                point.type == "bit",
                point.was or None,
                is_float32=_is_float32(point),
            )
            for point in self.points
        ]


@dataclass(frozen=True, slots=True)
class CollectorConfiguration:
    """The checked contents of a collector file: links, devices with their points, poll periods, store and sinks.

    Attributes:
        common: the parts that files of other applications have too: links, security, control, metrics.
        file: the sections of the file, as they were written.
        text: the text of the file.
        store: path of the store's folder.
        periods: poll periods in seconds, by poll class.
        devices: the devices, by name.
        sinks: the systems that samples are sent to, with the options of delivery, by name.
        pages: the pages for Prometheus, by name.
        inputs: the inputs that receive commands from the servers of sinks, by name of the sink.
    """

    common: Configuration
    file: CollectorFile
    text: str
    store: str
    periods: Mapping[str, float]
    devices: Mapping[str, CollectedDevice] = field(default_factory=dict)
    sinks: Mapping[str, tuple[Sink, DeliveryOptions]] = field(default_factory=dict)
    pages: Mapping[str, PrometheusSinkSection] = field(default_factory=dict)
    inputs: Mapping[str, CommandInput] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Path of the collector file, as it was given."""
        return self.common.name

    @property
    def links(self) -> Mapping[str, NamedLink]:
        """The links of the file, by name."""
        return self.common.links

    @property
    def hosts(self) -> Mapping[str, Sequence[str]]:
        """The names of the machines that can reach a link, the preferred one first, by name of the link.

        A link that all machines can reach is left out.
        """
        return {each.name: each.hosts for each in self.file.link if each.hosts}

    @property
    def sink_keys(self) -> Mapping[str, SinkSection]:
        """The ``[[sink]]`` section of each sink and page for Prometheus, by name; a reload compares them."""
        return {each.name: each for each in self.file.sink if each.name in self.sinks or each.name in self.pages}

    @property
    def input_keys(self) -> Mapping[str, SinkSection]:
        """The ``[[sink]]`` section of each sink that also receives commands, by name; a reload compares them."""
        return {each.name: each for each in self.file.sink if each.name in self.inputs}

    @property
    def gateway_waits(self) -> Mapping[str, float]:
        """The seconds for which a gateway behind a link may hold a request in its queue, by name of the link.

        Links without such a time are left out.
        """
        return {each.name: each.gateway_wait for each in self.file.link if each.gateway_wait}

    @property
    def learnt_path(self) -> Path:
        """Path of the file in which the collector keeps what it learns about devices."""
        return Path(self.store) / LEARNT_FILE

    def devices_of(self, link: str) -> list[CollectedDevice]:
        """Return the devices that are polled over the link of this name; empty if there are none."""
        return [device for device in self.devices.values() if device.link == link]

    def hold_limits(self) -> dict[tuple[str, str], float]:
        """Return the seconds without a read after which the value of each point is held, by device and point name."""
        return {
            (device.name, point): limit
            for device in self.devices.values()
            for point, limit in device.hold_limits(self.periods).items()
        }

    def known_of(self, device: CollectedDevice, knowledge: Knowledge) -> DeviceKnowledge:
        """Return what is known about a device, from ``knowledge``; only pinned facts if the device was changed.

        Changed means another profile, firmware, endpoint or unit than when the facts were learnt (`Knowledge.of`).
        """
        place = f"{self.links[device.link].settings.endpoint.url} unit {device.unit}"
        return knowledge.of(device.name, device.profile, device.firmware, place)

    def loads(self, knowledge: Knowledge) -> list[LinkLoad]:
        """Return the result of the admission test of each link: its load, and the poll periods that it cannot keep.

        Args:
            knowledge: what was learnt about the devices; their read plans, and so the loads, depend on it.
        """
        found = []
        for name, link in self.links.items():
            books = [
                (each.name, each.book(self.known_of(each, knowledge)), self.periods) for each in self.devices_of(name)
            ]
            found.append(load_of_link(name, books, link.settings.parameters.timeout))
        return found


def load_collector(path: str | os.PathLike[str]) -> CollectorConfiguration:
    """Read and check a collector file and the device profiles that it names.

    Args:
        path: the collector file; paths in it are relative to its folder.

    Raises:
        FileError: the file or a profile is wrong; ``problems`` has all errors, each with file, line and key.
        ConfigError: the file cannot be read.
    """
    name = os.fspath(path)
    return parse_collector(read_text(name), name)


def parse_collector(text: str, name: str) -> CollectorConfiguration:
    """Check the text of a collector file and the device profiles that it names.

    Args:
        text: the contents of the file.
        name: path of the file, for errors; paths in the text are relative to its folder. The file is not read.

    Raises:
        FileError: the text or a profile is wrong; ``problems`` has all errors, each with file, line and key.
    """
    file, source = parse_with_source(text, CollectorFile, name)
    report = ConfigurationReport(source)
    common = put_together(file, name, report, link_defaults=LINK_DEFAULTS)
    devices: dict[str, CollectedDevice] = {}
    profiles = _Profiles(name)
    for index, section in enumerate(file.device):
        made = _device(file, section, ("device", index), common.links, profiles, source, report)
        if made is not None:
            devices[made.name] = made
    sinks, pages, inputs = _sinks(file, name, report)
    _check_places(file, sinks, devices, report)
    report.end()
    periods = {key: each.period for key, each in file.poll_class.items()}
    return CollectorConfiguration(
        common, file, text, within(name, file.collector.store), periods, devices, sinks, pages, inputs
    )


def _sinks(
    file: CollectorFile, name: str, report: ConfigurationReport
) -> tuple[dict[str, tuple[Sink, DeliveryOptions]], dict[str, PrometheusSinkSection], dict[str, CommandInput]]:
    """Return the file's sinks, pages for Prometheus, and inputs of commands, each by name; errors go to the report.

    Relative paths in them become relative to the file's folder.
    """
    sinks: dict[str, tuple[Sink, DeliveryOptions]] = {}
    pages: dict[str, PrometheusSinkSection] = {}
    inputs: dict[str, CommandInput] = {}
    folder = Path(within(name, file.collector.store))
    for index, written in enumerate(file.sink):
        section = _rooted(written, name)
        place = partial(_key_at, ("sink", index))
        if isinstance(section, PrometheusSinkSection):
            pages[section.name] = section
        elif isinstance(section, SentSection):
            made = report.make(partial(make_sink, section, folder), place)
            taken = None if made is None else report.make(partial(make_input, section, made[0]), place)
            sinks |= {} if made is None else {section.name: made}
            inputs |= {} if taken is None else {section.name: taken}
    return sinks, pages, inputs


def _check_places(
    file: CollectorFile,
    sinks: Mapping[str, tuple[Sink, DeliveryOptions]],
    devices: Mapping[str, CollectedDevice],
    report: ConfigurationReport,
) -> None:
    """Report to ``report`` devices or points that a sink would send under one topic, or under one of its own topics.

    Different names can become one topic because a sink replaces some characters in them.
    """
    for index, section in enumerate(file.sink):
        if section.name in sinks:
            sink, options = sinks[section.name]
            for sentence in _shared_places(sink, options, devices.values()) if isinstance(sink, TopicSink) else ():
                report.refuse(("sink", index, "url"), sentence)
            for sentence in _own_topics(sink, options, devices.values()) if isinstance(sink, OwnTopicSink) else ():
                report.refuse(("sink", index, "url"), sentence)


def _own_topics(sink: OwnTopicSink, options: DeliveryOptions, devices: Iterable[CollectedDevice]) -> Iterator[str]:
    for device in devices:
        for point in device.points:
            topic = sink.own_topic(device.name, point.name)
            if topic and any(is_meant(f"{device.name}/{point.name}", pattern) for pattern in options.points):
                yield f"{device.name} would have {topic}, which is the sink's own: rename it, or choose another topic"
                break


def _shared_places(sink: TopicSink, options: DeliveryOptions, devices: Iterable[CollectedDevice]) -> Iterator[str]:
    others: dict[str, str] = {}
    for device in devices:
        places: dict[str, str] = {}
        for point in device.points:
            if not any(is_meant(f"{device.name}/{point.name}", pattern) for pattern in options.points):
                continue
            place, own = sink.place_of(device.name, point.name)
            if others.setdefault(place, device.name) != device.name:
                yield f"devices {others[place]} and {device.name} would both be {place} there: rename one"
                break
            if places.setdefault(own, point.name) != point.name:
                yield f"points {places[own]} and {point.name} of {device.name} would both be {own} there: rename one"


def _rooted(section: SinkSection, name: str) -> SinkSection:
    """Return a copy of a sink's options in which relative paths are joined to the folder of the collector file."""
    files = {key for key, option in keys_of(type(section)).items() if Mark.FILE in option.marks}
    paths = {key: within(name, getattr(section, key)) for key in files & section.model_fields_set}
    if section.url.startswith(_FILE):
        paths["url"] = _FILE + within(name, section.url.removeprefix(_FILE))
    return section.model_copy(update=paths)


def _key_at(at: KeyPath, key: str | None) -> KeyPath:
    return at if key is None else (*at, key)


_FILE: Final = "file://"


@dataclass(frozen=True, slots=True)
class _Profile:
    """The points of a device profile, and the rules for reading a device of that kind."""

    points: tuple[Point, ...]
    rules: ReadRules


class _Profiles:
    """Cache of device profiles, so that devices of one kind share their points."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._read: dict[tuple[str, tuple[tuple[str, Any], ...], int | None], _Profile] = {}
        self._by_unit: dict[str, bool] = {}

    def of(self, section: CollectedDeviceSection, asked: tuple[Source, KeyPath]) -> _Profile:
        """Return the points and reading rules of a device's profile; read at the first use.

        Args:
            section: the device in the collector file.
            asked: the collector file and the place of the section, for errors.

        Raises:
            FileError: the profile cannot be read, or something in it or in its parameters is wrong.
        """
        parent, at = asked
        unit = 1 if section.unit is None else section.unit
        key = (section.profile, tuple(sorted(section.with_.items())), unit if self._needs_unit(section) else None)
        if key not in self._read:
            try:
                found = load_profile(self._file(section.profile), unit=unit, parameters=section.with_)
            except FileError:
                raise
            except ConfigError as error:
                raise FileError([_placed(error, section, parent, at)]) from error
            self._read[key] = _Profile(tuple(found.described()), _rules_of(found))
        return self._read[key]

    def _needs_unit(self, section: CollectedDeviceSection) -> bool:
        """Whether a device profile's contents depend on the unit number, so that each unit needs its own copy.

        False if the profile cannot be read.
        """
        if section.profile not in self._by_unit:
            try:
                text = read_profile(self._file(section.profile))
            except ConfigError:
                text = ""
            self._by_unit[section.profile] = _UNIT.search(text) is not None
        return self._by_unit[section.profile]

    def _file(self, profile: str) -> str:
        if profile.startswith(PREFIX) or profile in DEVICES:
            return PREFIX + profile.removeprefix(PREFIX)
        return within(self._name, profile)


_UNIT: Final = re.compile(r"\$\{[^}]*\b(unit|index)\b")


def _placed(error: ConfigError, section: CollectedDeviceSection, source: Source, at: KeyPath) -> ConfigError:
    """Return an error of a profile as an error of the collector file, placed at the device that names the profile."""
    if error.key in section.with_:
        return source.problem((*at, "with", str(error.key)), f"{section.profile}: {error.message}")
    is_path = "/" in section.profile or "." in section.profile
    ready = "" if is_path else f"; ready-made profiles are {', '.join(DEVICES)}"
    return source.problem((*at, "profile"), f"{section.profile}: {error.message}{ready}")


def _rules_of(unit: UnitSection) -> ReadRules:
    """Return the rules for reading a unit.

    If they have no readable ranges for a table, all addresses of it that the profile declares count as readable.
    """
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
    at: KeyPath,
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


def _is_float32(point: Point) -> bool:
    """Whether the values of a point are numbers of type float32 exactly as the device holds them.

    False if a scale, another conversion, a formula or a running total changes them.
    """
    conversion = point.conversion
    is_changed = conversion.changes or conversion.scale_from or point.formula or point.rollover is not None
    return point.type == "float32" and not is_changed


def _by_class(
    file: CollectorFile,
    section: CollectedDeviceSection,
    points: Sequence[Point],
    at: KeyPath,
    report: ConfigurationReport,
) -> dict[str, list[Point]] | None:
    """Return the points to be read, by poll class.

    None, with a problem in the report, if a poll class is missing or does not exist, a point has several numbers in one
    value, or there is nothing to read.
    """
    usual = file.class_of(section)
    found: dict[str, list[Point]] = {}
    for point in points:
        if point.form is not None and point.form.name.startswith("custom:"):
            report.refuse(
                (*at, "profile"),
                f"{point.name} has type {point.form.name}, several numbers in one value, and a sample has one: make a "
                "point of each number, with an atomic group for all",
            )
            return None
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
    """Return the assumed cost of reads over a link, and whether its seconds per register are certain (known baud rate).

    Args:
        settings: the settings of the link.
        line_baud: speed in bit/s of the line behind a gateway; None for no such line.
        pause: seconds that the device needs between two requests; it counts only on a serial port of this machine.
    """
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
