"""The part of a plant's configuration that one collector of a fleet works on, and what its links need."""

from collections.abc import Container, Mapping
from dataclasses import replace

from ...client.settings import link_settings, options_of
from ...config.links import NamedLink
from ...errors import ConfigError
from ..collector.configuration import CollectorConfiguration
from ..server.configuration import Configuration
from .lease_times import LeaseTimes


def restricted(configuration: CollectorConfiguration, links: Container[str]) -> CollectorConfiguration:
    """Return a copy of a plant's configuration with only some of its links, and the devices on them; all else stays.

    Args:
        configuration: the configuration of the whole plant.
        links: names of the links that stay.
    """
    common: Configuration = replace(
        configuration.common,
        links={name: link for name, link in configuration.links.items() if name in links},
    )
    devices = {name: device for name, device in configuration.devices.items() if device.link in links}
    return replace(configuration, common=common, devices=devices)


def with_short_user_timeout(configuration: CollectorConfiguration) -> CollectorConfiguration:
    """Return a copy of a configuration in which no link has a ``user_timeout`` above its timeout for a reply.

    ``user_timeout`` is how long TCP repeats bytes that the device has not acknowledged. With the default of 30 s a
    request could still reach the device, once a cable is mended, after another collector has taken over the link.
    """
    links = {name: _link_with_short_user_timeout(link) for name, link in configuration.links.items()}
    return replace(configuration, common=replace(configuration.common, links=links))


def _link_with_short_user_timeout(link: NamedLink) -> NamedLink:
    settings = link.settings
    longest = max(settings.parameters.timeout, 0.1)
    now = settings.sockets.effective_user_timeout
    if "user_timeout" not in options_of(settings.endpoint) or (now is not None and now <= longest):
        return link
    options = {**link.options, "user_timeout": longest}
    return replace(link, options=options, settings=link_settings(link.url, options))


def longest_transaction(configuration: CollectorConfiguration, link: str) -> float:
    """Return the seconds from the permission of a transaction until none of its bytes can reach the device any more.

    The time to connect is included, and the time for which TCP repeats bytes that are not acknowledged; infinity if TCP
    repeats them without limit. A gateway on the way that queues requests adds to this time: its longest wait belongs to
    `LeaseTimes.guard`.

    Args:
        configuration: the configuration of the plant.
        link: name of one of its links.
    """
    settings = configuration.links[link].settings
    offered, timeout = options_of(settings.endpoint), settings.parameters.timeout
    connecting = settings.sockets.connect_timeout if "connect_timeout" in offered else 0.0
    repeating = settings.sockets.effective_user_timeout if "user_timeout" in offered else 0.0
    return connecting + max(timeout, float("inf") if repeating is None else repeating)


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
    """Return by name of each link how busy polling keeps it, in seconds of line time per second; at least 0.001.

    Args:
        configuration: the configuration whose links are returned.
        loads: the load of each link; links that are missing have no load.
    """
    return {name: max(0.001, loads.get(name, 0.0)) for name in configuration.links}
