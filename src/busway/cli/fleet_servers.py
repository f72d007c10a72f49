"""``busway fleet server-config ZONE``: writes the configuration of NATS servers, and a secret for each role.

1. A secret is the seed of a key pair (nkey), made by the package nkeys. It is in a file of its own that only its owner
   can read (0600), and never printed. Servers get the public key only. An edge site has a password in such a file, too,
   which is also in the configuration of its own server and of the central ones.
2. An existing secret is used again, and never overwritten: remove the file to make a new one.
3. Other existing files are overwritten with ``--force`` only; all are looked for before the first is written.
"""

import os
import re
import secrets
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ..errors import ConfigError
from ..extras import require
from ..safe_files import read_safely, write_whole
from .output import say

if TYPE_CHECKING:
    from ..apps.fleet.server_files import NatsServer, NatsServerOptions

PRIVATE_FILE: Final = 0o600
PRIVATE_FOLDER: Final = 0o700
_SERVER: Final = re.compile(r"(?:([A-Za-z0-9_-]+)=)?([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:]+\])(?::(\d{1,5}))?")
_VERSION: Final = re.compile(r"(\d{1,3})\.(\d{1,3})(?:\..*)?")
_MOST_SEED: Final = 1024


def write_server_files(
    zones: str,
    out: str,
    servers: str,
    version: str,
    store: str,
    tls: str | None,
    *,
    force: bool,
    sites: str | None = None,
) -> None:
    """Write configuration files of NATS servers for zones, and the missing secrets; print the paths of all files.

    Secrets are a seed ``ZONE-ROLE.nk`` for each role of each zone, the seed ``status.nk`` of the user that asks servers
    for their state, and a password ``SITE-leaf.secret`` for each edge site. Existing secrets are used, and never
    overwritten.

    Args:
        zones: names of zones, separated by commas.
        out: the folder to write to; created if it is missing.
        servers: list for `parsed_servers`: ``[NAME=]HOST[:PORT],…``.
        version: version of nats-server: ``2.9``.
        store: path of the folder of the streams on each server.
        tls: path of the folder of certificates on each server; None for no encryption.
        force: whether existing configuration files may be overwritten.
        sites: edge sites, ``ZONE=HOST[:PORT],…``; each is a zone with a server of its own. None for no edge sites.

    Raises:
        ConfigError: an argument is invalid, or a file exists already or cannot be written.
        MissingExtra: the package nkeys is not installed.
    """
    from ..apps.fleet.server_files import (
        ACCOUNTS_FILE,
        LEAFS_FILE,
        NatsServerOptions,
        accounts_text,
        leafs_text,
        server_text,
        site_secret_text,
        site_text,
    )
    from ..apps.fleet.server_rights import RIGHTS
    from ..apps.fleet.shards import checked_name

    require("nkeys", "keys of users")
    names = [checked_name(each.strip(), "zone") for each in zones.split(",")]
    plans = parsed_servers(servers)
    edges = parsed_sites(sites, names)
    options = NatsServerOptions(parsed_version(version), store, tls)
    folder = Path(out)
    _make_folder(folder)
    files = [*(folder / f"{plan.name}.conf" for plan in plans), folder / ACCOUNTS_FILE]
    if edges:
        files.append(folder / LEAFS_FILE)
    for edge in edges:
        files += [folder / f"{edge.name}{kind}" for kind in (".conf", f"-{ACCOUNTS_FILE}", "-leaf.conf")]
    there = [path for path in files if path.exists()]
    if there and not force:
        raise ConfigError("is there already; --force writes over it, and keeps all seeds", file=str(there[0]))
    seeds = [folder / f"{zone}-{role}.nk" for zone in (*names, *(edge.name for edge in edges)) for role in RIGHTS]
    seeds.append(folder / "status.nk")
    public = {path: public_key(path) for path in seeds}
    status = public[folder / "status.nk"]

    def keys_of(zone: str, *roles: str) -> dict[str, dict[str, str]]:
        return {zone: {role: public[folder / f"{zone}-{role}.nk"] for role in roles or RIGHTS}}

    passwords = {edge.name: _password(folder / f"{edge.name}-leaf.secret") for edge in edges}
    zones_of = {zone: keys for name in names for zone, keys in keys_of(name).items()}
    sites_of = {zone: keys for edge in edges for zone, keys in keys_of(edge.name, "sink", "operator").items()}
    texts = [server_text(plan, plans, options, has_sites=bool(edges)) for plan in plans]
    texts.append(accounts_text(zones_of, status, sites_of))
    if edges:
        texts.append(leafs_text(passwords))
    for edge in edges:
        texts += [site_text(edge, options), accounts_text(keys_of(edge.name), status)]
        texts.append(site_secret_text(edge, plans, options, passwords[edge.name]))
    for path, text in zip(files, texts, strict=True):
        _write(path, text)
        print(path)
    for path in (*seeds, *(folder / f"{edge.name}-leaf.secret" for edge in edges)):
        print(path)
    _say_what_is_next(folder, plans, options)


