"""The part of a plant's configuration that one collector of a fleet works on, and what its links need.

1. An endpoint has one owner, no matter how many links name it and how they spell it: a serial line has one master. All
   links to one endpoint are in one shard, that of the link whose name sorts first.
2. A serial port is a port of one machine: another machine has another line, or none, under the same path. Links to it
   name their hosts, unless all collectors are on one machine.
3. A gateway may hold a request in a queue and send it to the device later, also when its client has gone. The plant
   says for how long (``gateway_wait`` of a link); that time is a part of each transaction. Where links to one endpoint
   say different times, the longest counts for all, because all of them reach the same devices.
4. Commands for a link come on a subject with its name, in which some characters are replaced. So no two links may have
   one subject: the owner of the wrong one would answer, too, that nothing was sent.
5. A newer configuration reaches collectors one after the other, and one of them may refuse it. So no configuration may
   move an endpoint from one shard to another while a collector may live.
6. The lease of a shard says which of its devices are in maintenance. So no configuration may move such a device to
   another shard: the owner of that one would poll it.
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from ipaddress import IPv6Address, ip_address
from math import ceil, inf
from posixpath import normpath

from ...client.settings import link_settings, options_of
from ...config.links import NamedLink
from ...errors import ConfigError
from ..collector.configuration import CollectorConfiguration
from ..collector.sinks.nats import subject_token
from ..collector.sinks.sparkplug import SparkplugSink
from ..service.configuration import Configuration
from .lease_times import LONGEST_TTL, LeaseTimes
from .shards import links_by_shard


def restricted(configuration: CollectorConfiguration, links: Container[str]) -> CollectorConfiguration:
    """Return a copy of a plant's configuration with only some of its links and their devices; all else is the same.

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


def name_edge_nodes(configuration: CollectorConfiguration, member: str) -> None:
    """Put the name of this collector into the edge node's name of each Sparkplug sink; changes these sinks.

    Args:
        configuration: a configuration that is not in use yet.
        member: name of the collector.

    Raises:
        ConfigError: the name of an edge node has no ``{collector}``, so two collectors would be one edge node.
    """
    for name, (sink, _) in configuration.sinks.items():
        if isinstance(sink, SparkplugSink):
            try:
                sink.join(member)
            except ConfigError as error:
                raise ConfigError(error.message, file=configuration.name, key=f"sink.{name}.edge_node") from error


