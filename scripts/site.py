"""Builds the documentation site into ``build/site``. Without network; ends with exit code 1 where anything is wrong.

Knows the pages, `mkdocs.yml` and the public names of busway; knows no program that serves the site.

1. The pages stay as they are in ``docs``, readable where they are. What the site needs otherwise is a copy in
   ``build/pages``: links out of ``docs`` lead to copies of the pages there, or become plain text (tests, sources).
2. The reference of the public names comes from docstrings: a page for each room that `_ROOMS` names, all names on it.
   Public names in docstrings are links; what takes its docstring at run time has it there too (`site_docstrings`).
3. A warning of the builder is an error, and so is a link without its page or heading, in whatever was built.
4. A built page loads nothing from another host.
5. The search knows the pages that answer questions: neither the README nor the changelog.
   Hand-written pages come before the reference of the public names where both fit alike; a question may be a sentence.
6. Code blocks below comments `<!-- tab: NAME -->` are tabs of the site, and stand one below the other elsewhere.
"""

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

import busway

ROOT: Final = Path(__file__).resolve().parents[1]
DOCS: Final = ROOT / "docs"
PAGES: Final = ROOT / "build" / "pages"
SITE: Final = ROOT / "build" / "site"
SHIM: Final = "https://unpkg.com/iframe-worker/shim"
"""What the builder loads for the search of pages that are opened as files; `docs/site/file_worker.js` is ours."""

_COPIED: Final = {
    "README.md": "project/readme.md",
    "CHANGELOG.md": "project/changes.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "bench/README.md": "project/benchmark.md",
}
"""Pages outside ``docs`` that are pages of the site too."""
_NOT_SEARCHED: Final = ("project/readme.md", "project/changes.md")
_ROOMS: Final = {
    "clients": "Clients",
    "servers": "Servers and devices",
    "messages": "Messages and values",
    "errors": "Errors",
    "applications": "Gateway, collector, configuration, security",
}
_ROOM_OF: Final = {
    "client": "clients",
    "options": "clients",
    "server": "servers",
    "session": "servers",
    "session.call": "clients",
    "pdu": "messages",
    "values": "messages",
    "codes": "messages",
    "errors": "errors",
    "extras": "errors",
}
"""The page of a public name by the room or file that defines it; the others are on ``applications``."""
_TAB: Final = re.compile(r"^<!-- tab: ([^\n]+) -->\n\n(```.*?^```)$", re.DOTALL | re.MULTILINE)
_LINK: Final = re.compile(r"\[([^\]\n]*)\]\(([^)\s]+)\)")
_NAMED: Final = re.compile(r'<h\d id="busway\.([\w.]+)"')
_CODE: Final = re.compile(r"<(a|h\d|pre)\b.*?</\1>|<code>(?P<name>[\w.]+)</code>", re.DOTALL)
"""A name in code; links, headings and blocks of code are passed over."""


def main() -> int:
    """Build the site; print what is wrong."""
    stage()
    problems = [*build(), *localize()]
    link_names()
    problems += broken_links()
    tune_search()
    sys.stdout.write("".join(f"{problem}\n" for problem in problems))
    if not problems:
        sys.stdout.write(f"{(SITE / 'index.html').relative_to(ROOT)}\n")
    return 1 if problems else 0


def stage() -> None:
    """Copy the pages to where the builder reads them."""
    shutil.rmtree(PAGES, ignore_errors=True)
    shutil.copytree(DOCS, PAGES, ignore=shutil.ignore_patterns("*.toml", "*.json"))
    for source in DOCS.rglob("*.md"):
        target = PAGES / source.relative_to(DOCS)
        target.write_text(site_text(source, target), encoding="utf-8")
    (PAGES / "project").mkdir()
    for name, place in _COPIED.items():
        (PAGES / place).write_text(site_text(ROOT / name, PAGES / place), encoding="utf-8")
    (PAGES / "reference" / "api").mkdir()
    for room, title in _ROOMS.items():
        (PAGES / "reference" / "api" / f"{room}.md").write_text(reference_of(room, title), encoding="utf-8")


def site_text(source: Path, target: Path) -> str:
    """The text of a page for its place in the site: links as rule 1 says."""

    def moved(match: re.Match[str]) -> str:
        words, link = match.groups()
        path, _, heading = link.partition("#")
        if re.match(r"[a-z]+:", link) or not path:
            return match[0]
        file = (source.parent / path).resolve()
        place = place_of(file)
        if place is None:
            return words if words else path
        relative = Path("../" * len(target.parent.relative_to(PAGES).parts)) / place
        return f"[{words}]({relative}{'#' + heading if heading else ''})"

    text = _TAB.sub(tabbed, source.read_text(encoding="utf-8"))
    parts = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else _LINK.sub(moved, part) for part in parts)


