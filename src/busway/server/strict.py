"""Presets of a server: set its own options, those of its serial lines, and whether it listens on port 502.

Knows the listeners of a server and where each of them takes options; knows not what these mean.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from ..codes import DEFAULT_TCP_PORT
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.presets import OPTION, STRICT_SERVERS, Preset, preset_of, with_preset
from ..options.text import converted
from .listener import Listener

STANDARD_PORT: Final = "standard_port"
"""Name of the option that makes a server listen on port 502 beside other ports."""

Place = str | Endpoint | Listener


def with_server_preset(
    places: Sequence[Place], options: dict[str, Any], *, takes: Sequence[str]
) -> tuple[list[Place], dict[str, Any]]:  # Any: options of different types
    """Listeners and options as the preset among the options makes them; as they were where there is none.

    Args:
        places: where the server listens.
        options: its options by name, ``preset`` and ``standard_port`` among them or not; neither is among what is
            given back.
        takes: the options that it has.

    Raises:
        ConfigError: there is no such preset, or an option contradicts it.
    """
    preset = preset_of(options.get(OPTION))
    completed: dict[str, Any] = with_preset(options, STRICT_SERVERS, takes=(*takes, STANDARD_PORT))
    found = list(places)
    if preset is Preset.STRICT:
        found = [_strict(one) for one in found]
    if converted(STANDARD_PORT, completed.pop(STANDARD_PORT, False), bool):
        found += _standard_ports(found)
    return found, completed


def _strict(place: Place) -> Place:
    """A listener on a line or over TLS takes the preset in its URL; own limits keep to one frame for each segment."""
    listener = place if isinstance(place, Listener) else Listener(place)
    endpoint = parse_endpoint(listener.endpoint)
    if (endpoint.framing != "mbap" or endpoint.carrier == "tls") and OPTION not in endpoint.options:
        endpoint = replace(endpoint, options={**endpoint.options, OPTION: Preset.STRICT.value})
    limits = listener.limits and replace(listener.limits, single_adu_segments=True)
    return replace(listener, endpoint=endpoint, limits=limits)


def _standard_ports(places: Sequence[Place]) -> list[Place]:
    """Listeners on 502, beside those on other ports (Messaging on TCP/IP V1.0b §4.2.1): one for each host."""
    listeners = [one if isinstance(one, Listener) else Listener(one) for one in places]
    on_tcp = [(parse_endpoint(one.endpoint), one) for one in listeners]
    on_tcp = [(endpoint, one) for endpoint, one in on_tcp if endpoint.scheme == "tcp"]
    there = {endpoint.host for endpoint, _ in on_tcp if endpoint.port == DEFAULT_TCP_PORT}
    if "" in there:
        return []  # on every interface already
    wanted: dict[str, Place] = {}
    for endpoint, listener in on_tcp:
        if endpoint.host not in there:
            wanted.setdefault(endpoint.host, replace(listener, endpoint=replace(endpoint, port=DEFAULT_TCP_PORT)))
    return list(wanted.values())
