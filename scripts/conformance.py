"""Writes docs/conformance.md from docs/conformance.toml and the clause markers of the tests.

Knows the data file, how tests are marked, and how a claim follows from the states of clauses (Serial Line V1.02 §1.4);
knows nothing of what the clauses say.

    python scripts/conformance.py             writes the page
    python scripts/conformance.py --check     exit code 1 where the page is out of date
    python scripts/conformance.py --missing   exit code 1 where a clause that holds has no test; names them
"""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marked import ROOT, update

DATA = ROOT / "docs" / "conformance.toml"
PAGE = ROOT / "docs" / "conformance.md"
MOST_NAMES = 3
"""Tests of one file that are named; of more, their number is given."""

STATES = {"done": "holds", "partial": "in part", "later": "not yet"}
GROUPS = {
    "A": "Application protocol",
    "T": "TCP/IP messaging",
    "S": "Serial line",
    "M": "Modbus/TCP Security",
}


UNCONDITIONAL, CONDITIONAL, NONE = "unconditional conformity", "conditional conformity", "no conformity"


@dataclass(frozen=True, slots=True)
class Claim:
    """What is claimed of one class of implementations.

    Attributes:
        name: of the class.
        verdict: one of the three.
        preset: the clauses of which a default deviates, so that the preset has to be chosen.
        musts, shoulds: the clauses that do not hold, or not whole.
    """

    name: str
    verdict: str
    preset: tuple[str, ...]
    musts: tuple[str, ...]
    shoulds: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class MarkedTest:
    """A test, and the clause it stands for."""

    clause: str
    file: Path
    name: str


