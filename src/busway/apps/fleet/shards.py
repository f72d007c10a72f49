"""Shards: the groups of links that move between the collectors of a zone as a whole.

Pure; knows names only. A lease costs the coordinator a message every few seconds, so links are owned in groups. The
group of a link follows from its name alone, or from its hosts if only some hosts can reach it: every collector finds
the same group without asking.
"""

import hashlib
import re
from collections.abc import Iterable, Sequence
from typing import Final

from ...errors import ConfigError

FEWEST: Final = 1
MOST: Final = 1024
"""Most shards in one zone. Each shard has a lease of its own, and every collector of the zone reads each renewal."""
PINNED: Final = "pin."
_KEYS: Final = "-commands"
LONGEST_ZONE: Final = 63 - len(_KEYS)
"""Most characters in the name of a zone that collectors run in."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")


def shard_of(link: str, shards: int) -> str:
    """Return the name of the shard (group of links) that a link belongs to: ``0000`` … ``1023``.

    The result depends on the two arguments alone. If the number of shards changes, few links change their shard: with
    n + 1 shards instead of n, about n of every n + 1 links keep theirs.

    Args:
        link: name of the link.
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
    """Return the name of the shard (group of links) for links that only some hosts can reach: ``pin.HOST.HOST``.

    Args:
        hosts: names of the machines that can reach the links, the preferred one first.
    """
    return PINNED + ".".join(hosts)


def hosts_of(shard: str) -> tuple[str, ...]:
    """Return the names of the hosts whose collectors may own a shard (group of links), the preferred one first.

    Empty if collectors on any host may own the shard.
    """
    return tuple(shard.removeprefix(PINNED).split(".")) if shard.startswith(PINNED) else ()


def shard_names(shards: int) -> list[str]:
    """Return the names of a zone's shards (groups of links) that any host may own: ``0000``, ``0001`` and so on."""
    return [f"{number:04d}" for number in range(shards)]


def links_by_shard(links: Iterable[tuple[str, Sequence[str]]], shards: int) -> dict[str, list[str]]:
    """Return the names of the links in each shard, by name of the shard; shards without links are left out.

    Args:
        links: the name of each link, and the names of the hosts that can reach it; no hosts if all collectors can.
        shards: how many shards the zone has, 1…1024.
    """
    found: dict[str, list[str]] = {}
    for link, hosts in links:
        found.setdefault(pinned_shard(hosts) if hosts else shard_of(link, shards), []).append(link)
    return found


def checked_zone(zone: str) -> str:
    """Return the name of a zone of collectors unchanged; raise an error if the name is invalid.

    Raises:
        ConfigError: the name has invalid characters, or more than `LONGEST_ZONE`: `keys_zone` needs room for a suffix.
    """
    if len(checked_name(zone, "zone")) > LONGEST_ZONE:
        raise ConfigError(
            f"a zone has a name of up to {LONGEST_ZONE} characters, and {zone!r} has {len(zone)}", key="--zone"
        )
    return zone


def keys_zone(zone: str) -> str:
    """Return the name of the coordinator's zone that keeps the keys of another zone's commands: ``ZONE-commands``."""
    return zone + _KEYS


def checked_name(name: str, what: str) -> str:
    """Return a name unchanged if it can be part of a key of the shared table; raise an error otherwise.

    Args:
        name: name of a zone, host or collector: 1…63 letters, digits, ``-`` and ``_``, the first a letter or digit.
        what: the kind of thing that has the name, such as ``zone``; used in the error.

    Raises:
        ConfigError: the name is invalid.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{what} {name!r} cannot be a name: use up to 63 letters, digits, - and _, the first a letter or digit",
            key=what,
        )
    return name
