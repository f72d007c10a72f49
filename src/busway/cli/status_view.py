"""Formats the status of a program as sections of rows, with words, times and sizes for people.

Knows the JSON of a control service; prints nothing. The heading of an entry that is not known here is its key.

1. A column in which all cells are zero, empty or false is left out, except columns that people expect.
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
"""Colour of a cell on a terminal, by the heading of its column and its text."""


@dataclass(frozen=True, slots=True)
class StatusSection:
    """One section of a printed status: a title and rows of cells.

    Attributes:
        title: a line above the rows; empty if there is none.
        columns: headings of the columns; empty for rows without headings.
        rows: the cells; all rows have the same number.
    """

    title: str
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        # Names and subjects come from clients' certificates.
        object.__setattr__(self, "title", printable(self.title))
        object.__setattr__(self, "rows", [[printable(cell) for cell in row] for row in self.rows])

    def style_of(self, column: int, cell: str) -> str:
        """Return the colour of a cell on a terminal, in the words of rich (``bold red``); empty for none.

        ``column`` is the index of the cell's column.
        """
        if not self.columns:
            return ""
        return _STYLES.get(self.columns[column], {}).get(cell, "")


def sections_of(told: JsonObject) -> list[StatusSection]:
    """Return all sections to print for the status of one server or gateway.

    Args:
        told: the JSON object that the program's control service has sent for ``/status``.
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
    """Return the sections to print for the status of a server: listeners, certificates, connections and counters."""
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
    """Return the sections to print for a gateway's upstreams; an empty list without upstreams.

    They are: state and counters, why upstreams cannot be reached, units that are not asked now, and units in doubt.
    """
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
    """Return in words when the next attempt is made: in ``pause`` seconds, or for None or 0 with the next request."""
    return f"in {duration(pause)}" if pause else "with the next request"


def list_of_programs(told: Iterable[JsonObject]) -> StatusSection:
    """Return the statuses of several servers and gateways as one section, a row each."""
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


def collector_sections(told: Sequence[JsonObject]) -> list[StatusSection]:
    """Return the sections that list running collectors with their pages; an empty list without collectors.

    Args:
        told: the fields of `busway.apps.collector.running_notes.RunningCollector` for each collector.
    """
    if not told:
        return []
    rows = [[str(one["pid"]), one["file"], one["store"], one["page"] or "none"] for one in told]
    sections = [StatusSection("", ("process", "collector", "store", "page"), rows)]
    hint = "a collector shows its status on its page, and prints it every minute (busway collect --status-every)"
    sections.append(StatusSection(hint))
    if any(one["is_in_fleet"] for one in told):
        sections.append(StatusSection("the collectors of a zone, their shards and sinks: busway fleet status"))
    return sections


def headline(told: JsonObject) -> str:
    """Return one line about a server or gateway: name, endpoints, running time, process id and version."""
    state = told["status"]
    since = f"up {duration(state.get('uptime') or 0.0)}" if state.get("running") else "stopped"
    endpoints = ", ".join(state.get("endpoints") or ())
    place = f" on {endpoints}" if endpoints else ""
    return f"{told['name']}{place}: {since}, process {told['pid']}, busway {told['version']}"


def connections_line(state: JsonObject) -> str:
    """Return one line with the number of remote connections and their limit; empty if the status has no limit."""
    if "supported_connections" not in state:
        return ""
    remote = state.get("remote_connections", len(_connections(state)))
    line = f"{remote} remote connection{'' if remote == 1 else 's'} of {state['supported_connections']} supported"
    return f"{line}, {state['local_connections']} local" if "local_connections" in state else line


def interface_rows(listener: JsonObject) -> Iterator[list[str]]:
    """Yield a row for each network interface at which a listener can be reached by other hosts; loopback is left out.

    The cells are endpoint of the listener, name, address, netmask and gateway of the interface.
    """
    for one in listener.get("interfaces") or ():
        if not (one["address"].startswith("127.") or one["address"] == "::1"):
            yield [listener["endpoint"], one["name"], one["address"], one["netmask"], one["gateway"]]


def certificate_lines(listener: JsonObject) -> Iterator[list[str]]:
    """Yield two rows of three cells for a listener with TLS: its certificate and expiry; counts of handshakes.

    Yields nothing for a listener without TLS.
    """
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
    """Return a time in seconds as text with at most two units: ``0.4 s``, ``42 s``, ``5 h 12 min``, ``3 d 4 h``."""
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
    """Return one value of a status as text for people; ``-`` for None and for an empty text.

    Args:
        name: key of the value; it decides whether a number is shown as time, as bytes or as a plain number.
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
    """Return a section with a row for each object; the columns are the keys of the objects, those in ``known`` first.

    Keys whose values are lists or objects are left out; so are those that are empty or zero in all rows, unless people
    expect them.
    """
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
    """Return a listener's status as one row of a table: indicators, and counters of errors, become columns."""
    counters = listener.get("counters") or {}
    wrong = {name: count for name, count in counters.items() if "error" in name or "overrun" in name}
    return {**listener, **(listener.get("indicators") or {}), **wrong}


def _counted(counters: JsonObject, prefix: str = "") -> Iterator[list[str]]:
    """Yield name and value, as texts, of each counter that is not zero, also of counters nested in others.

    ``prefix`` is put before the names.
    """
    for name, count in counters.items():
        label = f"{prefix}{name.replace('_', ' ')}"
        if isinstance(count, dict):
            yield from _counted(count, f"{label}: ")
        elif count:
            yield [label, shown(name, count)]


def _connections(state: JsonObject) -> list[Any]:
    """Return all connections in the status of a server, or of all listeners of a gateway."""
    servers = [listener.get("server") or {} for listener in state.get("gateway_listeners") or ()]
    of_listeners = (one for server in servers for one in server.get("connections") or ())
    return [*(state.get("connections") or ()), *of_listeners]
