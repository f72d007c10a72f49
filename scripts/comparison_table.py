"""Writes the table of README.md that compares busway with others. With ``--check``: only compares.

Knows four pages and the rows it takes from them; every figure is one of docs/performance.md, docs/serial.md,
docs/reference/check-peers.md or docs/how-to/migrate-from-mbusd.md. A program without a figure there has none here.
"""

import re
from typing import Final

from marked import ROOT, replaced, update

SPEED: Final = "docs/performance.md"
LINES: Final = "docs/serial.md"
CHECKS: Final = "docs/reference/check-peers.md"
GATEWAYS: Final = "docs/how-to/migrate-from-mbusd.md"
PROGRAMS: Final = ("busway", "pymodbus", "pyModbusTCP", "minimalmodbus", "libmodbus", "mbusd")
RATES: Final = (
    ("server speed: replies a second, 16 connections with 16 requests each", "Servers: FC03", "16 x 16 x 10"),
    ("server speed: replies a second, 16 connections with one request each", "Servers: FC03", "16 x 1 x 10"),
    ("server speed over TLS", "Servers over TLS: FC03 x 10 registers", "16 x 16"),
    ("asyncio client speed, 16 calls at once", "Clients against the floor server: FC03 x 10 registers", "await 1 x 16"),
    ("blocking client speed", "Clients against the floor server: FC03 x 10 registers", "blocking"),
)
"""What is compared, and the table of docs/performance.md and the beginning of its rows."""


def render() -> str:
    """The table."""
    pages = (SPEED, LINES, CHECKS, GATEWAYS)
    speed, lines, checks, gateways = ((ROOT / page).read_text(encoding="utf-8") for page in pages)
    rows = ["| | " + " | ".join(PROGRAMS) + " |", "| --- |" + " ---: |" * len(PROGRAMS)]
    wrong = [first(rf"^\| {name}(?: [\d.]+)? \| \d+ \| (\d+) \|", lines) for name in PROGRAMS]
    rows.append(row("wrong values in 500 reads of a slave with late replies", f"{LINES}#{MASTERS}", wrong))
    for what, table, case in RATES:
        part = speed.partition(f"### {table}\n")[2].partition("\n### ")[0]
        rates = [first(rf"^\| {case} {name}(?: \(C\))? \| ([\d,]+) \|", part) for name in PROGRAMS]
        if rates[0] == "–":
            raise SystemExit(f"{SPEED} has no row {case} busway below {table!r}")
        rows.append(row(what, SPEED, rates))
    failed = [first(rf"^\| {name} [\d.]+ \| \d+ \| (\d+) \|", checks) for name in PROGRAMS]
    rows.append(row("checks of a server against the specification that fail", CHECKS, failed))
    unhurried = first(r"^\| mbusd [\d.]+ with `-R 1` \| ([\d.]+) \|", gateways)
    taken = [first(rf"^\| {name}(?: [\d.]+)? \| ([\d.]+) \|", gateways) for name in PROGRAMS]
    taken[-1] += f"; with `-R 1` {unhurried}"
    rows.append(row("milliseconds of a read through a gateway to a serial line", GATEWAYS, taken))
    return "\n".join(rows)


MASTERS: Final = "other-masters-on-the-same-slave"


def row(what: str, page: str, figures: list[str]) -> str:
    """A row: its words are the link to the page that has the figures."""
    return f"| [{what}]({page}) | {' | '.join(figures)} |"


def first(pattern: str, page: str) -> str:
    """The figure that a pattern finds on a page; a dash if there is none."""
    found = re.search(pattern, page, re.MULTILINE)
    return found[1] if found else "–"


if __name__ == "__main__":
    file = ROOT / "README.md"
    update(file, replaced(file.read_text(encoding="utf-8"), "comparison", render()))
