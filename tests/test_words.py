"""The words of the glossary hold in the code: one class per public name, and no retired word in a name."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src" / "busway"
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
MOST_WORDS = 60


def rows_of(heading: str, text: str = GLOSSARY) -> list[tuple[str, str]]:
    """The rows of the table that begins with these two headings."""
    table = text.partition(f"| {heading} |\n| --- | --- |\n")[2].partition("\n\n")[0]
    return re.findall(r"^\| (.+?) \| (.+) \|$", table, re.MULTILINE)


WORDS = rows_of("word | meaning")
RETIRED = rows_of("retired | use")


def words_of(name: str) -> list[str]:
    """The words of an identifier or a path, in small letters: ``HTTPServer_gate`` is http, server, gate."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def is_form_of(word: str, retired: str) -> bool:
    """Whether it is the word itself or its plural."""
    return word in (retired, f"{retired}s", f"{retired}es", f"{retired[:-1]}ies")


@cache
def retired_in(name: str) -> list[str]:
    """The retired words that a name contains; "in flight" is what a request is, and no flight."""
    parts = words_of(name)
    words = [word for word, before in zip(parts, ["", *parts], strict=False) if (before, word) != ("in", "flight")]
    found = []
    for retired, _ in RETIRED:
        wanted = retired.split()
        runs = (words[at : at + len(wanted)] for at in range(len(words) - len(wanted) + 1))
        if any(all(map(is_form_of, run, wanted)) for run in runs):
            found.append(retired)
    return found


def names_defined() -> Iterator[tuple[str, str]]:
    """Modules, classes, functions, arguments, variables and attributes, however deep: each name, and its file."""
    for file in sorted(SOURCES.rglob("*.py")):
        module = file.relative_to(SOURCES).with_suffix("").as_posix()
        yield from ((part, module) for part in module.split("/"))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield node.name, module
            elif isinstance(node, ast.arg):
                yield node.arg, module
            elif isinstance(node, ast.Name):
                yield node.id, module
            elif isinstance(node, ast.Attribute):
                yield node.attr, module


def classes_by_name() -> dict[str, list[str]]:
    """Where the public classes at the top of modules are defined."""
    found = defaultdict(list)
    for file in sorted(SOURCES.rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(file.relative_to(SOURCES).as_posix())
    return found


def test_no_public_class_name_is_defined_twice() -> None:
    assert {name: files for name, files in classes_by_name().items() if len(files) > 1} == {}


def test_no_name_contains_a_retired_word() -> None:
    found = {name: (module, words) for name, module in names_defined() if (words := retired_in(name))}
    assert found == {}


@pytest.mark.parametrize(
    ("name", "retired"),
    [
        ("PipelinedBatch", []),
        ("send_volleys", ["volley"]),
        ("RequestInFlight", []),
        ("Flight", ["flight"]),
        ("_broadcast", []),
        ("short_road", ["road"]),
        ("with_personalities", ["personality"]),
        ("is_marked_device", ["marked device"]),
        ("device_marked", []),
    ],
)
def test_retired_words_are_found_as_words_of_a_name(name: str, retired: list[str]) -> None:
    assert retired_in(name) == retired


def test_the_glossary_has_at_most_sixty_words_in_alphabetical_order() -> None:
    words = [word for word, _ in WORDS]
    assert 30 < len(words) <= MOST_WORDS
    assert words == sorted(set(words))


def test_no_word_of_the_glossary_is_retired() -> None:
    retired = [word for word, _ in RETIRED]
    assert len(retired) > 15
    assert retired == sorted(set(retired))
    assert [word for word, _ in WORDS if retired_in(word)] == []
    assert [word for _, word in RETIRED if retired_in(word)] == []


def test_cannot_is_one_word_in_sources_tests_and_pages() -> None:
    folders = [ROOT / name for name in ("src", "tests", "docs", "scripts", "bench")]
    files = [
        file
        for folder in folders
        for kind in ("py", "js", "html", "md", "toml", "c")
        for file in folder.rglob(f"*.{kind}")
    ]
    files += [*ROOT.glob("*.md"), ROOT / "pyproject.toml", ROOT / "Makefile"]
    texts = {file: file.read_text(encoding="utf-8") for file in files if "build" not in file.parts}
    assert len(texts) > 500
    assert [str(file) for file, text in texts.items() if re.search(r"(?i)\bcan\s+not\b|can_" + "not", text)] == []


def test_sources_and_pages_say_who_does_something() -> None:
    vague = re.compile(r"(?i)\b(?:nobody|somebody|whoever|everybody|anybody|by\s+which)\b")
    folders = {ROOT / "src": ("py", "js", "html", "toml"), ROOT / "docs": ("md", "toml")}
    files = [file for folder, kinds in folders.items() for kind in kinds for file in folder.rglob(f"*.{kind}")]
    found = {str(file.relative_to(ROOT)): vague.findall(file.read_text(encoding="utf-8")) for file in files}
    assert len(found) > 500
    assert {file: words for file, words in found.items() if words} == {}
