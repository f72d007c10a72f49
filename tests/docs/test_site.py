"""The site: it is built from the pages without a warning, its links lead somewhere, it loads nothing from elsewhere."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.timeout(600)  # the build loads the processor, and may wait for it
def test_it_is_built_without_a_warning_a_broken_link_or_an_address_of_another_host() -> None:
    done = subprocess.run(
        [sys.executable, "scripts/site.py"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=540
    )
    assert (done.stdout, done.returncode) == ("build/site/index.html\n", 0), done.stdout + done.stderr
    api = (ROOT / "build" / "site" / "reference" / "api" / "clients.html").read_text(encoding="utf-8")
    assert 'id="busway.connect"' in api
    assert "Nothing is sent, and no connection made, before the first request" in api
    search = (ROOT / "build" / "site" / "search.json").read_text(encoding="utf-8")
    assert "how-to/own-responder.html" in search
