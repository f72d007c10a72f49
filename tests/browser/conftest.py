"""A browser for the tests of pages: Debian's chromium, without a window, driven by Playwright.

1. Where one of them is not there the tests are skipped and say why; with ``BUSWAY_REQUIRE_PEERS=1`` that is a failure.
2. Each test has a page of its own, and fails if anything is complained of in the browser's console.
3. Screenshots go to ``build/artefacts/page``.
"""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_pages import SIZES
from missing_peers import missing
from page_plant import watched

ARTEFACTS = Path(__file__).parents[2] / "build" / "artefacts" / "page"
LIMIT = 15_000
"""Milliseconds for one wait, far above what any needs."""


@pytest.fixture(scope="session")
def axe() -> Any:
    """The checker of barriers: its ``run`` takes a page."""
    try:
        from axe_playwright_python.sync_playwright import Axe
    except ImportError:
        missing("axe is not installed (pip install axe-playwright-python)")
    return Axe()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """The browser."""
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        missing("chromium is not installed (Debian's package chromium)")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("playwright is not installed (pip install playwright)")
    with sync_playwright() as playwright:
        # In a container, and as root, chromium has no sandbox; it sees no other page than ours.
        started = playwright.chromium.launch(
            executable_path=program, args=["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"]
        )
        yield started
        started.close()


@pytest.fixture(scope="module")
def plant() -> Iterator[Any]:
    """A plant and its page."""
    with watched() as running:
        yield running


@pytest.fixture
def complaints() -> Iterator[list[str]]:
    """What the browser complained of; a test takes out what it has caused on purpose."""
    found: list[str] = []
    yield found
    assert not found, "\n".join(found)


@pytest.fixture
def new_page(browser: Any, complaints: list[str]) -> Iterator[Callable[..., Any]]:
    """Makes pages, each with a store of its own: ``new_page(url, viewport=…)``."""
    contexts = []

    def make(url: str, **options: Any) -> Any:
        context = browser.new_context(**{"viewport": SIZES["desktop"], "reduced_motion": "reduce", **options})
        contexts.append(context)
        context.set_default_timeout(LIMIT)
        page = context.new_page()
        page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        return page

    yield make
    for context in contexts:
        context.close()


@pytest.fixture
def page(new_page: Callable[..., Any], plant: Any) -> Any:
    """The page of the plant, once it is live."""
    made = new_page(plant.page.url)
    made.locator("#live[data-state=live]").wait_for()
    made.locator(".rows .row").first.wait_for()
    return made


@pytest.fixture
def keep() -> Callable[[Any, str], None]:
    """Keeps a screenshot under a name."""
    ARTEFACTS.mkdir(parents=True, exist_ok=True)
    return lambda page, name: page.screenshot(path=ARTEFACTS / f"{name}.png")
