"""The part of a plant's configuration that one collector of a fleet works on, and what its links need."""

from collections.abc import Container, Mapping
from dataclasses import replace

from ...errors import ConfigError
from ..collector.configuration import CollectorConfiguration
from ..server.configuration import Configuration
from .lease_times import LeaseTimes


def restricted(configuration: CollectorConfiguration, links: Container[str]) -> CollectorConfiguration:
    """Return a copy of a configuration with only some of its links and their devices; all else stays.

    Args:
        configuration: the configuration of the whole plant.
        links: the names of the links that stay.
    """
    common: Configuration = replace(
        configuration.common,
        links={name: link for name, link in configuration.links.items() if name in links},
    )
    devices = {name: device for name, device in configuration.devices.items() if device.link in links}
    return replace(configuration, common=common, devices=devices)


def longest_transaction(configuration: CollectorConfiguration, link: str) -> float:
    """Return how long a transaction may take, from its permission until none of it can reach the device.

    It may have to connect first; a poller repeats nothing. A gateway that keeps requests in a queue of its own adds to
    this: its longest wait belongs to the guard of the leases.
    """
    settings = configuration.links[link].settings
    connecting = 0.0 if settings.line is not None else settings.sockets.connect_timeout
    return connecting + settings.parameters.timeout


def refuse_slow_links(configuration: CollectorConfiguration, times: LeaseTimes) -> None:
    """Raise `ConfigError` for a link whose transactions may last longer than a collector's right to poll it."""
    longest = times.ttl - times.guard - 2 * times.renew
    for name in configuration.links:
        seconds = longest_transaction(configuration, name)
        if seconds > longest:
            raise ConfigError(
                f"connecting and one transaction of link {name} may take {seconds:g} s, and a lease of {times.ttl:g} s "
                f"leaves {longest:g} s: lower its timeout or connect_timeout, or raise ttl",
                file=configuration.name,
                key=f"link.{name}",
            )


def costs_by_link(configuration: CollectorConfiguration, loads: Mapping[str, float]) -> dict[str, float]:
    """Return how busy polling keeps each link, in seconds per second, at least 0.001."""
    return {name: max(0.001, loads.get(name, 0.0)) for name in configuration.links}
