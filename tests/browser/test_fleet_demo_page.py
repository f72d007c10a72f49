"""The page of the fleet's demonstration in a browser: the shards of a killed collector move, and come back to it."""

import re

import pytest
from browser_pages import SIZES, expect
from foreign_servers import needed
from program import Busway

pytest.importorskip("nats")
pytest.importorskip("msgpack")

LONG = 100_000
"""Milliseconds for a scene of the demonstration, on a machine that is busy."""


def test_the_demonstrations_page_shows_shards_move_and_how_far_the_sink_is(
    new_page, tmp_path, monkeypatch, keep, complaints
):
    needed("nats-server")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Busway("fleet", "demo", alone=True) as program:
        url = program.wait_for("page of middle:").split()[4]
        pages = {width: new_page(f"{url}#fleet", viewport=size) for width, size in SIZES.items()}
        for page in pages.values():
            shards = page.locator("#shard-rows tr")
            of_west = shards.filter(has_text="west")
            expect(page.locator("#fleet")).to_be_visible(timeout=LONG)
            of_west.first.wait_for(timeout=LONG)
            expect(page.locator("#fleet-sink-rows tr", has_text="archive")).to_have_text(
                re.compile(r"archive\d+\d+"), timeout=LONG
            )
            assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
        epochs = pages["desktop"].locator("#shard-rows tr", has_text="west").first
        name, before = epochs.locator("th").inner_text(), epochs.locator("td").nth(1).inner_text()
        program.wait_for("west is killed")
        for width, page in pages.items():
            row = page.locator("#fleet-collector-rows tr", has_text="west")
            expect(row).to_contain_text("silent", timeout=LONG)
            expect(page.locator("#shard-rows tr", has_text="west")).to_have_count(0, timeout=LONG)
            expect(page.locator("#hole-rows tr", has_text="west, which fell silent").first).to_be_visible()
            keep(page, f"fleet-demo-{width}")
        moved = pages["desktop"].locator("#shard-rows tr", has=pages["desktop"].locator("th", has_text=name)).first
        after = moved.locator("td").nth(1).inner_text()
        assert [int(part) for part in after.split(".")] > [int(part) for part in before.split(".")]
        for page in pages.values():
            page.locator("#shard-rows tr", has_text="west").first.wait_for(timeout=LONG)  # it has come back
            page.close()  # before its program ends: it would complain
        complaints.clear()
        program.stop()
