"""What tests of pages in a browser have in common: the sizes of its window, and what is expected of a page."""

from typing import Any

PHONE = {"width": 390, "height": 844}
SIZES = {"desktop": {"width": 1200, "height": 800}, "phone": PHONE}


def expect(locator: Any) -> Any:
    """Playwright's ``expect``, with a minute as its guard against a hang. Imports playwright, which may be missing."""
    from playwright.sync_api import expect as expect_of_playwright

    expect_of_playwright.set_options(timeout=60_000)
    return expect_of_playwright(locator)
