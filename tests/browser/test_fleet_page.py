"""The fleet on the page of one of its collectors, in a browser: owners, epochs, and a collector that falls silent."""

import re

from browser_pages import expect
from page_fleet import LINKS, watched_fleet

LONG = 60_000
"""Milliseconds for what takes a lease's time, on a machine that is busy."""


def test_the_shards_of_a_collector_that_falls_silent_move_before_the_viewers_eyes(new_page, tmp_path, keep, complaints):
    with watched_fleet(tmp_path) as fleet:
        page = new_page(fleet.page.url)
        page.locator("#live[data-state=live]").wait_for()
        page.click("#tab-fleet")
        collectors = page.locator("#fleet-collector-rows tr")
        shards = page.locator("#shard-rows tr")
        expect(collectors).to_have_count(2)
        expect(collectors.filter(has_text="goes")).to_contain_text("polls")
        shards_of_goes = shards.filter(has_text="goes")
        shards_of_goes.first.wait_for(timeout=LONG)
        expect(shards.first).to_contain_text(re.compile(r"1\.\d+"))
        fleet.silence()
        expect_of = collectors.filter(has_text="goes")
        expect(expect_of).to_contain_text("silent", timeout=LONG)
        expect(shards_of_goes).to_have_count(0, timeout=LONG)
        expect(page.locator("#hole-rows tr", has_text="goes, which fell silent").first).to_contain_text("stays")
        assert 0 < shards.count() <= LINKS
        keep(page, "fleet")
        page.close()  # before its collectors end: it would complain
        complaints.clear()
