"""The page with what `busway check` says of other servers: its figures are those of its rows, for all of them."""

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "check-peers.md"


def test_the_page_has_the_form_of_a_run_and_all_servers() -> None:
    text = PAGE.read_text(encoding="utf-8")
    script = runpy.run_path(str(ROOT / "scripts" / "check_peers.py"))
    assert script["problems"](text) == []
    names = re.findall(r"^## (\w+) [\d.]+$", text, re.MULTILINE)
    assert names == ["busway", "libmodbus", "pymodbus", "pyModbusTCP", "tmodbus", "uModbus"]


def test_a_row_that_is_missing_or_a_count_that_was_changed_is_found() -> None:
    text = PAGE.read_text(encoding="utf-8")
    script = runpy.run_path(str(ROOT / "scripts" / "check_peers.py"))
    row = next(line for line in text.splitlines() if "| fail |" in line and line.count("|") == 5)
    assert script["problems"](text.replace(row + "\n", "", 1)) == ["libmodbus 3.1.6"]
    assert script["problems"]("") == ["no server"]
