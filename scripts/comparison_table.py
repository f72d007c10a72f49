"""Writes the table of README.md that compares busway with others. With ``--check``: only compares.

Knows two pages and the rows it takes from them; every figure is one of docs/performance.md or docs/serial.md.
"""

import re
from typing import Final

from marked import ROOT, replaced, update

SPEED: Final = "docs/performance.md"
LINES: Final = "docs/serial.md"
RATIOS: Final = (
    (
        "server, 16 connections with 16 requests in flight each",
        "16 x 16 x 10: busway / {}, rate",
        "pymodbus",
        "libmodbus",
    ),
    ("server, 16 connections, one request at a time", "16 x 1 x 10: busway / {}, rate", "libmodbus"),
    ("server over TLS", "16 x 16 over TLS: busway / {}, rate", "pymodbus"),
    ("asyncio client, 16 calls at once on one connection", "await, 1 x 16: busway / {}, rate", "pymodbus"),
    ("blocking client", "blocking: busway / {}, rate", "pyModbusTCP"),
)
"""What is compared, the goal of docs/performance.md that has the figure, and the programs it is compared with."""
MASTERS: Final = ("pymodbus", "minimalmodbus", "libmodbus")


def render() -> str:
    """The table."""
    speed, lines = ((ROOT / page).read_text(encoding="utf-8") for page in (SPEED, LINES))
    wrong = {name: wrong_values(lines, name) for name in ("busway", *MASTERS)}
    others = ", ".join(f"{name} {wrong[name]}" for name in MASTERS)
    rows = [
        "| | busway | others |",
        "| --- | --- | --- |",
        f"| wrong values in 500 reads of a slave that is [late at times]({LINES}#other-masters-on-the-same-slave)"
        f" | {wrong['busway']} | {others} |",
    ]
    for what, goal, *programs in RATIOS:
        ratios = [(ratio_of(speed, goal.format(program)), program) for program in programs]
        shown = ", ".join(f"{ratio} × {program}" for ratio, program in ratios)
        rows.append(f"| [speed]({SPEED}): {what} | {shown} | 1 |")
    return "\n".join(rows)


def ratio_of(page: str, goal: str) -> str:
    """What a goal of docs/performance.md reached."""
    found = re.search(rf"^\| \w+ \| {re.escape(goal)} \| ([\d.]+) x \|", page, re.MULTILINE)
    if found is None:
        raise SystemExit(f"{SPEED} has no goal {goal!r}")
    return found[1]


def wrong_values(page: str, master: str) -> str:
    """How many wrong values a master of docs/serial.md gave."""
    found = re.search(rf"^\| {master}(?: [\d.]+)? \| \d+ \| (\d+) \|", page, re.MULTILINE)
    if found is None:
        raise SystemExit(f"{LINES} has no row of {master}")
    return found[1]


if __name__ == "__main__":
    file = ROOT / "README.md"
    update(file, replaced(file.read_text(encoding="utf-8"), "comparison", render()))