def parsed_servers(text: str, *, any_number: bool = False) -> "list[NatsServer]":
    """Return the servers of a list ``[NAME=]HOST[:PORT],…``; those without a name are n1, n2, n3 by their position.

    PORT is that for clients, 4222 if it is missing; the ports for routes and for leaf nodes follow from it.

    Args:
        text: the list.
        any_number: whether any number of servers is allowed; otherwise one, three or five.

    Raises:
        ConfigError: a server is written wrongly, two have the same name or address, or their number is not allowed.
    """
    from ..apps.fleet.server_files import CLIENT_PORT, LEAF_PORT, ROUTE_PORT, NatsServer

    found: list[NatsServer] = []
    for number, each in enumerate(text.split(","), 1):
        match = _SERVER.fullmatch(each.strip())
        if match is None or int(match[3] or CLIENT_PORT) > 65_535 - LEAF_PORT + CLIENT_PORT:
            raise ConfigError(f"a server is [NAME=]HOST[:PORT], not {each.strip()!r}", key="--servers")
        port = int(match[3] or CLIENT_PORT)
        routes, leafs = port + ROUTE_PORT - CLIENT_PORT, port + LEAF_PORT - CLIENT_PORT
        found.append(NatsServer(match[1] or f"n{number}", match[2], port, routes, leafs))
    if len({each.name for each in found}) < len(found) or len({(e.host, e.port) for e in found}) < len(found):
        raise ConfigError("two servers have one name or one address", key="--servers")
    if len(found) not in (1, 3, 5) and not any_number:
        raise ConfigError(f"one server, or three or five that agree by majority, not {len(found)}", key="--servers")
    return found


def parsed_sites(text: str | None, zones: Sequence[str]) -> "list[NatsServer]":
    """Return the servers of edge sites from a list ``ZONE=HOST[:PORT],…``; the name of each is its zone.

    Args:
        text: the list; None for no sites.
        zones: names of the zones that are no edge sites.

    Raises:
        ConfigError: a site is written wrongly, or its zone is one of ``zones`` or named twice.
    """
    from ..apps.fleet.shards import checked_name

    found = [] if text is None else parsed_servers(text, any_number=True)
    for each, word in zip(found, (text or "").split(","), strict=False):
        if "=" not in word or each.name in zones:
            raise ConfigError(f"a site is ZONE=HOST[:PORT] with a zone of its own, not {word}", key="--sites")
        checked_name(each.name, "zone")
    return found


def parsed_version(text: str) -> tuple[int, int]:
    """Return major and minor number of a version of nats-server: (2, 9) for ``2.9`` or ``2.9.10``.

    Raises:
        ConfigError: the text is no version, or one below 2.9.
    """
    match = _VERSION.fullmatch(text)
    version = (int(match[1]), int(match[2])) if match else (0, 0)
    if version < (2, 9):
        raise ConfigError(f"a version of nats-server from 2.9 on, not {text!r}", key="--server-version")
    return version


def public_key(path: Path) -> str:
    """Return the public key for the seed of a NATS user in a file; a missing file is created with a new seed.

    Raises:
        ConfigError: the file cannot be created or read, or holds no seed of a user; the error names the file.
    """
    nkeys = import_module("nkeys")
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, PRIVATE_FILE)
    except FileExistsError:
        seed = _read_seed(path)
    except OSError as error:
        raise _refusal(path, "cannot be made", error) from error
    else:
        seed = bytearray(nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER))
        with os.fdopen(handle, "wb") as file:
            file.write(seed + b"\n")
            file.flush()
            os.fsync(file.fileno())
    if not seed.startswith(b"SU"):  # of a user, as nkeys writes it
        raise ConfigError("holds no seed of a user; remove it to make a new one", file=str(path))
    try:
        return str(nkeys.from_seed(seed).public_key.decode())
    except (nkeys.NkeysError, ValueError, TypeError) as error:
        raise ConfigError("holds no seed of a user; remove it to make a new one", file=str(path)) from error


def _password(path: Path) -> str:
    """Return the password of an edge site from its file; a missing file is created with a new password.

    Raises:
        ConfigError: the file cannot be created or read, or holds no password; the error names the file.
    """
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, PRIVATE_FILE)
    except FileExistsError:
        found = _read_seed(path).decode(errors="replace")
        if not re.fullmatch(r"[A-Za-z0-9_-]{20,}", found):
            raise ConfigError("holds no password; remove it to make a new one", file=str(path)) from None
        return found
    except OSError as error:
        raise _refusal(path, "cannot be made", error) from error
    found = secrets.token_urlsafe(32)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(found + "\n")
    return found


def _read_seed(path: Path) -> bytearray:
    return bytearray(read_safely(path, most=_MOST_SEED).strip())


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
    except OSError as error:
        raise _refusal(folder, "cannot be made", error) from error


def _write(path: Path, text: str) -> None:
    """Replace a file in one step, so that a server that reads it at the same time sees the old or the new contents.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        write_whole(path, text)
    except OSError as error:
        raise _refusal(path, "cannot be written", error) from error


def _refusal(path: Path, what: str, error: OSError) -> ConfigError:
    reason = error.strerror or str(error)
    return ConfigError(f"{what}: {reason[:1].lower()}{reason[1:]}", file=str(path))


def _say_what_is_next(folder: Path, plans: "Sequence[NatsServer]", options: "NatsServerOptions") -> None:
    say("the files *.nk are secrets: move each to the machine whose program has that role, and to no server")
    for plan in plans:
        say(f"{plan.name} ({plan.host}): nats-server -c {folder}/{plan.name}.conf, beside accounts.conf")
    if options.tls is None:
        say("without TLS every host of the network can read and change all of it: for tests on one machine")
    if options.version < (2, 10):
        say("nats-server 2.9 acknowledges before it syncs to the disk: take three servers on separate power")
