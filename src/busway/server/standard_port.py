"""Adds a listener on the standard port 502 beside those on other ports (Messaging on TCP/IP V1.0b §4.2.1).

Pure: knows the settings of listeners; opens none.

1. Asked for by name (True), it is added beside each ``tcp://`` listener, and must be had.
2. Left to us (None), it is added beside those that the network can reach, and where it cannot be had the server only
   says so: below 1024 a port belongs to privileged programs. A loopback address has no clients elsewhere that could
   look there, and a port that the system chose (0) is for clients that are told of it.
3. Where a listener has it already, there is none beside it.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import replace

from ..codes import DEFAULT_TCP_PORT
from .listener_settings import ListenerSettings

_EVERYWHERE = frozenset({"", "0.0.0.0", "::"})


def with_standard_port(wanted: Sequence[ListenerSettings], choice: bool | None) -> list[ListenerSettings]:
    """Return the listeners, and those on port 502 that the option ``standard_port`` adds.

    Args:
        wanted: the listeners as they were asked for.
        choice: True adds port 502, and it must be had; False does not; None adds it where the network can reach the
            listener, and does without it where it cannot be had.
    """
    found = list(wanted)
    if choice is False:
        return found
    taken = {one.endpoint.host for one in wanted if _is_plain(one) and one.endpoint.port == DEFAULT_TCP_PORT}
    for one in wanted:
        host, port = one.endpoint.host, one.endpoint.port
        if not _is_plain(one) or host in taken or taken & _EVERYWHERE:
            continue
        if choice is None and (not port or _is_loopback(host)):
            continue
        taken.add(host)
        endpoint = replace(one.endpoint, port=DEFAULT_TCP_PORT)
        found.append(replace(one, endpoint=endpoint, is_optional=choice is None, beside=one.endpoint.url))
    return found


def _is_plain(one: ListenerSettings) -> bool:
    return one.endpoint.scheme == "tcp"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False
