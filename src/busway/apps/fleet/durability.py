"""Finds out what the NATS servers of a zone keep when they lose power: whether they sync, and how many have an entry.

Knows what nats-server says of itself; the protocol is nats-py's. It decides nothing: an operator has to know.

1. nats-server before 2.10 acknowledges before it syncs. Later ones do as well, unless ``sync_interval`` is ``always``.
2. Whether a later one has that setting can be asked only with the credentials of its system account. Without them it is
   not known, and the user is told so.
"""

import asyncio
import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Final

from ...errors import ConfigError
from .coordinators.nats import NatsCoordinator, connect_nats
from .coordinators.opening import CoordinatorOptions
from .server_files import SYNCS

FEW: Final = 3
"""Fewest replicas with which a cluster can lose one server and go on."""
ANSWERS_WITHIN: Final = 1.0
"""Seconds for which answers of servers are collected: it is not known how many servers there are."""


@dataclass(frozen=True, slots=True)
class ServerDurability:
    """One NATS server, and whether it writes to its disk before it acknowledges.

    Attributes:
        name: name of the server.
        version: version of nats-server, such as ``2.9.10``.
        syncs: True if the server writes to its disk before it acknowledges, False if after; None if that is not known.
    """

    name: str
    version: str
    syncs: bool | None

    @property
    def sentence(self) -> str:
        """A sentence that says whether this server writes to its disk (syncs) before it acknowledges."""
        does = {
            True: "syncs before it acknowledges",
            False: "acknowledges before it syncs to the disk",
            None: "is not known to sync: --system-credentials FILE asks it",
        }
        return f"nats-server {self.name} ({self.version}) {does[self.syncs]}"


async def server_durability(
    table: NatsCoordinator, url: str, options: CoordinatorOptions, system: str | None
) -> list[ServerDurability]:
    """Return for each NATS server of a zone whether it writes to its disk before it acknowledges; sorted by name.

    Without credentials for the system account the result has only the connected server, and it is not known whether one
    of version 2.10 or newer syncs.

    Args:
        table: the open coordinator.
        url, options: URL and options with which the coordinator was opened.
        system: path of the credentials of a user of the system account, such as ``status.nk``; None for none.

    Raises:
        ConfigError: the file ``system`` cannot be used, or no server answers its user.
        CoordinatorDown: no server could be reached with these credentials.
    """
    if system is None:
        version = table.client.connected_server_version
        number = f"{version.major}.{version.minor}.{version.patch}"
        return [_of(str(table.client._server_info.get("server_name", "")), number, None)]
    scheme, _, hosts = url.partition("://")
    url = f"{scheme}://{','.join(each.rpartition('@')[2] for each in hosts.split(','))}"
    client = await connect_nats(url, replace(options, user=None, password=None, token=None, credentials=system))
    try:
        found = await _asked(client)
    finally:
        await client.close()
    if not found:
        raise ConfigError(f"{system} is no user of the system account: no server answers", key="--system-credentials")
    return sorted(found, key=lambda each: each.name)


def durability_warnings(servers: Sequence[ServerDurability], replicas: int, *, is_clustered: bool) -> list[str]:
    """Return warnings, one sentence each, about entries that would be lost with a server or in a power failure.

    Empty if there is nothing to warn of. A server that is not known to sync has a warning too.

    Args:
        servers: the NATS servers.
        replicas: number of servers that keep each entry.
        is_clustered: whether the servers are a cluster.
    """
    found = []
    if is_clustered and replicas < FEW:
        found.append(
            f"the table of the zone is on {replicas} of the servers of a cluster: where one is lost, no lease can be "
            f"renewed; apply with --replicas {FEW}, after 'nats stream edit' where it is there already"
        )
    for each in servers:
        if not each.syncs:
            on = "it alone has it" if replicas == 1 else f"{replicas} servers have it"
            found.append(f"{each.sentence}; {on}, and it is lost if {_loser(replicas)} power at once")
    return found


def _loser(replicas: int) -> str:
    return "that loses" if replicas == 1 else "most of them lose"


async def _asked(client: Any) -> list[ServerDurability]:
    errors = import_module("nats.errors")
    inbox = client.new_inbox()
    answers: list[ServerDurability] = []

    async def came(message: Any) -> None:
        found = decode_server(message.data)
        if found is not None:
            answers.append(found)

    subscription = await client.subscribe(inbox, cb=came)
    with contextlib.suppress(errors.Error, OSError, TimeoutError):
        await client.publish("$SYS.REQ.SERVER.PING.JSZ", b"{}", reply=inbox)
        await client.flush(timeout=5)
        await asyncio.sleep(ANSWERS_WITHIN)
        await subscription.unsubscribe()
    return answers


def decode_server(data: bytes) -> ServerDurability | None:
    """Decode a server's answer to the request ``JSZ`` of the system account; None if the answer cannot be decoded."""
    try:
        answer = json.loads(data)
        server, config = answer["server"], answer["data"].get("config") or {}
        return _of(str(server["name"]), str(server["ver"]), bool(config.get("sync_always", False)))
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def _of(name: str, version: str, syncs: bool | None) -> ServerDurability:
    try:
        major, minor = (int(part) for part in version.split(".")[:2])
    except ValueError:
        return ServerDurability(name, version, None)
    return ServerDurability(name, version, False if (major, minor) < SYNCS else syncs)
