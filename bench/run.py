"""The benchmark of the project: ours, the peers and the floor in one run, on one machine, taking turns.

    python bench/run.py [--quick] [--only server,client,…] [--rounds N] [--seconds S] [--minutes M]

Prints the tables and the bars with what became of them, progress on stderr, and keeps everything in
`bench/results/<date>.json`. Exit code: 0 whether bars are reached or not (shared machines are noisy), 1 when no table
could be measured, 2 when it was asked wrongly.

Rules:
1. Servers have one core, load and clients another.
2. What is not there (a compiler, libmodbus, the peers' environment) is said and left out; nothing is installed here.
3. Every child is ended, also when the run is interrupted; nothing else is.
"""

import argparse
import importlib
import json
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import FrameType

from harness import machine
from harness.bench import Bench, prepare
from harness.children import ChildFailed
from harness.report import Table
from tables import ASKED_BY_NAME_SECONDS, QUICK_ROUNDS, TABLES

RESULTS = Path(__file__).parent / "results"
LIMIT, QUICK_LIMIT = 560.0, 54.0
"""Seconds after which no further table is begun: a busy machine takes longer than the budgets say."""


def main(arguments: list[str] | None = None) -> int:
    asked = _arguments(arguments)
    signal.signal(signal.SIGTERM, _interrupt)
    before = machine.description()
    bench = replace(prepare(asked.quick, asked.seconds), minutes=asked.minutes)
    began = time.time()
    tables: dict[str, Table] = {}
    limit = QUICK_LIMIT if asked.quick else LIMIT
    try:
        usual = [name for name, entry in TABLES.items() if not entry.alone and (entry.quick or not asked.quick)]
        for name in asked.only or usual:
            if not asked.only and time.time() - began > limit:
                bench.say(f"table {name} is left out: {limit:.0f} s are over; --only {name} measures it")
                continue
            try:
                tables[name] = _measured(bench, name, asked.rounds)
            except ChildFailed as failure:
                bench.say(f"table {name} is left out: {failure}")
                continue
            print(tables[name].text(), flush=True)
    except KeyboardInterrupt:
        bench.say("interrupted; what was measured so far is kept")
    shortened = asked.quick or bool(asked.rounds or asked.seconds)
    return _finish(before, began, shortened, tables)


def _measured(bench: Bench, name: str, asked_rounds: int | None) -> Table:
    entry = TABLES[name]
    rounds = asked_rounds or (QUICK_ROUNDS if bench.quick else entry.rounds)
    budget = (entry.quick or ASKED_BY_NAME_SECONDS) if bench.quick else entry.full
    began = time.monotonic()
    table: Table = importlib.import_module(entry.module).run(replace(bench, budget=budget, rounds=rounds))
    bench.say(f"table {name} took {time.monotonic() - began:.0f} s of {budget:.0f} s")
    return table


def _arguments(arguments: list[str] | None) -> argparse.Namespace:
    def names(text: str) -> list[str]:
        wanted = [name for name in text.split(",") if name]
        unknown = [name for name in wanted if name not in TABLES]
        if unknown or not wanted:
            raise argparse.ArgumentTypeError(f"{text!r}: the tables are {', '.join(TABLES)}")
        return wanted

    def positive(text: str) -> float:
        value = float(text)
        if not 0 < value <= 60:
            raise argparse.ArgumentTypeError(f"{text} is not in 0…60")
        return value

    parser = argparse.ArgumentParser(prog="bench", description="Measures busway beside the floor and the peers.")
    parser.add_argument("--quick", action="store_true", help="a part of the tables in a minute; noisier")
    parser.add_argument("--only", type=names, metavar="TABLES", help=f"of {','.join(TABLES)}")
    parser.add_argument("--rounds", type=int, choices=range(1, 101), metavar="N", help="turns of each contender, 1…100")
    seconds_help = "counted seconds of one turn, up to 60, instead of what the budget of its table leaves"
    parser.add_argument("--seconds", type=positive, metavar="S", help=seconds_help)
    minutes_help = "table store: also store for so many minutes, up to 60, while a page reads"
    parser.add_argument("--minutes", type=positive, metavar="M", help=minutes_help)
    return parser.parse_args(arguments)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _finish(before: dict[str, object], began: float, shortened: bool, tables: dict[str, Table]) -> int:
    bars = [bar for table in tables.values() for bar in table.bars]
    counts = {word: sum(bar.verdict == word for bar in bars) for word in ("ok", "missed", "not measured")}
    print(f"\n{', '.join(f'{key} {value}' for key, value in before.items())}")
    print(f"bars: {', '.join(f'{count} {word}' for word, count in counts.items())}")
    if not tables:
        return 1
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{time.strftime('%Y-%m-%dT%H-%M-%S', time.localtime(began))}.json"
    result: dict[str, object] = {
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(began)),
        "took_seconds": round(time.time() - began, 1),
        "shortened": shortened,
        "machine": before,
        "tables": {name: table.kept() for name, table in tables.items()},
    }
    path.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    print(f"kept in {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
