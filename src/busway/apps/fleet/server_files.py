"""Configuration files of NATS servers for a fleet, as text: one file for each server, and the accounts they share.

Pure: knows what nats-server reads, and public keys; secrets are made elsewhere (`busway.cli.fleet_servers`).

1. No secret is in these files. Users are known by public keys (nkeys); servers know each other by certificates.
2. Words that an older server refuses are left out: ``sync_interval`` is for 2.10 and newer.
3. An edge site is a server of its own whose streams are a domain with the name of its zone. It connects to the centre
   as a leaf node, for the account of its zone alone. nats-server 2.9 knows leaf nodes by passwords, not by nkeys:
   these are in files of their own (`LEAFS_FILE`, `site_secret_text`).
4. Each zone has an account of its own, so subjects and streams of one zone do not exist for another.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from .server_rights import STATUS, Permissions, permissions

SYNCS: Final = (2, 10)
"""The first version that can be told to sync each message to the disk before it is acknowledged."""
CLIENT_PORT, ROUTE_PORT, LEAF_PORT = 4222, 6222, 7422
ANSWER_WITHIN: Final = "1h"
"""For so long may a collector answer a command."""
ACCOUNTS_FILE: Final = "accounts.conf"
LEAFS_FILE: Final = "leafs.conf"
"""Secret: the passwords of edge sites, for servers of the centre."""


@dataclass(frozen=True, slots=True)
class NatsServer:
    """One server of a fleet's coordinator.

    Attributes:
        name: unique among the servers; also the name of its certificate.
        host: on which it listens, and by which the others reach it.
        port: for clients.
        route_port: for other servers of its cluster.
        leaf_port: for edge sites.
    """

    name: str
    host: str
    port: int = CLIENT_PORT
    route_port: int = ROUTE_PORT
    leaf_port: int = LEAF_PORT


@dataclass(frozen=True, slots=True)
class NatsServerOptions:
    """What all servers of a fleet have alike.

    Attributes:
        version: of nats-server, the first two numbers.
        store: the folder of the streams; each server has one of its own there, by its name.
        tls: the folder of certificates: for each server ``NAME.pem`` and ``NAME.key``, and ``ca.pem``. None for no
            encryption.
        cluster: the name of the cluster, where there are several servers.
    """

    version: tuple[int, int] = (2, 9)
    store: str = "/var/lib/nats"
    tls: str | None = "/etc/nats/tls"
    cluster: str = "busway"


def server_text(
    server: NatsServer, servers: Sequence[NatsServer], options: NatsServerOptions, *, has_sites: bool = False
) -> str:
    """Return the configuration of one server of a cluster, or of the only one."""
    lines = _common(server, options)
    if len(servers) > 1:
        routes = ", ".join(f'"nats://{each.host}:{each.route_port}"' for each in servers)
        lines += [
            "cluster {",
            f"  name: {_quoted(options.cluster)}",
            f'  listen: "{server.host}:{server.route_port}"',
            f"  routes: [{routes}]",
            *("  " + line for line in _tls(server, options)),
            "}",
        ]
    if has_sites:
        lines += [
            "leafnodes {",
            f'  listen: "{server.host}:{server.leaf_port}"',
            *("  " + line for line in _tls(server, options)),
            f'  authorization {{ include "./{LEAFS_FILE}" }}',
            "}",
        ]
    lines.append(f'include "./{ACCOUNTS_FILE}"')
    return "\n".join(lines) + "\n"


def site_text(site: NatsServer, options: NatsServerOptions) -> str:
    """Return the configuration of the server of an edge site, whose name is that of its zone."""
    lines = _common(site, options, site.name)
    lines += [f'include "./{site.name}-leaf.conf"', f'include "./{site.name}-{ACCOUNTS_FILE}"']
    return "\n".join(lines) + "\n"


def site_secret_text(site: NatsServer, centre: Sequence[NatsServer], options: NatsServerOptions, password: str) -> str:
    """Return how an edge site connects to the centre; a secret."""
    scheme = "nats-leaf" if options.tls is None else "tls"
    urls = ", ".join(f'"{scheme}://{site.name}:{password}@{each.host}:{each.leaf_port}"' for each in centre)
    tls = "" if options.tls is None else f", tls {{ ca_file: {_quoted(f'{options.tls}/ca.pem')} }}"
    return f'leafnodes {{ reconnect: 2, remotes: [{{ urls: [{urls}], account: "zone-{site.name}"{tls} }}] }}\n'


def leafs_text(passwords: Mapping[str, str]) -> str:
    """Return the users by which edge sites connect to the centre, each for the account of its zone; a secret."""
    users = (
        f'  {{ user: "{site}", password: "{password}", account: "zone-{site}" }}'
        for site, password in passwords.items()
    )
    return "\n".join(["users = [", *users, "]"]) + "\n"


def _common(server: NatsServer, options: NatsServerOptions, domain: str | None = None) -> list[str]:
    return [
        f"# nats-server {options.version[0]}.{options.version[1]}, made by busway fleet server-config. No secrets.",
        f"server_name: {_quoted(server.name)}",
        f'listen: "{server.host}:{server.port}"',
        "jetstream {",
        f"  store_dir: {_quoted(f'{options.store}/{server.name}')}",
        *([] if domain is None else [f"  domain: {_quoted(domain)}"]),
        *(["  sync_interval: always"] if options.version >= SYNCS else []),
        "}",
        *_tls(server, options),
    ]


def accounts_text(
    zones: Mapping[str, Mapping[str, str]], status_key: str, sites: Mapping[str, Mapping[str, str]] | None = None
) -> str:
    """Return the accounts that all servers share.

    Args:
        zones: by name of a zone and role, the public key of the user.
        status_key: the public key of the user of the system account.
        sites: the same of zones of edge sites, at the centre.
    """
    lines = [
        "# Accounts of all servers, made by busway fleet server-config. Remove a user and reload to revoke it.",
        "system_account: SYS",
        "accounts {",
        "  SYS {",
        "    users = [",
        *_user("status", status_key, STATUS),
        "    ]",
        "  }",
    ]
    for zone, keys in {**zones, **(sites or {})}.items():
        is_site = zone in (sites or {})
        lines += [f'  "zone-{zone}" {{', "    jetstream: enabled", "    users = ["]
        for role, key in keys.items():
            lines += _user(f"{zone}, {role}", key, permissions(role, zone, is_site=is_site))
        lines += ["    ]", "  }"]
    return "\n".join([*lines, "}"]) + "\n"


def _tls(server: NatsServer, options: NatsServerOptions) -> list[str]:
    if options.tls is None:
        return []
    return [
        "tls {",
        f"  cert_file: {_quoted(f'{options.tls}/{server.name}.pem')}",
        f"  key_file: {_quoted(f'{options.tls}/{server.name}.key')}",
        f"  ca_file: {_quoted(f'{options.tls}/ca.pem')}",
        "}",
    ]


def _user(name: str, key: str, rights: Permissions) -> list[str]:
    lines = [f"      {{ # {name}", f"        nkey: {key}", "        permissions: {"]
    lines += [f"          publish: [{', '.join(map(_quoted, rights.publish))}]"]
    lines += [f"          subscribe: [{', '.join(map(_quoted, rights.subscribe))}]"]
    if rights.answers:
        lines.append(f'          allow_responses: {{ max: 1, expires: "{ANSWER_WITHIN}" }}')
    return [*lines, "        }", "      }"]


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
