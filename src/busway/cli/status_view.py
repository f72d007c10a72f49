"""Formats the status of a program as sections of rows, with words, times and sizes for people.

Knows the JSON of a control service; prints nothing. Entries without a heading of their own have their key as heading.

1. A column in which all rows are zero, empty or false is left out, except the usual ones.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from ..values.printable import printable

JsonObject = dict[str, Any]

_SECONDS: Final = frozenset({"age", "idle", "uptime"})
_BYTES: Final = frozenset({"received", "sent", "received_bytes", "sent_bytes"})
_LISTENER_COLUMNS: Final = ("endpoint", "is_open", "communication", "error", "device_status")
_CONNECTION_COLUMNS: Final = (
    *("peer", "listener", "pool", "state", "role", "subject"),
    *("age", "idle", "received", "sent", "requests", "waiting"),
)
_UPSTREAM_COLUMNS: Final = ("name", "url", "state", "error", "in_flight", "queued", "forwarded", "answered")
_ALWAYS: Final = frozenset(
    {
        "name",
        "url",
        "state",
        "forwarded",
        "answered",
        *_LISTENER_COLUMNS,
        "peer",
        "listener",
        "age",
        "idle",
        "received",
        "sent",
        "requests",
    }
)
_HEADINGS: Final = {
    "name": "upstream",
    "endpoint": "listener",
    "peer": "connection",
    "is_open": "open",
    "requests": "transactions",
    "device_status": "device",
}
_INDICATORS: Final = ("communication", "error", "device_status")
_EXPIRES_SOON_DAYS: Final = 30.0
_STYLES: Final[Mapping[str, Mapping[str, str]]] = {
    "communication": {"on": "green", "flashing": "yellow"},
    "error": {"on": "bold red", "flashing": "yellow"},
    "device": {"on": "green", "flashing": "yellow", "off": "red"},
    "open": {"no": "red"},
    "pool": {"priority": "bold"},
    "state": {"up": "green", "suspect": "yellow", "backing off": "red"},
}
"""Colours of cells, by heading of the column and text of the cell."""


@dataclass(frozen=True, slots=True)
class StatusSection:
    """One section of a printed status: a title and rows.

    Attributes:
        title: a line above the rows; empty if there is none.
        columns: headings; empty if the rows need none.
        rows: cells, as many in each row.
    """

    title: str
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        # Names and subjects come from clients' certificates.
        object.__setattr__(self, "title", printable(self.title))
        object.__setattr__(self, "rows", [[printable(cell) for cell in row] for row in self.rows])

    def style_of(self, column: int, cell: str) -> str:
        """Return the colour of a cell on a terminal; empty for none."""
        if not self.columns:
            return ""
        return _STYLES.get(self.columns[column], {}).get(cell, "")


def sections_of(told: JsonObject) -> list[StatusSection]:
    """Return all sections to print for the status of one program.

    Args:
        told: the JSON object that the program's control service has sent.
    """
    state = told["status"]
    sections = [StatusSection(headline(told))]
    sections += server_sections(state)
    for listener in state.get("gateway_listeners") or ():
        server = listener.get("server") or {}
        sections.append(StatusSection(f"listener {listener.get('name', '')}".rstrip()))
        sections += server_sections(server)
        counted = list(_counted(listener.get("counters") or {}))
        if counted:
            sections.append(StatusSection("of them", (), counted))
    sections += upstream_sections(state.get("upstreams") or ())
    return sections


def server_sections(state: JsonObject) -> list[StatusSection]:
    """Return the sections to print for a server: listeners, certificates, connections and counters."""
    sections = []
    line = connections_line(state)
    if line:
        sections.append(StatusSection(line))
    if state.get("listeners"):
        sections.append(_table([_flat(one) for one in state["listeners"]], _LISTENER_COLUMNS, ""))
    interfaces = [row for one in state.get("listeners") or () for row in interface_rows(one)]
    if interfaces:
        sections.append(StatusSection("", ("listener", "interface", "address", "netmask", "gateway"), interfaces))
    certificates = [line for one in state.get("listeners") or () for line in certificate_lines(one)]
    if certificates:
        sections.append(StatusSection("certificates", (), certificates))
    if state.get("connections"):
        sections.append(_table(state["connections"], _CONNECTION_COLUMNS, ""))
    counted = list(_counted(state.get("counters") or {}))
    if counted:
        sections.append(StatusSection("counted since the start or the last reset", (), counted))
    refusals = [[rule, str(count)] for rule, count in (state.get("refusals") or {}).items() if count]
    if refusals:
        sections.append(StatusSection("refused by rule", (), refusals))
    return sections


def upstream_sections(upstreams: Sequence[JsonObject]) -> list[StatusSection]:
    """Return the sections for a gateway's upstreams: state, counters, why one is down, suspended units."""
    if not upstreams:
        return []
    rows, down, suspended, doubtful = [], [], [], []
    for upstream in upstreams:
        links = upstream.get("links") or ()
        states = [link["state"] for link in links]
        rows.append(
            {
                "name": upstream["name"],
                "url": upstream["endpoint"],
                "state": ", ".join(dict.fromkeys(states)) or "closed",
                **({"error": upstream["indicators"]["error"]} if "indicators" in upstream else {}),
                "in_flight": sum(link["in_flight"] for link in links),
                "queued": sum(link["queued"] for link in links),
                **(upstream.get("counters") or {}),
            }
        )
        for link in links:
            if link.get("reason"):
                down.append([upstream["name"], link["reason"], f"tried again {_when(link['next_attempt'])}"])
            for unit in link.get("suspended") or ():
                when = _when(unit["next_probe"])
                suspended.append([upstream["name"], f"unit {unit['unit']}", "does not answer", f"asked again {when}"])
            for number in link.get("in_doubt") or ():
                doubtful.append([upstream["name"], f"unit {number}", "owes a reply", "is asked behind a marker"])
    sections = [_table(rows, _UPSTREAM_COLUMNS, "")]
    if down:
        sections.append(StatusSection("cannot be reached", (), down))
    if suspended:
        sections.append(StatusSection("not asked now", (), suspended))
    if doubtful:
        sections.append(StatusSection("in doubt", (), doubtful))
    return sections


