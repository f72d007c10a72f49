"""``busway certs``: makes certificates to try Modbus/TCP Security with, and shows what certificates say.

1. Existing files are overwritten with ``--force`` only; all names are checked before the first file is written.
2. File names go to stdout, one per line; what to try next goes to stderr.
3. The authority is for tests: its key lies beside the certificates that it signs.
"""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import typer

from ..errors import ConfigError
from .arguments import whole_number
from .exits import ExitCode
from .output import warn

if TYPE_CHECKING:
    from ..transport.tls.certificates.authority import Issued
    from ..transport.tls.certificates.facts import CertificateFacts

EXAMPLES = """\b
Examples:
  busway certs lab
  busway certs lab --host plc-7 --host 10.0.0.5 --role Operator --role Viewer
  busway certs show lab/server.pem

A directory that is called show is written ./show.
"""

HOSTS = ("localhost", "127.0.0.1", "::1")
ROLE = "Operator"
"""Role of the client's certificate if neither ``--role`` nor ``--without-role`` is given.

What a role may do is in the policy of a server.
"""
DAYS = 365
TRY_PORT = 8802
"""Port in the suggested commands. The standard port of Modbus/TCP Security, 802, would need a privileged user."""


def certs(
    what: list[str] = typer.Argument(
        ..., metavar="DIR | show FILE…", help="A directory to make certificates in; or files to show."
    ),
    host: list[str] | None = typer.Option(
        None, "--host", metavar="HOST", help="Name or address of the server, several times if need be: localhost."
    ),
    role: list[str] | None = typer.Option(
        None, "--role", metavar="ROLE", help="Make a client with this role, several times if need be: Operator."
    ),
    without_role: bool = typer.Option(False, "--without-role", help="Make a client without a role too."),
    days: str | None = typer.Option(None, "--days", metavar="N", help="Days until the certificates expire: 365."),
    force: bool = typer.Option(False, "--force", help="Write over what is there."),
) -> int:
    """Make a test authority with a server and clients; or show certificates."""
    if what[0] == "show":
        _show(what[1:])
        return ExitCode.DONE
    if len(what) > 1:
        raise ConfigError(f"one directory is needed, not {len(what)}", key="DIR")
    limit = DAYS if days is None else whole_number(days, "--days", 1, 36_500)
    roles = role or ([] if without_role else [ROLE])
    _make(Path(what[0]), host or list(HOSTS), roles, without_role=without_role, days=limit, force=force)
    return ExitCode.DONE


def _make(
    directory: Path, hosts: Sequence[str], roles: Sequence[str], *, without_role: bool, days: int, force: bool
) -> None:
    from ..transport.tls.certificates.authority import Authority

    authority = Authority.create(days=days)
    made = {"ca": authority.issued, "server": authority.server(hosts, days=days)}
    clients = [_file_name(role) for role in roles]
    for role, name in zip(roles, clients, strict=True):
        if name in made:
            raise ConfigError(f"two roles would have the file {name}.pem", key="--role")
        made[name] = authority.client(name, role=role, days=days)
    if without_role:
        clients.append("client")
        made["client"] = authority.client("client", days=days)
    _write(directory, made, force=force)
    _say_what_to_try(directory, hosts[0], clients[0])


def _file_name(role: str) -> str:
    """Return the name of a client's certificate files without suffix: ``client-`` and the role in lower case.

    Characters other than letters, digits, dot, underscore and minus become ``-``; the role is cut after 50 characters.
    """
    return f"client-{re.sub(r'[^A-Za-z0-9._-]+', '-', role).lower()[:50]}"


def _write(directory: Path, made: "dict[str, Issued]", *, force: bool) -> None:
    files = {name: (directory / f"{name}.pem", directory / f"{name}.key") for name in made}
    there = [path for pair in files.values() for path in pair if path.exists()]
    if there and not force:
        raise ConfigError("is there already; --force writes over it", file=str(there[0]))
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"cannot be made: {reason[:1].lower()}{reason[1:]}", file=str(directory)) from error
    for name, (certificate, key) in files.items():
        made[name].write(certificate, key)
        print(certificate)
        print(key)


def _say_what_to_try(directory: Path, host: str, client: str) -> None:
    listener = _url(directory, "127.0.0.1" if host == "localhost" else host, "server")
    warn("the key of this authority lies beside what it signs: it is for tests. To try it:")
    print(f"  busway serve --listen '{listener}'", file=sys.stderr)
    print(f"  busway read '{_url(directory, host, client)}' 4x1", file=sys.stderr)


def _url(directory: Path, host: str, name: str) -> str:
    files = {
        "certificate": directory / f"{name}.pem",
        "key": directory / f"{name}.key",
        "authority": directory / "ca.pem",
    }
    query = "&".join(f"{option}={quote(str(path))}" for option, path in files.items())
    return f"tls://{f'[{host}]' if ':' in host else host}:{TRY_PORT}?{query}"


def _show(names: Sequence[str]) -> None:
    from ..transport.tls.certificates.facts import facts_of_file

    if not names:
        raise ConfigError("name the file with the certificate: busway certs show server.pem", key="FILE")
    for name in names:
        for number, facts in enumerate(facts_of_file(name)):
            if number:
                print()
            for title, text in _lines(name, facts):
                print(f"{title:<12}{text}")


def _lines(name: str, facts: "CertificateFacts") -> list[tuple[str, str]]:
    from ..transport.tls.failures import date_of

    role = repr(facts.role) if facts.role is not None else "none"
    if facts.role_problem:
        role = f"{role} ({facts.role_problem})"
    validity = facts.validity() or f"{facts.days_left():.0f} days left"
    lines = [
        ("file", name),
        ("subject", facts.subject),
        ("issuer", facts.issuer),
        ("valid", f"{date_of(facts.not_before)} … {date_of(facts.not_after)}: {validity}"),
    ]
    if facts.is_authority:
        lines.append(("authority", "may sign other certificates"))
    else:
        lines.append(("role", role))
    if facts.names:
        lines.append(("names", ", ".join(facts.names)))
    return [*lines, ("key", facts.key), ("serial", facts.serial), ("SHA-256", facts.fingerprint)]
