"""Configuration files of NATS servers for a fleet, as text: one file for each server, and the accounts they share.

Pure: knows what nats-server reads, and public keys; secrets are made elsewhere (`busway.cli.fleet_servers`).

1. No secret is in these files. Users are known by public keys (nkeys); servers know each other by certificates.
2. Words that an older server refuses are left out: ``sync_interval`` is for 2.10 and newer.
3. An edge site is a server of its own whose streams are a domain with the name of its zone. It connects to the centre
   as a leaf node, for the account of its zone alone. nats-server 2.9 knows leaf nodes by passwords, not by nkeys:
   the passwords are in secret files of their own (`LEAFS_FILE`, `site_secret_text`).
4. Each zone has an account of its own, so subjects and streams of one zone do not exist for another.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from .server_rights import STATUS, Permissions, permissions

SYNCS: Final = (2, 10)
"""First version of nats-server that can be told to sync each message to the disk before it acknowledges it."""
CLIENT_PORT, ROUTE_PORT, LEAF_PORT = 4222, 6222, 7422
ANSWER_WITHIN: Final = "1h"
"""Time in which a collector may answer a command (one hour), in the notation of nats-server."""
ACCOUNTS_FILE: Final = "accounts.conf"
LEAFS_FILE: Final = "leafs.conf"
"""Name of a secret file: the passwords of edge sites, for servers of the centre."""


@dataclass(frozen=True, slots=True)
class NatsServer:
    """One NATS server of a fleet: its name and addresses.

    Attributes:
        name: name of the server, unique among the servers; also the name of its certificate files.
        host: host where the server listens, and where the others reach it.
        port: TCP port for clients.
        route_port: TCP port for other servers of its cluster.
        leaf_port: TCP port for servers of edge sites.
    """

    name: str
    host: str
    port: int = CLIENT_PORT
    route_port: int = ROUTE_PORT
    leaf_port: int = LEAF_PORT


@dataclass(frozen=True, slots=True)
class NatsServerOptions:
    """Options that are the same for all NATS servers of a fleet.

    Attributes:
        version: the first two numbers of the version of nats-server.
        store: folder of the streams on each machine; each server has a folder with its own name in it.
        tls: folder of the certificates on each machine: ``NAME.pem`` and ``NAME.key`` of the server, and ``ca.pem``.
            None for no encryption.
        cluster: name of the cluster, if there are several servers.
    """

    version: tuple[int, int] = (2, 9)
    store: str = "/var/lib/nats"
    tls: str | None = "/etc/nats/tls"
    cluster: str = "busway"


def server_text(
    server: NatsServer, servers: Sequence[NatsServer], options: NatsServerOptions, *, has_sites: bool = False
) -> str:
    """Return the text of the configuration file of one NATS server of the centre.

    With several servers the text also names the others, as one cluster. It includes the files `ACCOUNTS_FILE` and, if
    edge sites may connect, `LEAFS_FILE`.

    Args:
        server: the server.
        servers: all servers of the centre, this one included.
        options: options of all servers.
        has_sites: whether servers of edge sites may connect.
    """
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
    """Return the text of the configuration file of the NATS server of an edge site.

    It includes two further files: ``SITE-leaf.conf`` (`site_secret_text`) and ``SITE-accounts.conf``
    (`accounts_text`), with the name of the site.

    Args:
        site: the server; its name is that of the site's zone.
        options: options of all servers.
    """
    lines = _common(site, options, site.name)
    lines += [f'include "./{site.name}-leaf.conf"', f'include "./{site.name}-{ACCOUNTS_FILE}"']
    return "\n".join(lines) + "\n"


def site_secret_text(site: NatsServer, centre: Sequence[NatsServer], options: NatsServerOptions, password: str) -> str:
    """Return the text of the file that connects the server of an edge site to the centre; the file has a password.

    Args:
        site: the server of the edge site.
        centre: the servers of the centre.
        options: options of all servers.
        password: the password of the site.
    """
    scheme = "nats-leaf" if options.tls is None else "tls"
    urls = ", ".join(f'"{scheme}://{site.name}:{password}@{each.host}:{each.leaf_port}"' for each in centre)
    tls = "" if options.tls is None else f", tls {{ ca_file: {_quoted(f'{options.tls}/ca.pem')} }}"
    return f'leafnodes {{ reconnect: 2, remotes: [{{ urls: [{urls}], account: "zone-{site.name}"{tls} }}] }}\n'


def leafs_text(passwords: Mapping[str, str]) -> str:
    """Return the text of `LEAFS_FILE`: a user with password for each edge site that connects to the centre.

    Args:
        passwords: the password of each site, by its name. Each user belongs to the account of the site's zone.
    """
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
    """Return the text of `ACCOUNTS_FILE`: an account for each zone with its users, and the system account.

    Args:
        zones: the public key of the user of each role, by name of the zone and then name of the role.
        status_key: public key of the user of the system account, who may only ask for the state of the servers.
        sites: like ``zones``, for the zones of edge sites in the file of the centre; None for none.
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
