"""Runs `busway check` against servers of other libraries, and writes docs/reference/check-peers.md from it.

    python scripts/check_peers.py NAME=VERSION=COMMAND…     starts each server, checks it, writes the page
    python scripts/check_peers.py --check                   the page has its form; nothing is run

Knows how a peer is started and what it says (``ready PORT``), and the reports of runs; knows no check.

1. The figures are those of a run, never typed by hand. The page says of which versions.
2. Each server has four tables of 1000 items and what its library does by itself. What a library has, but is not asked
   for by these servers, is "not offered" here.
"""

import json
import shlex
import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reference" / "check-peers.md"
OUTCOMES = ("pass", "fail", "warn", "not offered", "undecided", "aborted")
LEVEL = ("--level", "write", "--scratch", "4x501:8,0x501:8", "--idle", "500ms", "--timeout", "1s")
LIMIT = 600.0

HEAD = """\
# Other servers, checked

What [`busway check`](../how-to/check-a-device.md) says of servers made of busway and of other libraries, at the level
`write`, over TCP. `make check-peers` runs it and writes this page; its figures are of the run of {date}.
A server may fail checks against the specification and serve well for years: most checks send what no right client
sends.

Each server has four tables of 1000 items. A function that a library has, and that its server here does not use, counts
as not offered.
"""


def run(command: str) -> dict[str, Any]:
    """Start a server, check it, and return the JSON report."""
    server = subprocess.Popen(
        shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert server.stdout is not None
        port = server.stdout.readline().split()[1]
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            checked = [sys.executable, "-m", "busway", "check", f"tcp://127.0.0.1:{port}", "--unit", "1", *LEVEL]
            subprocess.run(
                [*checked, "--quiet", "--report", f"json={report}"],
                timeout=LIMIT,
                check=False,
                stdout=subprocess.DEVNULL,
            )
            found: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
            return found
    finally:
        server.terminate()
        try:
            server.wait(10)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


def page(found: dict[str, dict[str, Any]], date: str) -> str:
    """The page, from the reports by name and version."""
    lines = [HEAD.format(date=date), f"| server | {' | '.join(OUTCOMES)} |", f"| --- |{' ---: |' * len(OUTCOMES)}"]
    for name, report in found.items():
        lines.append(f"| {name} | {' | '.join(str(report['counts'][one]) for one in OUTCOMES)} |")
    for name, report in found.items():
        lines += ["", f"## {name}", ""]
        told = [one for one in report["checks"] if one["outcome"] in ("fail", "warn", "aborted")]
        if not told:
            lines.append("Passes every check that it offers.")
            continue
        lines += ["| check | clause | outcome | what came |", "| --- | --- | --- | --- |"]
        lines += [f"| {one['id']} | {one['clause']} | {one['outcome']} | {one['reason']} |" for one in told]
    return "\n".join(lines) + "\n"


def problems(text: str) -> list[str]:
    """What is wrong with the form of the page: every server has all counts, and as many rows as they say."""
    wrong: list[str] = []
    names = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    for name in names:
        rows = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
        counts = [int(cell) for cell in rows[0].split("|")[2:-1]] if len(rows) == 1 else []
        section = text.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        told = sum(section.count(f"| {outcome} |") for outcome in ("fail", "warn", "aborted"))
        if len(counts) != len(OUTCOMES) or counts[1] + counts[2] + counts[5] != told:
            wrong.append(name)
    return wrong if names else ["no server"]


def main(arguments: list[str]) -> None:
    if arguments == ["--check"]:
        wrong = problems(PAGE.read_text(encoding="utf-8"))
        if wrong:
            sys.exit(f"{PAGE.name}: the figures of {', '.join(wrong)} do not fit: run make check-peers")
        return
    found = {}
    for one in arguments:
        name, version, command = one.split("=", 2)
        found[f"{name} {version}"] = run(command)
    PAGE.write_text(page(found, f"{datetime.now(UTC):%Y-%m-%d}"), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
