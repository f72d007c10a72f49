"""The pages of the documentation: their code runs and prints what they say, and their links lead somewhere."""

import ast
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WRITTEN_ENDPOINT = "tcp://127.0.0.1:5020"
CODE_FOLDERS = ("how-to", "reference", "tutorial")
PAGES_WITH_CODE = sorted(page for folder in CODE_FOLDERS for page in (ROOT / "docs" / folder).glob("*.md"))
PAGES_WITH_CODE.append(ROOT / "docs" / "index.md")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "bench" / "README.md"])


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES_WITH_CODE, ids=name_of)
def test_the_code_of_a_page_runs_and_prints_what_it_says(page: Path, run_page: Callable[[Path], None]) -> None:
    run_page(page)


@pytest.mark.parametrize("page", PAGES_WITH_CODE, ids=name_of)
def test_what_a_reader_pastes_by_itself_imports_what_it_uses(page: Path) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    modules = {name for block in blocks for name in imported_by(block)}
    for block in blocks:
        if page.parent.name == "tutorial" or WRITTEN_ENDPOINT in block:
            names = [node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Name)]
            used = {name.id for name in names} - {name.id for name in names if isinstance(name.ctx, ast.Store)}
            assert used & modules <= imported_by(block), block


def imported_by(block: str) -> set[str]:
    imports = [node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Import | ast.ImportFrom)]
    return {(alias.asname or alias.name).partition(".")[0] for node in imports for alias in node.names}


def test_a_page_that_asks_a_device_which_it_does_not_start_fails(
    tmp_path: Path, run_page: Callable[[Path], None]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(f'```python\nprint("{WRITTEN_ENDPOINT}")\n```\n', encoding="utf-8")
    with pytest.raises(AssertionError, match="starts nothing"):
        run_page(page)


def test_relative_links_lead_to_files_and_headings_that_are_there() -> None:
    broken = [f"{name_of(page)}: {link}" for page in PAGES for link in broken_links(page)]
    assert not broken, "\n".join(broken)


def test_a_link_to_nowhere_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# One\n[a](page.md#one) [b](gone.md) [c](#two) [d](https://example.org/x)\n", encoding="utf-8")
    assert broken_links(page) == ["gone.md", "#two"]


def test_every_page_of_the_documentation_can_be_reached_from_the_index() -> None:
    start = ROOT / "docs" / "index.md"
    reached, waiting = set(), [start]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md" or not page.exists():
            continue
        reached.add(page)
        waiting += [(page.parent / link.partition("#")[0]).resolve() for link in links_of(page) if link[0] != "#"]
    left = set((ROOT / "docs").rglob("*.md")) - reached
    assert not left, f"not linked from anywhere: {sorted(map(name_of, left))}"


def links_of(page: Path) -> list[str]:
    """The relative links of a page, code left out."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`\n]*`", "", text)
    return [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"[a-z]+:", link)]


def broken_links(page: Path) -> list[str]:
    found = []
    for link in links_of(page):
        target, _, heading = link.partition("#")
        file = (page.parent / target).resolve() if target else page
        if not file.exists() or (heading and file.suffix == ".md" and heading not in headings_of(file)):
            found.append(link)
    return found


def headings_of(page: Path) -> set[str]:
    """The anchors of a page, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_no_example_answers_03_for_a_value_that_is_written() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    helps = [*(ROOT / "src" / "busway" / "cli").glob("*.py"), *(ROOT / "src" / "busway" / "simulator").rglob("*.py")]
    for file in (*pages, *helps):
        assert not re.search(
            r"Refusal\(\s*(busway\.)?(ExceptionCode\.ILLEGAL_DATA_VALUE|0?x?0?3\b)", file.read_text("utf-8")
        ), file


def test_the_pages_say_which_systems_were_never_run() -> None:
    said = (ROOT / "README.md").read_text("utf-8")
    assert "Windows and macOS were never run" in said
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    systems = [one for one in project["classifiers"] if one.startswith("Operating System")]
    assert systems == ["Operating System :: POSIX :: Linux"]
