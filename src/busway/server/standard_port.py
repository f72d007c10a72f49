"""Adds a listener on the standard port 502 beside those on other ports (Messaging on TCP/IP V1.0b §4.2.1).

Pure: knows the settings of listeners; opens none.

1. Option ``standard_port`` True: port 502 is added beside each ``tcp://`` listener; the start fails if it cannot be
   opened.
2. None: port 502 is added beside the listeners that other hosts can reach; if it cannot be opened, the server only logs
   that, because ports below 1024 belong to privileged programs. It is not added for a loopback address, which no other
   host can reach, nor for a port that the system chose (0), whose clients are told of the port.
3. It is not added for a host where a listener has port 502 already.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import replace

from ..codes import DEFAULT_TCP_PORT
from ..options.endpoints import EVERY_ADDRESS
from .listener_settings import ListenerSettings


def with_standard_port(wanted: Sequence[ListenerSettings], choice: bool | None) -> list[ListenerSettings]:
    """Return the listeners, followed by those on port 502 that the option ``standard_port`` adds.

    Args:
        wanted: the listeners as they were configured.
        choice: the option. True adds port 502, and the start fails if it cannot be opened. False does not add it. None
            adds it if other hosts can reach the listener and its port is not 0; it is then optional.
    """
    found = list(wanted)
    if choice is False:
        return found
    taken = {one.endpoint.host for one in wanted if _is_plain(one) and one.endpoint.port == DEFAULT_TCP_PORT}
    for one in wanted:
        host, port = one.endpoint.host, one.endpoint.port
        if not _is_plain(one) or host in taken or taken & EVERY_ADDRESS:
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
