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


def with_short_user_timeout(configuration: CollectorConfiguration) -> CollectorConfiguration:
    """Return a configuration whose connections forget a request that is not acknowledged when its time is over.

    The system would repeat it for `SocketParameters.user_timeout`, 30 s, also after this process has ended or given the
    connection up: a cable that is mended meanwhile brings it to a device that another collector owns by then.
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
    """Return how long a transaction may take, from its permission until none of it can reach the device.

    It may have to connect first; a poller repeats nothing. What a line waits before its frame leaves is not counted:
    permission is asked again then, with `longest_after_sending`.
    """
    settings = configuration.links[link].settings
    connecting = settings.sockets.connect_timeout if "connect_timeout" in options_of(settings.endpoint) else 0.0
    return connecting + longest_after_sending(configuration, link)


def longest_after_sending(configuration: CollectorConfiguration, link: str) -> float:
    """Return how long a transaction may take from the sending of its frame until none of it can reach the device.

    The system repeats what is not acknowledged. A gateway that keeps requests in a queue of its own adds to this: its
    longest wait belongs to the guard of the leases.
    """
    settings = configuration.links[link].settings
    repeating = settings.sockets.effective_user_timeout if "user_timeout" in options_of(settings.endpoint) else 0.0
    return max(settings.parameters.timeout, float("inf") if repeating is None else repeating)


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
