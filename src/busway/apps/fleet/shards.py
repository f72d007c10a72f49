"""Shards: the groups of links that move between the collectors of a zone as a whole.

Pure; knows names only. A lease costs the coordinator a message every few seconds, so links are owned in groups. The
group of a link follows from its name alone: every collector finds the same one without asking.
"""

import hashlib
import re
from collections.abc import Iterable, Sequence
from typing import Final

from ...errors import ConfigError

FEWEST: Final = 1
MOST: Final = 1024
"""Shards in one zone. Each lease is renewed by itself, and all collectors of the zone see every renewal."""
PINNED: Final = "pin."
_KEYS: Final = "-commands"
LONGEST_ZONE: Final = 63 - len(_KEYS)
"""Characters in the name of a zone that collectors run in."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")


def shard_of(link: str, shards: int) -> str:
    """Return the name of the shard (group of links) that a link belongs to: ``0000`` … ``1023``.

    With another number of shards as few links as possible move: n of n + 1 stay where a shard is added.

    Args:
        link: the name of the link.
        shards: how many shards the zone has, 1…1024.
    """
    # Jump consistent hashing (Lamping and Veach 2014): moves as few links as rendezvous hashing, in log n steps.
    key = int.from_bytes(hashlib.blake2b(link.encode(), digest_size=8).digest(), "big")
    found, next_one = 0, 0
    while next_one < shards:
        found = next_one
        key = (key * 2862933555777941757 + 1) & 0xFFFF_FFFF_FFFF_FFFF
        next_one = int((found + 1) * (1 << 31) / ((key >> 33) + 1))
    return f"{found:04d}"


def pinned_shard(hosts: Sequence[str]) -> str:
    """Return the name of the shard (group of links) for links that only these hosts can reach: ``pin.<first
    host>.<second>``.
    """
    return PINNED + ".".join(hosts)


def hosts_of(shard: str) -> tuple[str, ...]:
    """Return the hosts whose collectors may own a shard (group of links), the preferred one first; empty for all of the
    zone.
    """
    return tuple(shard.removeprefix(PINNED).split(".")) if shard.startswith(PINNED) else ()


def shard_names(shards: int) -> list[str]:
    """Return the names of all shards (groups of links) that any host may own."""
    return [f"{number:04d}" for number in range(shards)]


def links_by_shard(links: Iterable[tuple[str, Sequence[str]]], shards: int) -> dict[str, list[str]]:
    """Return links grouped by shard; shards without links are left out.

    Args:
        links: the name of each link, and the hosts that can reach it; no hosts where all collectors can.
        shards: how many shards the zone has, 1…1024.
    """
    found: dict[str, list[str]] = {}
    for link, hosts in links:
        found.setdefault(pinned_shard(hosts) if hosts else shard_of(link, shards), []).append(link)
    return found


def checked_zone(zone: str) -> str:
    """Return the name of a zone after checking it: the keys of its commands are in a zone of a longer name, too.

    Raises `ConfigError`.
    """
    if len(checked_name(zone, "zone")) > LONGEST_ZONE:
        raise ConfigError(
            f"a zone has a name of up to {LONGEST_ZONE} characters, and {zone!r} has {len(zone)}", key="--zone"
        )
    return zone


def keys_zone(zone: str) -> str:
    """Return the name of the zone in which the coordinator has the keys of a zone's commands."""
    return zone + _KEYS


def checked_name(name: str, what: str) -> str:
    """Return the name of a zone, host or collector after checking it: it becomes part of keys. Raises `ConfigError`."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{what} {name!r} cannot be a name: use up to 63 letters, digits, - and _, the first a letter or digit",
            key=what,
        )
    return name