def with_short_user_timeout(configuration: CollectorConfiguration) -> CollectorConfiguration:
    """Return a copy of a configuration in which no link has a ``user_timeout`` above its timeout for a reply.

    A timeout below 0.1 s counts as 0.1 s here. Links without this option, such as serial ones, stay as they are.
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


@dataclass(frozen=True, slots=True)
class LinkTimes:
    """The parts of the time for which a request on one link can still reach the device, in seconds.

    Attributes:
        connecting: longest time to connect; 0 for a serial port.
        exchange: longest time after a frame was sent in which its reply is waited for or TCP may repeat the frame;
            infinity if TCP repeats bytes without limit.
        held: longest time for which a gateway behind the link may hold the request in its queue (rule 3).
    """

    connecting: float
    exchange: float
    held: float

    @property
    def after_sending(self) -> float:
        """Seconds from the sending of a frame until none of its bytes can reach the device any more."""
        return self.exchange + self.held

    @property
    def transaction(self) -> float:
        """Seconds from the permission of a transaction until none of its bytes can reach the device any more.

        A transaction of a poller is one request, or several that are sent together, without retries. The time that a
        frame waits for its turn on a serial line is not included: permission is asked again when the frame is sent,
        with `after_sending`.
        """
        return self.connecting + self.after_sending


def link_times(configuration: CollectorConfiguration) -> dict[str, LinkTimes]:
    """Return for each link of a plant, by name, for how long its requests can still reach the device."""
    held: dict[str, float] = {}
    for link, seconds in configuration.gateway_waits.items():
        for place in _places(configuration, link, configuration.hosts):
            held[place] = max(seconds, held.get(place, 0.0))
    found = {}
    for link, named in configuration.links.items():
        settings, offered = named.settings, options_of(named.settings.endpoint)
        repeating = settings.sockets.effective_user_timeout if "user_timeout" in offered else 0.0
        found[link] = LinkTimes(
            settings.sockets.connect_timeout if "connect_timeout" in offered else 0.0,
            max(settings.parameters.timeout, inf if repeating is None else repeating),
            max((held.get(place, 0.0) for place in _places(configuration, link, configuration.hosts)), default=0.0),
        )
    return found


def refuse_slow_links(configuration: CollectorConfiguration, times: LeaseTimes) -> None:
    """Raise `ConfigError` for the first link whose transactions can be too long for a lease (right to poll).

    `LinkTimes.transaction` must be at most `LeaseTimes.longest_transaction`, which is shorter than a lease.
    """
    longest = times.longest_transaction
    for name, each in link_times(configuration).items():
        if each.transaction > longest:
            held = f", {each.held:g} s of it in a gateway" if each.held else ""
            raise ConfigError(
                f"connecting and one transaction of link {name} may take {each.transaction:g} s{held}, and a lease of "
                f"{times.ttl:g} s leaves {longest:g} s: lower its timeout, connect_timeout or gateway_wait, or let "
                f"leases hold longer{_enough(each.transaction, times)}",
                file=configuration.name,
                key=f"link.{name}",
            )


def _enough(seconds: float, times: LeaseTimes) -> str:
    """Return a hint for an error, in brackets: how long leases must hold for transactions of ``seconds``.

    Empty if no permitted lease is long enough.
    """
    ttl = ceil(min(seconds * times.ttl / times.longest_transaction, LONGEST_TTL + 1))
    return f" (busway fleet apply --ttl {ttl}s)" if ttl <= LONGEST_TTL else ""


def costs_by_link(configuration: CollectorConfiguration, loads: Mapping[str, float]) -> dict[str, float]:
    """Return how busy polling keeps each link, in seconds of line time per second, at least 0.001; by name of the link.

    Args:
        configuration: the configuration whose links are returned.
        loads: seconds of line time per second for each link; links that are missing count as 0.
    """
    return {name: max(0.001, loads.get(name, 0.0)) for name in configuration.links}


def links_of_shards(
    configuration: CollectorConfiguration, shards: int, hosts: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[str]]:
    """Return the names of the links in each shard, by name of the shard; shards without links are left out.

    Args:
        configuration: the configuration of the whole plant.
        shards: how many shards the zone has, 1…1024.
        hosts: by name of the link, the hosts that can reach it; links that are missing have the hosts of the
            configuration.
    """
    shown = {**configuration.hosts, **(hosts or {})}
    firsts = _first_links(configuration, shown)
    by_shard = links_by_shard(((first, shown.get(first, ())) for first in dict.fromkeys(firsts.values())), shards)
    shard_of_first = {first: shard for shard, links in by_shard.items() for first in links}
    found: dict[str, list[str]] = {}
    for link, first in firsts.items():
        found.setdefault(shard_of_first[first], []).append(link)
    return found


def refuse_two_owners(configuration: CollectorConfiguration) -> None:
    """Raise `ConfigError` if two links to one endpoint have different hosts: two collectors could own them (rule 1)."""
    hosts = configuration.hosts
    for link, first in _first_links(configuration, hosts).items():
        if list(hosts.get(link, ())) != list(hosts.get(first, ())):
            endpoint = configuration.links[link].settings.endpoint.url
            raise ConfigError(
                f"links {first} and {link} are one endpoint, {endpoint}, with different hosts: two collectors would "
                "poll it; give both the same",
                file=configuration.name,
                key=f"link.{link}",
            )


def refuse_ports_of_any_host(configuration: CollectorConfiguration) -> None:
    """Raise `ConfigError` for a link to a serial port that does not name the host of the port (rule 2)."""
    for name, link in configuration.links.items():
        if link.settings.endpoint.carrier == "serial" and name not in configuration.hosts:
            raise ConfigError(
                f"{link.settings.endpoint.url} is a port of one machine, and any collector of the zone could take it: "
                f'name the machine, hosts = ["NAME"]',
                file=configuration.name,
                key=f"link.{name}",
            )


def refuse_links_of_one_subject(configuration: CollectorConfiguration) -> None:
    """Raise `ConfigError` if two links would take commands on one subject of NATS (rule 4)."""
    found: dict[str, str] = {}
    for name in configuration.links:
        other = found.setdefault(subject_token(name), name)
        if other != name:
            raise ConfigError(
                f"links {other} and {name} would take commands on one subject, that of {subject_token(name)}: rename "
                "one",
                file=configuration.name,
                key=f"link.{name}",
            )


def refuse_moved_endpoints(before: CollectorConfiguration, after: CollectorConfiguration) -> None:
    """Raise `ConfigError` if a new configuration could move an endpoint from one shard to another (rule 5).

    It could if another of the endpoint's links sorts first, or if the hosts of that link change. Endpoints that only
    one of the configurations has are not compared.

    Args:
        before: the configuration that collectors may work with now.
        after: the new configuration.
    """
    owners = [
        {
            place: (first, tuple(each.hosts.get(first, ())))
            for link, first in _first_links(each, each.hosts).items()
            for place in _places(each, link, each.hosts)
        }
        for each in (before, after)
    ]
    for place, (first, hosts) in owners[1].items():
        owned = owners[0].get(place, (first, hosts))
        if owned != (first, hosts):
            raise ConfigError(
                f"{place} is that of link {_shown(*owned)}, and would be that of link {_shown(first, hosts)}: two "
                "collectors could poll it until all have taken the file. Apply one without it first, and this one when "
                "busway fleet status shows that revision for all collectors",
                file=after.name,
                key=f"link.{first}",
            )


def refuse_moved_maintenance(
    before: CollectorConfiguration, after: CollectorConfiguration, maintained: Iterable[str]
) -> None:
    """Raise `ConfigError` if a new configuration moves a device in maintenance from one shard to another (rule 6).

    Devices that only one of the configurations has are not looked at.

    Args:
        before: the configuration of the zone until now.
        after: the new configuration.
        maintained: names of the devices in maintenance.
    """
    for device in sorted(maintained):
        if device in before.devices and device in after.devices:
            first, hosts = _owning_link(before, device)
            moved = _owning_link(after, device)
            if moved != (first, hosts):
                raise ConfigError(
                    f"{device} is in maintenance, and would go from link {_shown(first, hosts)} to link "
                    f"{_shown(*moved)}: the collector of that one would poll it. End the maintenance first",
                    file=after.name,
                    key=f"device.{device}",
                )


def _owning_link(configuration: CollectorConfiguration, device: str) -> tuple[str, tuple[str, ...]]:
    """Return the link after which the shard of a device is named, and its hosts."""
    first = _first_links(configuration, configuration.hosts)[configuration.devices[device].link]
    return first, tuple(configuration.hosts.get(first, ()))


def _shown(link: str, hosts: Sequence[str]) -> str:
    return f"{link} on {' and '.join(hosts)}" if hosts else link


def _first_links(configuration: CollectorConfiguration, hosts: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return for each link, by name, which name sorts first among all links to its endpoint."""
    first_at: dict[str, str] = {}
    found: dict[str, str] = {}
    for link in sorted(configuration.links):
        places = _places(configuration, link, hosts)
        first = next((first_at[place] for place in places if place in first_at), link)
        found[link] = first
        for place in places:
            first_at.setdefault(place, first)
    return {link: found[link] for link in configuration.links}


def _places(configuration: CollectorConfiguration, link: str, hosts: Mapping[str, Sequence[str]]) -> list[str]:
    """Return what a link leads to, as texts: ``HOST:PORT``, or for a serial port, ``PATH of HOST`` for each host.

    A serial port without hosts is its path alone.
    """
    endpoint = configuration.links[link].settings.endpoint
    if endpoint.carrier == "serial":
        path = normpath(endpoint.path)
        return [f"{path} of {host}" for host in hosts.get(link, ())] or [path]
    return [f"{_one_spelling(endpoint.host)}:{endpoint.port}"]


def _one_spelling(host: str) -> str:
    """Return a host name or address in one spelling, so that equal hosts are equal texts; empty means ``127.0.0.1``.

    Lower case, without a dot at the end; an IPv6 address in its shortest form, one that holds an IPv4 address as that.
    """
    name = host.lower().removesuffix(".") or "127.0.0.1"
    try:
        address = ip_address(name.replace("%25", "%"))
    except ValueError:
        return name
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return (mapped or address).compressed
