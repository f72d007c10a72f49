"""The words of the glossary hold in the code: one type per public name, and no retired word in a name."""

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
TOOLS = ("tests", "bench", "scripts")
TEXT_KINDS = ("py", "js", "html", "toml", "md", "c")
SPLIT_CANNOT = re.compile(r"(?i)\bcan\s+not\b|can_not")
"""The word "cannot" in two words, in sentences and in names."""
VAGUE = re.compile(
    r"(?i)(?<![a-z])(?:nobody|somebody|whoever|everybody|anybody|by[\s_#]+which|what[\s_#]+is[\s_#]+said)"
    r"(?:s|'s)?(?![a-z])"
)
"""Words that do not name who does something, in sentences, in comments of several lines, and in names."""


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


def names_defined(*folders: Path) -> Iterator[tuple[str, str]]:
    """Modules, classes, functions, arguments, variables and attributes, however deep: each name, and its file."""
    for file in sorted(file for folder in folders for file in folder.rglob("*.py")):
        module = file.relative_to(ROOT).with_suffix("").as_posix()
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


def is_type(name: str, value: ast.expr | None) -> bool:
    """Whether an assignment at the top of a module names a type: an alias, a `NewType` or a named tuple."""
    made = value.func if isinstance(value, ast.Call) else None
    if isinstance(made, ast.Name | ast.Attribute):
        kind = made.id if isinstance(made, ast.Name) else made.attr
        return kind in ("NewType", "NamedTuple", "namedtuple", "TypedDict", "Enum")
    return value is not None and re.search(r"[a-z]", name) is not None and name[0].isupper()


def types_in(module: ast.Module) -> Iterator[str]:
    """The public classes and aliases at the top of a module; a `TypeVar` stands for other types, and is none."""
    for node in module.body:
        if isinstance(node, ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [one.id for one in node.targets if isinstance(one, ast.Name) and is_type(one.id, node.value)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id] if is_type(node.target.id, node.value) else []
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def types_by_name() -> dict[str, list[str]]:
    """Where the public types at the top of modules are defined; `compat` has the names of other libraries."""
    found = defaultdict(list)
    for file in sorted(SOURCES.rglob("*.py")):
        if "compat" not in file.relative_to(SOURCES).parts:
            for name in types_in(ast.parse(file.read_text(encoding="utf-8"))):
                found[name].append(file.relative_to(SOURCES).as_posix())
    return found


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("class Place: ...", ["Place"]),
        ("Place = tuple[int, int]", ["Place"]),
        ("Place: TypeAlias = tuple[int, int]", ["Place"]),
        ("Place = str | int", ["Place"]),
        ('Place = NewType("Place", int)', ["Place"]),
        ('Place = NamedTuple("Place", [("first", int)])', ["Place"]),
        ('Place = TypeVar("Place")', []),
        ("_Place = tuple[int, int]", []),
        ("PLACES = (1, 2)", []),
        ("place = tuple[int, int]", []),
    ],
)
def test_types_of_a_module_are_its_classes_and_aliases(source: str, names: list[str]) -> None:
    assert list(types_in(ast.parse(source))) == names


def test_no_public_type_name_is_defined_twice() -> None:
    found = types_by_name()
    assert found["NumberRange"] == ["access/notation.py"]
    assert {name: files for name, files in found.items() if len(files) > 1} == {}


def test_no_name_contains_a_retired_word() -> None:
    names = names_defined(SOURCES, *(ROOT / folder for folder in TOOLS))
    found = {name: (module, words) for name, module in names if (words := retired_in(name))}
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


def texts() -> dict[str, str]:
    """The text of all sources, tests and pages, by path; not of this file, which has the words that it looks for."""
    files = [*ROOT.glob("*.md"), ROOT / "pyproject.toml", ROOT / "Makefile"]
    for folder in ("src", "docs", *TOOLS):
        files += [file for kind in TEXT_KINDS for file in (ROOT / folder).rglob(f"*.{kind}")]
    wanted = (file for file in files if file != Path(__file__) and "build" not in file.parts)
    return {file.relative_to(ROOT).as_posix(): file.read_text(encoding="utf-8") for file in wanted}


@pytest.mark.parametrize("pattern", [SPLIT_CANNOT, VAGUE], ids=["can not", "who acts"])
def test_sources_tests_and_pages_have_no_word_that_the_pattern_finds(pattern: re.Pattern[str]) -> None:
    found = {file: pattern.findall(text) for file, text in texts().items()}
    assert len(found) > 1500
    assert {file: words for file, words in found.items() if words} == {}


@pytest.mark.parametrize("text", ["it can not be written", "can\nnot", "test_value_can_not_be_read"])
def test_cannot_in_two_words_is_found_in_sentences_and_names(text: str) -> None:
    assert SPLIT_CANNOT.search(text)


@pytest.mark.parametrize(
    "text",
    ["nobody's", "test_whoever_asks", "NOBODY", "what is\nsaid of it", "by which", "# by\n    # which", "key_by_which"],
)
def test_words_that_do_not_name_who_acts_are_found_in_sentences_and_names(text: str) -> None:
    assert VAGUE.search(text)


@pytest.mark.parametrize("text", ["standby which", "by whichever", "what is saidin", "cannot", "scan nothing"])
def test_parts_of_longer_words_are_not_found(text: str) -> None:
    assert not VAGUE.search(text)
    assert not SPLIT_CANNOT.search(text)