def _when(pause: float | None) -> str:
    """Return in words when to connect again: in ``pause`` seconds; None means at the next request."""
    return f"in {duration(pause)}" if pause else "with the next request"


def list_of_programs(told: Iterable[JsonObject]) -> StatusSection:
    """Return the status of several running programs as one section, a row each."""
    rows = [
        [
            str(one["pid"]),
            str(one["name"]),
            "running" if one["status"].get("running") else "stopped",
            duration(one["status"].get("uptime") or 0.0),
            str(len(_connections(one["status"]))),
            " ".join(one["status"].get("endpoints") or ()),
        ]
        for one in told
    ]
    return StatusSection("", ("process", "name", "state", "uptime", "connections", "endpoints"), rows)


def headline(told: JsonObject) -> str:
    """Return one line about a program: its name, endpoints and running time."""
    state = told["status"]
    since = f"up {duration(state.get('uptime') or 0.0)}" if state.get("running") else "stopped"
    endpoints = ", ".join(state.get("endpoints") or ())
    place = f" on {endpoints}" if endpoints else ""
    return f"{told['name']}{place}: {since}, process {told['pid']}, busway {told['version']}"


def connections_line(state: JsonObject) -> str:
    """Return one line with the number of open connections and their limit; empty if the status has no limit."""
    if "supported_connections" not in state:
        return ""
    remote = state.get("remote_connections", len(_connections(state)))
    line = f"{remote} remote connection{'' if remote == 1 else 's'} of {state['supported_connections']} supported"
    return f"{line}, {state['local_connections']} local" if "local_connections" in state else line


