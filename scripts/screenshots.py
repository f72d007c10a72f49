"""Makes the pictures of README and start page: `make screenshots`.

    python scripts/screenshots.py [FOLDER]      into docs/figures, or into another folder

Knows a small plant, the commands that show it, and a browser; knows nothing of what the pages contain. Needs Debian's
chromium, and playwright.

1. What is seen is what `busway simulate`, `busway collect` and `busway read` show of one plant on loopback.
2. Nothing in a picture was typed or painted: the terminal has the command and what it printed.
3. Everything runs in a folder of its own that is removed at the end, and ends by itself.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from io import StringIO
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.text import Text

ROOT: Final = Path(__file__).resolve().parents[1]
PICTURES: Final = ("collector-page.png", "simulator-page.png", "terminal.svg")
SIZE: Final = {"width": 960, "height": 540}
COLLECTED_FOR: Final = 40.0
"""Seconds until the curves can be seen."""
LIMIT: Final = 180
PLANT: Final = """\
[[unit]]
unit = 1
name = "waterworks"

[[unit.point]]
name = "tank.level"
address = "3x1"
type = "float32"
unit_of_measure = "m"
valid = [1.0, 3.0]
behaviour = { kind = "sine", mean = 2.0, amplitude = 1.1, period = 30, every = 0.2 }

[[unit.point]]
name = "tank.target"
address = "4x1"
type = "float32"
value = 2.0
unit_of_measure = "m"
minimum = 0
maximum = 4

[[unit.point]]
name = "pump.speed"
address = "3x3"
unit_of_measure = "rpm"
behaviour = { kind = "sine", mean = 1450, amplitude = 220, period = 17, every = 0.2 }

[[unit.point]]
name = "pump.mode"
address = "4x3"
value = "auto"
enumeration = { off = 0, manual = 1, auto = 2 }

[[unit.point]]
name = "pump.enabled"
address = "0x1"
value = true

[[unit.point]]
name = "meter.power"
address = "3x4"
type = "float32"
unit_of_measure = "W"
behaviour = { kind = "sine", mean = 900, amplitude = 120, period = 11, every = 0.2 }

[[unit.point]]
name = "meter.energy"
address = "3x6"
type = "uint32"
value = 481516
unit_of_measure = "kWh"
"""
COLLECTOR: Final = """\
[collector]
store = "data"
page = "127.0.0.1:0"
[poll_class]
all.period = 0.5
[[link]]
name = "hall"
url = "{url}"
[[device]]
name = "waterworks"
link = "hall"
unit = 1
profile = "waterworks.toml"
"""


def main(folder: Path) -> None:
    """Make all pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="busway-pictures-")))
        (place / "waterworks.toml").write_text(PLANT, encoding="utf-8")
        simulated = ("simulate", "waterworks.toml", "--listen", "tcp://127.0.0.1:0", "--api", "127.0.0.1:0")
        endpoint, page = started(stack, place, simulated, r"(tcp://[\d.:]+)", r"(http://[\d.:]+/\S*)")
        (place / "collector.toml").write_text(COLLECTOR.format(url=endpoint), encoding="utf-8")
        [collector_page] = started(stack, place, ("collect", "collector.toml"), r"(http://[\d.:]+/\S*)")
        since = time.monotonic()
        take_terminal(folder / "terminal.svg", place, endpoint)
        with browser() as chromium:
            values = chromium.new_page(viewport=SIZE, color_scheme="light")
            values.goto(collector_page)
            values.get_by_role("button", name="waterworks/tank.level", exact=True).wait_for()
            trends = chromium.new_page(viewport=SIZE, color_scheme="light")
            trends.goto(page)
            trends.locator("#live[data-state=live]").wait_for()
            trends.click("#tab-trends")
            for name in ("1/tank.level", "1/pump.speed"):
                trends.fill("#trend-name", name)
                trends.keyboard.press("Enter")
            trends.evaluate("document.activeElement.blur()")
            time.sleep(max(0.0, COLLECTED_FOR - (time.monotonic() - since)))
            values.screenshot(path=folder / "collector-page.png")
            trends.screenshot(path=folder / "simulator-page.png")


def started(stack: ExitStack, place: Path, words: tuple[str, ...], *patterns: str) -> list[str]:
    """Start a command of busway until the end of the run. Returns what it prints for each pattern."""
    log = place / f"{words[0]}.log"
    with log.open("wb") as output:
        command = [sys.executable, "-u", "-m", "busway", *words]
        child = subprocess.Popen(command, cwd=place, stdout=output, stderr=subprocess.STDOUT)
    stack.callback(child.wait, 30)
    stack.callback(child.terminate)
    until = time.monotonic() + 60
    while True:
        printed = log.read_text(encoding="utf-8")
        found = [re.search(pattern, printed) for pattern in patterns]
        if all(found):
            return [one[1] for one in found if one]
        if child.poll() is not None or time.monotonic() > until:
            raise SystemExit(f"busway {' '.join(words)}: {printed}")
        time.sleep(0.1)


def browser() -> Any:
    """A chromium without a window, as a context manager."""
    from contextlib import contextmanager

    from playwright.sync_api import sync_playwright

    @contextmanager
    def opened() -> Any:
        with sync_playwright() as playwright:
            chromium = playwright.chromium.launch(
                executable_path=shutil.which("chromium") or shutil.which("chromium-browser"),
                args=["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"],
            )
            yield chromium
            chromium.close()

    return opened()


def take_terminal(file: Path, place: Path, endpoint: str) -> None:
    """Draw a terminal with two commands and what they print."""
    console = Console(width=88, record=True, force_terminal=True, file=StringIO())
    for words in (
        ("read", endpoint, "--points", "waterworks.toml"),
        ("read", endpoint, "3x1", "--type", "float32", "-v"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "busway", *words],
            cwd=place,
            capture_output=True,
            text=True,
            check=True,
            timeout=LIMIT,
        )
        console.print(Text(f"$ busway {' '.join(words)}", style="bold"))
        console.print(Text((done.stdout + done.stderr).rstrip()))
    drawn = console.export_svg(title="busway")
    file.write_text(re.sub(r"@font-face \{.*?\}\s*", "", drawn, flags=re.DOTALL), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "figures")
