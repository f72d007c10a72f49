"""The page of the collector in a browser, at desktop and phone width."""

import re

import pytest
from browser_pages import PHONE, expect
from page_collector import MUTE, PUMP, watched_collector


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    with watched_collector(tmp_path_factory.mktemp("collected")) as running:
        yield running


def row(page, key):
    return page.locator("#value-rows [role=row]", has=page.get_by_role("button", name=key, exact=True))


@pytest.mark.parametrize("width", ["desktop", "phone"])
def test_values_history_links_devices_and_sinks_are_shown(new_page, collected, keep, width):
    page = new_page(collected.page.url, **({"viewport": PHONE} if width == "phone" else {}))
    expect(row(page, "pump/speed")).to_contain_text("1.5 rpm")
    expect(row(page, "pump/speed")).to_contain_text("good")
    expect(row(page, "pump/gone")).to_contain_text(re.compile("bad: .*address"))
    keep(page, f"collector-values-{width}")
    row(page, "pump/speed").get_by_role("button").click()
    expect(page.locator("#history-name")).to_have_text("pump/speed")
    expect(page.locator("#chart canvas")).to_be_visible()
    expect(page.locator("#chart")).to_have_attribute("data-values", re.compile("[1-9]"))
    keep(page, f"collector-history-{width}")
    for view, text in (("devices", "polled"), ("links", "hall"), ("sinks", "lines")):
        page.click(f"#tab-{view}")
        expect(page.locator(f"#{view} tbody tr").first).to_contain_text(text)
        keep(page, f"collector-{view}-{width}")
    assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


def test_devices_and_links_tell_who_is_silent_since_when_and_what_was_learnt(new_page, tmp_path):
    with watched_collector(tmp_path, more=MUTE) as running:
        page = new_page(running.page.url)
        page.click("#tab-devices")
        of = {name: page.locator("#device-rows tr", has_text=re.compile(f"^{name}")) for name in ("pump", "mute")}
        expect(of["mute"]).to_contain_text(re.compile(r"silent for \d\.\d s"))
        expect(of["pump"]).to_contain_text("polled")
        expect(of["pump"]).to_contain_text("holding register 4999: exception 02")
        expect(of["mute"]).not_to_contain_text("exception 02")
        page.click("#tab-links")
        expect(page.locator("#link-rows td").nth(4)).to_have_text(re.compile(r"^mute for \d\.\d s$"))
        page.close()  # before its collector ends: it would complain


def test_filters_by_text_and_quality_leave_the_points_that_fit(new_page, collected):
    page = new_page(collected.page.url)
    expect(page.locator("#count")).to_have_text("3 points")
    page.get_by_label("Search points").fill("pump sp")
    expect(page.locator("#count")).to_have_text("1 of 3 points")
    page.get_by_label("Search points").fill("")
    page.get_by_label("Quality").select_option("bad")
    expect(page.locator("#value-rows [role=row]")).to_have_count(1)
    expect(row(page, "pump/gone")).to_be_visible()


def test_a_change_in_the_plant_arrives(new_page, collected):
    page = new_page(collected.page.url)
    collected.device.holding_registers[1] = 1234
    expect(row(page, "pump/level")).to_contain_text("1234")


def test_the_keyboard_opens_and_closes_a_history_and_changes_views(new_page, collected):
    page = new_page(collected.page.url)
    button = row(page, "pump/level").get_by_role("button")
    button.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#history-name")).to_be_focused()
    page.get_by_role("button", name="Close").press("Enter")
    expect(page.locator("#history")).to_be_hidden()
    expect(button).to_be_focused()
    page.locator("#tab-values").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#tab-alarms")).to_be_focused()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#tab-devices")).to_be_focused()
    expect(page.locator("#devices")).to_be_visible()


def test_a_page_that_stays_open_over_a_restart_shows_each_value_under_its_own_name(new_page, tmp_path, complaints):
    with watched_collector(tmp_path) as running:
        address = running.page.url.split("/")[2]
        page = new_page(running.page.url)
        expect(row(page, "pump/level")).to_contain_text("7")
    first = '{ name = "first", address = "4x3", description = "before the others" },'
    with watched_collector(tmp_path, at=address, profile=PUMP.replace("point = [", f"point = [ {first}")):
        expect(row(page, "pump/first").locator(".c-value")).to_have_text("0")
        expect(row(page, "pump/speed").locator(".c-value")).to_have_text("1.5 rpm")
        expect(row(page, "pump/level").locator(".c-value")).to_have_text("7")
        page.close()  # before its collector ends: it would complain
        complaints.clear()  # the connection that was refused meanwhile