def interface_rows(listener: JsonObject) -> Iterator[list[str]]:
    """Yield a row for each network interface that other hosts can use to reach a listener; loopback is left out.

    The cells are endpoint, name, address, netmask and gateway.
    """
    for one in listener.get("interfaces") or ():
        if not (one["address"].startswith("127.") or one["address"] == "::1"):
            yield [listener["endpoint"], one["name"], one["address"], one["netmask"], one["gateway"]]


def certificate_lines(listener: JsonObject) -> Iterator[list[str]]:
    """Yield rows of three cells about a listener's certificate and TLS handshakes; none for one without TLS."""
    security = listener.get("security")
    if not security:
        return
    day = time.strftime("%Y-%m-%d", time.gmtime(security["not_after"]))
    left = security["days_left"]
    if left < 0:
        expiry = f"EXPIRED on {day}"
    else:
        soon = "; renew it" if left < _EXPIRES_SOON_DAYS else ""
        expiry = f"expires on {day}, in {left:.0f} days{soon}"
    yield [listener["endpoint"], security.get("subject", ""), expiry]
    done = [f"{security.get('established', 0)} handshakes agreed"]
    done += [f"{count} refused: {reason}" for reason, count in (security.get("refused") or {}).items() if count]
    yield ["", "", ", ".join(done)]


def duration(time: float) -> str:
    """Return seconds as text with at most two units: ``0.4 s``, ``42 s``, ``5 h 12 min``, ``3 d 4 h``."""
    if time < 10:
        return f"{time:.1f} s"
    if time < 120:
        return f"{time:.0f} s"
    minutes = int(time // 60)
    if minutes < 120:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min"
    return f"{hours // 24} d {hours % 24} h"


def size(number: float) -> str:
    """Return a number of bytes as text: ``512 B``, ``12.3 kB``, ``4.5 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.0f} B" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} TB"


def shown(name: str, value: Any) -> str:
    """Return a value of a program's status as text for people.

    Args:
        name: key of the value; by it a number is seconds, bytes or a plain number.
        value: the value from the JSON.
    """
    if value is None or value == "":
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name in _SECONDS and isinstance(value, int | float):
        return duration(value)
    if name in _BYTES and isinstance(value, int | float):
        return size(value)
    return f"{value:.3g}" if isinstance(value, float) else printable(str(value))


def _table(rows: Sequence[JsonObject], known: Sequence[str], title: str) -> StatusSection:
    """Return a section with a row for each object and a column for each of their keys, those in ``known`` first."""
    names = list(dict.fromkeys([*known, *(name for row in rows for name in row)]))
    names = [
        name
        for name in names
        if not any(isinstance(row.get(name), dict | list) for row in rows)
        and (any(row.get(name) for row in rows) or (name in _ALWAYS and name in rows[0]))
    ]
    headings = [_HEADINGS.get(name, name.replace("_", " ")) for name in names]
    return StatusSection(title, headings, [[shown(name, row.get(name)) for name in names] for row in rows])


def _flat(listener: JsonObject) -> JsonObject:
    """Return a listener's status without nesting, as one row of a table: its indicators and counters become columns."""
    counters = listener.get("counters") or {}
    wrong = {name: count for name, count in counters.items() if "error" in name or "overrun" in name}
    return {**listener, **(listener.get("indicators") or {}), **wrong}


def _counted(counters: JsonObject, prefix: str = "") -> Iterator[list[str]]:
    """Yield name and value of each counter that is not zero; ``prefix`` is put before the names of nested counters."""
    for name, count in counters.items():
        label = f"{prefix}{name.replace('_', ' ')}"
        if isinstance(count, dict):
            yield from _counted(count, f"{label}: ")
        elif count:
            yield [label, shown(name, count)]


def _connections(state: JsonObject) -> list[Any]:
    """Return the connections in the status of a server, or of all listeners of a gateway."""
    servers = [listener.get("server") or {} for listener in state.get("gateway_listeners") or ()]
    of_listeners = (one for server in servers for one in server.get("connections") or ())
    return [*(state.get("connections") or ()), *of_listeners]
