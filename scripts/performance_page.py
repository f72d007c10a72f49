"""Writes the generated parts of docs/performance.md from a kept run of the benchmark. With ``--check``: only compares.

    python scripts/performance_page.py                    the page, from docs/figures/benchmark.json
    python scripts/performance_page.py --take [RESULT [OTHER …]]
                                                          keeps a run first (the newest full one), draws its figures,
                                                          and keeps of other full runs what they say of the goals

Knows the file of results and the page; measures nothing.

1. Only a full run is kept: one that was not cut short by options, with all tables.
2. The page names the run that its figures are of, so that they are not taken for those of another one.
3. A machine that is not alone gives another figure each time: what the other runs say of a goal stands beside.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from marked import ROOT, replaced, update

PAGE = ROOT / "docs" / "performance.md"
FIGURES = ROOT / "docs" / "figures"
KEPT = FIGURES / "benchmark.json"
RESULTS = ROOT / "bench" / "results"
NONE_YET = "No full run is kept yet: `make bench`, then `python scripts/performance_page.py --take`."
Result = Mapping[str, Any]


def rendered(page: str, found: Result | None) -> str:
    """The page with the parts that a run gives."""
    for name, part in (("machine", machine), ("goals", goals), ("pictures", pictures), ("tables", tables)):
        page = replaced(page, name, NONE_YET if found is None else part(found))
    return page


def machine(found: Result) -> str:
    """When and where."""
    told = found["machine"]
    lines = [f"Run of {found['date']}, {found['took_seconds']:.0f} s, `docs/figures/benchmark.json`.", ""]
    lines += ["| | |", "| --- | --- |", *(f"| {name.replace('_', ' ')} | {value} |" for name, value in told.items())]
    return "\n".join(lines)


def goals(found: Result) -> str:
    """Every bar of every table."""
    others = [other["goals"] for other in found.get("others", ())]
    beside = "another run" if len(others) == 1 else f"{len(others)} other runs"
    lines = [
        f"| table | goal | reached | in {beside} | wanted | |",
        "| --- | --- | ---: | ---: | ---: | --- |",
    ]
    for name, table in found["tables"].items():
        for bar in table["bars"]:
            sign = {">=": "≥", "<=": "≤"}[bar["relation"]]
            unit = bar["unit"]
            reached = "–" if bar["value"] is None else f"{short(bar['value'])} {unit}".strip()
            verdict = "**missed**" if bar["verdict"] == "missed" else bar["verdict"]
            seen = [value for other in others if (value := other.get(f"{name}: {bar['what']}")) is not None]
            apart = " … ".join(dict.fromkeys(map(short, (min(seen), max(seen))))) if seen else "–"
            wanted = f"{sign} {short(bar['limit'])} {unit}".strip()
            lines.append(f"| {name} | {bar['what']} | {reached} | {apart} | {wanted} | {verdict} |")
    return "\n".join(lines)


def goals_alone(file: Path) -> dict[str, Any]:
    """What a full run says of the goals."""
    found = full(file)
    reached = {
        f"{name}: {bar['what']}": bar["value"] for name, table in found["tables"].items() for bar in table["bars"]
    }
    return {"date": found["date"], "revision": found["machine"].get("revision"), "goals": reached}


def pictures(found: Result) -> str:
    """The figures that were drawn of it."""
    drawn = [name for name in ("servers", "clients") if (FIGURES / f"{name}.svg").exists()]
    return "\n\n".join(f"![{name}, transactions per second](figures/{name}.svg)" for name in drawn)


def tables(found: Result) -> str:
    """Every table as it was printed."""
    parts = []
    for table in found["tables"].values():
        columns = [column or " " for column in table["columns"]]
        ruler = ["---", *("---:" for _ in columns[1:])]
        cells = [columns, ruler, *table["rows"]]
        parts += [f"### {table['title']}", "", *("| " + " | ".join(escaped(row)) + " |" for row in cells), ""]
        parts += [f"{note}\n" for note in table["notes"]]
    return "\n".join(parts)


def escaped(row: list[str]) -> list[str]:
    return [" ".join(cell.split()).replace("|", "\\|") for cell in row]


def short(value: float) -> str:
    """Three digits that matter."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def newest() -> Path:
    """The last full run."""
    for file in sorted(RESULTS.glob("*.json"), reverse=True):
        if is_full(json.loads(file.read_text(encoding="utf-8"))):
            return file
    raise SystemExit("no full run is there; run: make bench")


def is_full(found: Result) -> bool:
    """Whether a run was not cut short and has the tables that the goals are about."""
    return found.get("shortened") is False and {"server", "client", "gateway", "layers"} <= found["tables"].keys()


def full(file: Path) -> dict[str, Any]:
    """The run in a file of results; one that is not full ends the program."""
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    if not is_full(found):
        raise SystemExit(f"{file.name} is no full run")
    return found


def take(file: Path, others: Sequence[Path] = ()) -> None:
    """Keep a run, and draw it."""
    found = full(file)
    found["others"] = [goals_alone(other) for other in others]
    for table in found["tables"].values():
        for one in table["figures"]:
            if "missing" in one:  # the last line says why; those before it name files of this machine
                said = str(one["missing"]).strip().splitlines() or [""]
                one["missing"] = said[-1].replace(f"{ROOT}/", "")
    FIGURES.mkdir(exist_ok=True)
    KEPT.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    subprocess.run([sys.executable, ROOT / "bench" / "plot.py", KEPT, FIGURES], check=True)


if __name__ == "__main__":
    words = sys.argv[1:]
    if "--take" in words:
        named = words[words.index("--take") + 1 :]
        take(Path(named[0]) if named else newest(), [Path(other) for other in named[1:]])
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else None
    update(PAGE, rendered(PAGE.read_text(encoding="utf-8"), kept))
