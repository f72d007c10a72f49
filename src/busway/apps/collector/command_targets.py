"""Finds points of a running collector for commands to write, and their last values.

Knows the configuration, pollers and last values; decides nothing.
"""

from collections.abc import Callable

from ...errors import ConfigError
from .commands.command import OldValue
from .commands.runner import NoSuchPoint, NotPolledNow, WriteTarget
from .configuration import CollectedDevice, CollectorConfiguration
from .poller import LinkPoller
from .samples import NANOSECONDS, quality_of
from .sinks.prometheus import LastValues


class CollectedTargets:
    """Finds the points of a running collector that commands are to write.

    Args:
        configuration: returns the present configuration.
        poller_of: returns the poller of a device; raises `ConfigError` if the device is not polled.
        values: the last stored sample of each point.
        plant: returns the configuration of a whole fleet, of which ``configuration`` is the part that this collector
            polls now; None for a collector that works alone.
    """

    def __init__(
        self,
        configuration: Callable[[], CollectorConfiguration],
        poller_of: Callable[[str], LinkPoller],
        values: LastValues,
        plant: Callable[[], CollectorConfiguration] | None = None,
    ) -> None:
        self._configuration, self._poller_of, self._values = configuration, poller_of, values
        self._plant = plant or configuration

    def target(self, device: str, point: str) -> WriteTarget:
        """Return the point to write, and the poller of its link.

        Raises:
            NoSuchPoint: there is no such device or point.
            NotPolledNow: another collector of the fleet polls the link, or the link is being stopped or begun.
        """
        configuration = self._configuration()
        found = configuration.devices.get(device)
        if found is None and device in self._plant().devices:
            link = self._plant().devices[device].link
            raise NotPolledNow(f"link {link} of {device} is not polled by this collector, but by another of the fleet")
        if found is None:
            raise NoSuchPoint(f"there is no device {device!r}")
        named = next((each for each in found.points if each.name == point), None)
        if named is None:
            raise NoSuchPoint(f"there is no point {point!r} of {device}")
        try:
            poller = self._poller_of(device)
        except ConfigError as error:  # it ended, and is not begun yet
            raise NotPolledNow(f"the link of {device} is not polled at this moment") from error
        if poller.is_finishing:  # what it polls is what the configuration before said
            raise NotPolledNow(f"the link of {device} is not polled at this moment")
        derived = poller.devices[device].derived
        is_absent = bool(named.exists) and derived is not None and named in derived.absent()
        return WriteTarget(
            named, poller, found.rules, is_broadcast=_obeys_broadcasts(self._plant(), found), is_absent=is_absent
        )

    def last(self, device: str, point: str) -> OldValue | None:
        """Return the last stored value of a point, with its quality and time; None if there is no sample of it.

        The quality is the one to show now (`LastValues.last`): it is no longer good if the device is not read, the
        value is held, or the store cannot be written. The time is seconds since 1970 UTC.
        """
        found = self._values.last(device, point)
        if found is None:
            return None
        value, reason, time = found
        return OldValue(value, quality_of(reason).label, time / NANOSECONDS)


def _obeys_broadcasts(configuration: CollectorConfiguration, device: CollectedDevice) -> bool:
    """Whether a write to a device is a broadcast: its unit is 0, and several units can receive it.

    Without MBAP framing, unit 0 always is a broadcast. With it, unit 0 can be the one device behind an address: it is a
    broadcast only if the configuration has units other than 0 and 255 on this or another link to the same address.
    """
    if device.unit != 0:
        return False
    endpoint = configuration.links[device.link].settings.endpoint
    return endpoint.framing != "mbap" or any(
        other.unit not in (0, 255) and configuration.links[other.link].settings.endpoint.url == endpoint.url
        for other in configuration.devices.values()
    )
