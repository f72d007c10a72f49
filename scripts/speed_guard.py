"""Counts the work of a transaction and writes it to tests/speed_guard/figures.toml. With ``--check``: only compares.

    python scripts/speed_guard.py             on this Python and on the others that are here (scripts/find-python)
    python scripts/speed_guard.py --check     on this Python alone; exit code 1 if a figure is off by more than 10 %

Knows the file and how the counting program of `bench/` is run; what is counted stands in `bench/offline/`.

1. Figures of different versions of Python are kept apart: their bytecode differs.
2. A figure that has become smaller is off too: the file says what is true, so that the next change is held against it.
"""

import argparse
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

from marked import ROOT

FILE = ROOT / "tests" / "speed_guard" / "figures.toml"
VERSIONS = ("3.11", "3.12", "3.13")
QUANTITIES = ("calls", "instructions", "bytes")
ALLOWED = 0.10
"""How far a figure may be off, as a part of it."""
HEAD = """\
# What one transaction takes: calls and bytecode instructions of busway's own code, and bytes held at the most.
# Written by scripts/speed_guard.py; bench/offline/ says what is counted. By version of Python, and script.
"""
Figures = dict[str, dict[str, float]]


def counted(python: str) -> Figures:
    """The figures of one Python, by script."""
    surroundings = os.environ | {"PYTHONPATH": str(ROOT / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [python, "-m", "offline.guard"]
    done = subprocess.run(command, cwd=ROOT / "bench", env=surroundings, check=True, stdout=subprocess.PIPE, text=True)
    scripts = json.loads(done.stdout)["scripts"]
    return {name: {one: work[one] for one in QUANTITIES} for name, work in scripts.items()}


def kept() -> dict[str, Figures]:
    """The figures of the file, by version and script."""
    return tomllib.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def differences(found: Figures, expected: Figures, quantities: tuple[str, ...] = QUANTITIES) -> list[str]:
    """A sentence for each figure that is off, and for each script that stands on one side alone."""
    sentences = [f"{name}: it has no figures yet" for name in found.keys() - expected.keys()]
    sentences += [f"{name}: there is no such script any more" for name in expected.keys() - found.keys()]
    for name in found.keys() & expected.keys():
        for one in quantities:
            is_now, was = found[name][one], expected[name][one]
            if abs(is_now - was) > ALLOWED * was:
                sentences.append(f"{name}: {is_now:.1f} {one} per transaction, {(is_now / was - 1) * 100:+.0f} %")
    return sorted(sentences)


def text(figures: dict[str, Figures]) -> str:
    """The file."""
    lines = [HEAD]
    for version in sorted(figures):
        lines.append(f'["{version}"]')
        for name, work in figures[version].items():
            lines.append(f'"{name}" = {{ {", ".join(f"{one} = {work[one]:.1f}" for one in QUANTITIES)} }}')
        lines.append("")
    return "\n".join(lines)


def interpreters() -> dict[str, str]:
    """The Pythons that are here, by version."""
    mine = "{}.{}".format(*sys.version_info[:2])
    found = {mine: sys.executable}
    for version in VERSIONS:
        if version not in found:
            looked = subprocess.run(
                [Path(__file__).with_name("find-python"), version], stdout=subprocess.PIPE, text=True, check=False
            )
            if looked.returncode == 0:
                found[version] = looked.stdout.strip()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare on this Python alone, and write nothing")
    if parser.parse_args().check:
        version = "{}.{}".format(*sys.version_info[:2])
        found = differences(counted(sys.executable), kept().get(version, {}))
        raise SystemExit("\n".join(found) or None)
    FILE.write_text(text(kept() | {version: counted(python) for version, python in interpreters().items()}))
    sys.stdout.write(f"{FILE.relative_to(ROOT)}: written\n")


if __name__ == "__main__":
    main()
