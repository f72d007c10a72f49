"""Finds the report rule of each point: which of its samples the store keeps, and which of those sinks get.

Knows a configuration; applies no rule.

1. For the store: ``store_report`` of the point, or else of its device, or else of its poll class, or else of the
   collector, or else every sample is kept.
2. For a sink: its own ``report``, or else that of the point. A sink gets only samples that the store keeps.
"""

from collections.abc import Iterator

from ...config.files.collector import CollectedDeviceSection
from ...config.files.points import ReportSection
from ...points.point import Point
from ...points.point_rules import ReportRule
from .configuration import CollectorConfiguration

RulesByPoint = dict[tuple[str, str], ReportRule]
_EVERY = "every"


def store_rules(configuration: CollectorConfiguration, device: str | None = None) -> RulesByPoint:
    """Return the report rules of the points of which the store keeps only some samples, by device and point name.

    Points of which the store keeps every sample are left out.

    Args:
        configuration: the collector's configuration.
        device: name of the only device whose rules are returned; None for all devices. The result is empty if there is
            no such device.
    """
    wanted = configuration.devices.keys() if device is None else {device} & configuration.devices.keys()
    sections = [section for section in configuration.file.device if section.name in wanted]
    return {
        key: rule for section in sections for key, rule in _of_device(configuration, section) if rule.when != _EVERY
    }


def _of_device(
    configuration: CollectorConfiguration, section: CollectedDeviceSection
) -> Iterator[tuple[tuple[str, str], ReportRule]]:
    file = configuration.file
    usual = file.class_of(section)
    for point in configuration.devices[section.name].points:
        of_class = file.poll_class.get(point.poll_class or usual)
        sections = (section.store_report, None if of_class is None else of_class.store_report)
        yield (section.name, point.name), _first(point, *sections, file.collector.store_report)


def _first(point: Point, *sections: ReportSection | None) -> ReportRule:
    """Return the store's report rule of a point: its own, or that of the first section with one, or "every sample"."""
    if point.storing is not None:
        return point.storing
    return next((each.described() for each in sections if each is not None), ReportRule())


def sink_rules(configuration: CollectorConfiguration) -> RulesByPoint:
    """Return each point's ``report`` rule, which holds for sinks without a ``report`` of their own.

    By device and point name. Points with the rule ``every`` are left out.
    """
    return {
        (device.name, point.name): point.reporting
        for device in configuration.devices.values()
        for point in device.points
        if point.reporting.when != _EVERY
    }


def points_of(configuration: CollectorConfiguration) -> dict[tuple[str, str], Point]:
    """Return all points of a configuration, by pair of device name and point name."""
    return {(device.name, point.name): point for device in configuration.devices.values() for point in device.points}
