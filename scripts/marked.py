"""Generated parts of hand-written pages: the text between two comments of a Markdown file.

Knows files and comments; knows nothing of what is generated.

::

    <!-- begin: functions (scripts/function_table.py writes this part) -->
    …
    <!-- end: functions -->
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
"""The checkout."""


def replaced(page: str, name: str, text: str) -> str:
    """The page with another text in its part ``name``; `SystemExit` if it has no such part."""
    part = re.compile(rf"(<!-- begin: {name}\b[^\n]*-->\n).*?(<!-- end: {name} -->)", re.DOTALL)
    if not part.search(page):
        raise SystemExit(f"the page has no part {name}")
    return part.sub(lambda match: f"{match[1]}\n{text.strip()}\n\n{match[2]}", page)


def update(file: Path, page: str) -> None:
    """Write a page, or with ``--check`` on the command line only say whether it is up to date (exit code 1 if not)."""
    old = file.read_text(encoding="utf-8") if file.exists() else ""
    name = file.relative_to(ROOT)
    if "--check" in sys.argv[1:]:
        if old != page:
            raise SystemExit(f"{name} is out of date; run: python {Path(sys.argv[0]).name} (in scripts/)")
    elif old != page:
        file.write_text(page, encoding="utf-8")
        sys.stdout.write(f"{name}: written\n")
    else:
        sys.stdout.write(f"{name}: up to date\n")
