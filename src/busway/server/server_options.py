"""Applies the preset of a server, such as ``strict``, to its options and listeners.

Knows the listeners of a server and where each of them takes options. Of the options it knows only
``single_adu_segments``, which ``strict`` sets in the limits of a listener; what others mean, their declarations tell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..options.accepted_options import SERVERS, AcceptedOptions, ChosenOptions
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.presets import OPTION, Preset, preset_of
from .listener import Listener

ListenerLike = str | Endpoint | Listener


def with_server_preset(
    places: Sequence[ListenerLike], options: Mapping[str, object]
) -> tuple[list[ListenerLike], ChosenOptions]:
    """Return listeners and options with the preset applied that ``options`` names, if any.

    Args:
        places: the listeners: URLs or `Listener` objects.
        options: options of the server by name; ``preset`` may be among them.

    Raises:
        ConfigError: there is no such preset or option, or an option contradicts the preset.
    """
    chosen = AcceptedOptions.of(*SERVERS).chosen(options)
    if preset_of(options.get(OPTION)) is Preset.STRICT:
        return [_strict(one) for one in places], chosen
    return list(places), chosen


def _strict(place: ListenerLike) -> ListenerLike:
    """Return one listener with the preset ``strict`` applied.

    The preset is added to its URL for TLS, RTU and ASCII, unless the URL names a preset; the limits of a `Listener`, if
    it has its own, get ``single_adu_segments``.
    """
    listener = place if isinstance(place, Listener) else Listener(place)
    endpoint = parse_endpoint(listener.endpoint)
    if (endpoint.framing != "mbap" or endpoint.carrier == "tls") and OPTION not in endpoint.options:
        endpoint = replace(endpoint, options={**endpoint.options, OPTION: Preset.STRICT.value})
    limits = listener.limits and replace(listener.limits, single_adu_segments=True)
    return replace(listener, endpoint=endpoint, limits=limits)