def tabbed(match: re.Match[str]) -> str:
    """A code block as a tab."""
    name, block = match.groups()
    return f'=== "{name}"\n\n' + "".join(f"    {line}\n" if line else "\n" for line in block.split("\n"))


def place_of(file: Path) -> Path | None:
    """Where a file of the checkout is in the site; None if it is not."""
    name = str(file.relative_to(ROOT))
    if name in _COPIED:
        return Path(_COPIED[name])
    return file.relative_to(DOCS) if file.is_relative_to(DOCS) and file.suffix != ".toml" else None


def reference_of(room: str, title: str) -> str:
    """The page of a room's public names."""
    lines = [f"# {title}\n"]
    for name in sorted(public_names(room), key=str.lower):
        lines.append(f"::: busway.{name}\n")
    return "\n".join(lines)


def public_names(room: str) -> list[str]:
    """The public classes and functions that are on one page of the reference."""
    found = []
    for name in busway.__all__:
        value = getattr(busway, name)
        if getattr(value, "__name__", None) == name:
            home = value.__module__.removeprefix("busway.")
            if _ROOM_OF.get(home, _ROOM_OF.get(home.partition(".")[0], "applications")) == room:
                found.append(name)
    return found


def build() -> list[str]:
    """Run the builder; returns its warnings."""
    shutil.rmtree(SITE, ignore_errors=True)
    command = [str(Path(sys.executable).with_name("zensical")), "build", "--clean", "--strict"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    printed = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
    is_clean = done.returncode == 0 and "griffe:" not in printed and "arning" not in printed
    return [] if is_clean else [printed.strip()]


def localize() -> list[str]:
    """Put our own script in the place of the one from another host; returns what else pages load from elsewhere."""
    problems = []
    for page in built_pages():
        text = page.read_text(encoding="utf-8")
        up = "../" * (len(page.relative_to(SITE).parts) - 1)
        text = text.replace(SHIM, f"{up or './'}site/file_worker.js")
        page.write_text(text, encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe|source)[^>]*\ssrc="?(https?:[^"\s>]+)', text)
        loaded += re.findall(r'<link[^>]*rel="?(?:stylesheet|preconnect)[^>]*href="?(https?:[^"\s>]+)', text)
        problems += [f"{page.relative_to(SITE)} loads {address}" for address in loaded]
    return problems


def link_names() -> None:
    """Make links of the public names that docstrings write as code: ``LinkDown``, ``busway.connect``."""
    pages = list((SITE / "reference" / "api").glob("*.html"))
    places = {name: page.name for page in pages for name in _NAMED.findall(page.read_text(encoding="utf-8"))}

    def linked(match: re.Match[str]) -> str:
        name = (match["name"] or "").removeprefix("busway.")
        if name not in places or not (name[0].isupper() or match["name"] != name):
            return match[0]
        return f'<a href="{places[name]}#busway.{name}">{match[0]}</a>'

    for page in pages:
        page.write_text(_CODE.sub(linked, page.read_text(encoding="utf-8")), encoding="utf-8")


def tune_search() -> None:
    """Make the search as rule 5 says, in the index that is fetched and in the one for pages opened as files."""
    index = json.loads((SITE / "search.json").read_text(encoding="utf-8"))
    left_out = tuple(place.replace(".md", ".html") for place in _NOT_SEARCHED)
    items = [item for item in index["items"] if not item["location"].startswith(left_out)]
    index["items"] = sorted(items, key=lambda item: item["location"].startswith("reference/api/"))
    text = json.dumps(index, separators=(",", ":"), ensure_ascii=False)
    (SITE / "search.json").write_text(text, encoding="utf-8")
    (SITE / "search.js").write_text(f"var __index = {text};", encoding="utf-8")
    [worker] = SITE.glob("assets/javascripts/workers/search.*.js")
    ours = (DOCS / "site" / "plain_questions.js").read_text(encoding="utf-8")
    worker.write_text(f"{worker.read_text(encoding='utf-8')}\n{ours}", encoding="utf-8")


class _Anchors(HTMLParser):
    """The links of a page and the headings that links may name."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.names |= {value for key in ("id", "name") if (value := given.get(key))}
        if tag == "a" and (link := given.get("href")):
            self.links.append(link)


def broken_links() -> list[str]:
    """The links between built pages that lead nowhere."""
    pages = {page: _Anchors(page.read_text(encoding="utf-8")) for page in built_pages()}
    found = []
    for page, anchors in pages.items():
        for link in anchors.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or page.name == "404.html":
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if target.is_dir():
                target = target / "index.html"
            names = pages[target].names if target in pages else None
            if not target.exists() or (parts.fragment and names is not None and unquote(parts.fragment) not in names):
                found.append(f"{page.relative_to(SITE)}: {link}")
    return sorted(set(found))


def built_pages() -> list[Path]:
    """The pages of the site that were built."""
    return sorted(SITE.rglob("*.html"))


if __name__ == "__main__":
    sys.exit(main())