def marked_tests(folder: Path) -> list[MarkedTest]:
    """The tests under a folder that carry a clause, by file and position."""
    found = []
    for file in sorted(folder.rglob("test_*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        of_file = [clause for node in tree.body for clause in _file_clauses(node)]
        for name, decorators in _tests_of(tree):
            clauses = dict.fromkeys([*of_file, *(clause for node in decorators for clause in _clauses(node))])
            found += [MarkedTest(clause, file, name) for clause in clauses]
    return found


def _tests_of(tree: ast.Module) -> Iterator[tuple[str, list[ast.expr]]]:
    """Names of the tests and everything that decorates them, their class's included."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
            yield node.name, node.decorator_list
        elif isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef) and inner.name.startswith("test_"):
                    yield inner.name, [*node.decorator_list, *inner.decorator_list]


def _file_clauses(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Assign) and any(
        isinstance(one, ast.Name) and one.id == "pytestmark" for one in node.targets
    ):
        yield from _clauses(node.value)


def _clauses(node: ast.expr) -> Iterator[str]:
    """The arguments of each ``pytest.mark.clause(…)`` in an expression."""
    for call in ast.walk(node):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "clause":
            for argument in call.args:
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                    yield argument.value


def claims(data: dict[str, Any]) -> list[Claim]:
    """What is claimed of each class, by the states of the clauses and the deviations that concern it."""
    return [_claim(kind, data) for kind in data["class"]]


def _claim(kind: dict[str, Any], data: dict[str, Any]) -> Claim:
    concerning = {one["id"]: one for one in data["clause"] if _concerns(one, kind)}
    deviating = [
        (id_, one)
        for one in data["deviation"]
        for id_ in re.findall(r"[ASTM]\d+", one["clause"].split(":")[0])
        if id_ in concerning and _concerns(one, kind, id_)
    ]
    failing = {(id_, one.get("word")) for id_, one in concerning.items() if one["state"] != "done"}
    failing |= {(id_, one.get("word", concerning[id_].get("word"))) for id_, one in deviating if "preset" not in one}
    musts, shoulds = (tuple(id_ for id_ in concerning if (id_, word) in failing) for word in ("must", "should"))
    verdict = NONE if musts else CONDITIONAL if shoulds else UNCONDITIONAL
    ended = {id_ for id_, one in deviating if "preset" in one}
    return Claim(kind["name"], verdict, tuple(id_ for id_ in concerning if id_ in ended), musts, shoulds)


def _concerns(one: dict[str, Any], kind: dict[str, Any], id_: str | None = None) -> bool:
    """Whether a clause, or a deviation from it, concerns a class."""
    return (id_ or one["id"])[0] in kind["letters"] and set(one.get("concerns", ())) <= set(kind["is"])


def _claims(data: dict[str, Any]) -> list[str]:
    lines = ["| class | claim | musts that do not hold | shoulds that do not hold |", "| --- | --- | --- | --- |"]
    for one in claims(data):
        claim = one.verdict
        if one.verdict != NONE and one.preset:
            claim += f" with the preset `strict`; the defaults deviate from {', '.join(one.preset)}"
        lines.append(f"| {one.name} | {claim} | {', '.join(one.musts)} | {', '.join(one.shoulds)} |")
    return lines


def render(data: dict[str, Any], tests: list[MarkedTest]) -> str:
    """The page."""
    parts = [data["text"]["top"].strip(), "", *_summary(data)]
    parts += ["", "## Claims", "", data["text"]["claims"].strip(), "", *_claims(data)]
    for letter, title in GROUPS.items():
        parts += ["", f"## {letter}. {title}", ""]
        if letter in data["text"]:
            parts += [data["text"][letter].strip(), ""]
        parts += ["| clause | what we do | option | status | tests |", "| --- | --- | --- | --- | --- |"]
        parts += [_row(one, tests) for one in data["clause"] if one["id"][0] == letter]
    parts += ["", "## Deviations", "", data["text"]["deviations"].strip(), ""]
    parts += ["| from | what we do instead | why | how to have it otherwise |", "| --- | --- | --- | --- |"]
    parts += [f"| {one['clause']} | {one['instead']} | {one['why']} | {one['option']} |" for one in data["deviation"]]
    parts += ["", "## Misprints", "", data["text"]["misprints"].strip(), ""]
    parts += ["| printed | what holds |", "| --- | --- |"]
    parts += [f"| {one['printed']} | {one['holds']} |" for one in data["misprint"]]
    parts += ["", "## Chapter 5 of the TCP/IP guide", "", data["text"]["chapter5"].strip(), ""]
    parts += ["| class of the guide | member | ours | note |", "| --- | --- | --- | --- |"]
    parts += [_mapping(one) for one in data["mapping"]]
    return "\n".join(parts) + "\n"


def _summary(data: dict[str, Any]) -> list[str]:
    lines = ["| group | clauses | hold | in part | not yet |", "| --- | --- | --- | --- | --- |"]
    for letter, title in GROUPS.items():
        states = [one["state"] for one in data["clause"] if one["id"][0] == letter]
        counts = " | ".join(str(states.count(state)) for state in STATES)
        lines.append(f"| {letter}. {title} | {len(states)} | {counts} |")
    return lines


def _row(clause: dict[str, str], tests: list[MarkedTest]) -> str:
    state = STATES[clause["state"]]
    if "word" in clause:
        state = f"{clause['word']}: {state}"
    does = clause["does"] + (f" **Not there:** {clause['lacks']}" if "lacks" in clause else "")
    return f"| {clause['id']} | {does} | {clause.get('option', '')} | {state} | {_tests(clause['id'], tests)} |"


def _tests(clause: str, tests: list[MarkedTest]) -> str:
    files: dict[Path, list[str]] = {}
    for one in tests:
        if one.clause == clause:
            files.setdefault(one.file, []).append(one.name)
    cells = []
    for file, names in files.items():
        path = file.relative_to(ROOT)
        link = f"[{path.relative_to('tests')}](../{path})"
        listed = ", ".join(f"`{name.removeprefix('test_')}`" for name in names)
        cells.append(f"{link}: {listed}" if len(names) <= MOST_NAMES else f"{link}: {len(names)} tests")
    return "<br>".join(cells)


def _mapping(one: dict[str, str]) -> str:
    ours = "<br>".join(f"`{name.removeprefix('busway.')}`" for name in one["ours"])
    return f"| {one['class']} | {one['member']} | {ours} | {one.get('note', '')} |"


def missing(data: dict[str, Any], tests: list[MarkedTest]) -> list[str]:
    """The clauses that are said to hold, in part or whole, without a test."""
    tested = {one.clause for one in tests}
    return [one["id"] for one in data["clause"] if one["state"] != "later" and one["id"] not in tested]


def main() -> None:
    """As the top of this file says."""
    data = tomllib.loads(DATA.read_text(encoding="utf-8"))
    tests = marked_tests(ROOT / "tests")
    unknown = sorted({one.clause for one in tests} - {one["id"] for one in data["clause"]})
    if unknown:
        raise SystemExit(f"tests are marked with clauses that are not listed: {', '.join(unknown)}")
    if "--missing" in sys.argv[1:]:
        without = missing(data, tests)
        if without:
            raise SystemExit(f"no test for {', '.join(without)}")
        return
    update(PAGE, render(data, tests))


if __name__ == "__main__":
    main()
