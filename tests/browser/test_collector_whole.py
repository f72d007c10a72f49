"""The collector's page in a browser with all that is behind it: writes that reach a device, alarms, maintenance."""

import functools
import re

import pytest
from browser_pages import expect
from page_collector import watched_collector
from waiting import wait_until

import busway
from busway.apps.collector.samples import Reason

PROFILE = """\
[[unit]]
unit = 1

[[unit.point]]
name = "speed"
address = "4x1"
scale = 0.1
unit_of_measure = "rpm"
minimum = 0
maximum = 3000
write = { verify = "read-back" }

[[unit.point]]
name = "level"
address = "4x2"
access = "read"
alarm = [{ kind = "H", limit = 80, acknowledge = true }]

[[unit.point]]
name = "mode"
address = "4x3"
enumeration = { off = 0, auto = 1, "by hand" = 2 }

[[unit.point]]
name = "faults"
address = "4x5"
type = "uint32"
flags = { "over load" = 0, earth = 4, "last one" = 31 }

[[unit.point]]
name = "valve"
address = "4x4.3"
"""


@pytest.fixture
def plant(tmp_path):
    with watched_collector(tmp_path, profile=PROFILE) as running:
        yield running


@pytest.fixture
def signed(new_page, plant):
    def sign(role):
        page = new_page(plant.page.url)
        lines = [line.split() for line in plant.page.token_path.read_text().splitlines() if line[0] != "#"]
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("textbox", name="Token").fill({words[0]: words[1] for words in lines}[role])
        page.get_by_role("button", name="Use it").click()
        expect(page.locator("#who")).to_have_text(role)
        return page

    return sign


def row(page, key):
    return page.locator("#value-rows [role=row]", has=page.get_by_role("button", name=key, exact=True))


def test_a_write_reaches_the_device_and_stands_in_the_list(plant, signed, complaints):
    page = signed("operate")
    expect(row(page, "pump/speed")).to_contain_text("1.5 rpm")
    row(page, "pump/speed").get_by_role("button", name="Write pump/speed").click()
    page.locator("#write-value").fill("4000")
    page.keyboard.press("Enter")
    expect(page.locator("#write-message")).to_contain_text("3000")
    page.locator("#write-value").fill("2.5")
    page.keyboard.press("Enter")
    expect(page.locator("#write-sentence")).to_contain_text("1.5")
    expect(page.locator("#write-sentence")).to_contain_text("2.5")
    assert plant.device.holding_registers[0] == 15
    page.get_by_role("button", name="Write now").click()
    expect(page.locator("#write-outcome")).to_contain_text("Written. The device now has 2.5.")
    assert plant.device.holding_registers[0] == 25
    page.get_by_role("button", name="Close", exact=True).click()
    expect(row(page, "pump/speed")).to_contain_text("2.5 rpm")
    page.click("#tab-commands")
    for text in ("operate", "page", "pump/speed", "done"):
        expect(page.locator("#command-rows tr").first).to_contain_text(text)
    complaints[:] = [each for each in complaints if "422" not in each]


def test_named_values_and_states_are_chosen_from_a_list_and_shown_by_name(plant, signed):
    page = signed("operate")
    expect(row(page, "pump/mode").locator(".c-value")).to_have_text("off (0)")
    row(page, "pump/mode").get_by_role("button", name="Write pump/mode").click()
    choice = page.get_by_role("combobox", name="New value")
    expect(choice).to_be_focused()
    expect(choice.locator("option")).to_have_text(["Choose a value", "off (0)", "auto (1)", "by hand (2)"])
    page.get_by_role("button", name="Write…").click()
    expect(page.locator("#write-message")).to_have_text("Choose a value.")
    choice.select_option("by hand (2)")
    page.get_by_role("button", name="Write…").click()
    expect(page.locator("#write-sentence")).to_have_text("Write by hand to pump/mode, now off (0) (good)?")
    choice.select_option("auto (1)")
    expect(page.locator("#write-question")).to_be_hidden()
    page.get_by_role("button", name="Write…").click()
    page.get_by_role("button", name="Write now").click()
    expect(page.locator("#write-outcome")).to_contain_text("Written.")
    expect(choice).to_be_disabled()
    page.get_by_role("button", name="Close", exact=True).click()
    expect(row(page, "pump/mode").locator(".c-value")).to_have_text("auto (1)")
    page.click("#tab-commands")
    expect(page.locator("#command-rows tr td:nth-child(5)")).to_have_text("off (0)")
    page.click("#tab-values")
    row(page, "pump/valve").get_by_role("button", name="Write pump/valve").click()
    expect(choice).to_be_enabled()
    choice.select_option("on")
    page.get_by_role("button", name="Write…").click()
    page.get_by_role("button", name="Write now").click()
    expect(page.locator("#write-outcome")).to_contain_text("Written.")
    page.get_by_role("button", name="Close", exact=True).click()
    expect(row(page, "pump/valve").locator(".c-value")).to_have_text("on")
    assert plant.device.holding_registers[2:4] == [1, 8]
    row(page, "pump/speed").get_by_role("button", name="Write pump/speed").click()
    expect(page.get_by_role("textbox", name="New value in rpm")).to_be_focused()
    expect(choice).to_be_hidden()


def test_flags_are_shown_by_name_beside_the_number(plant, signed):
    page = signed("operate")
    shown = row(page, "pump/faults").locator(".c-value")
    expect(shown).to_have_text("0")
    plant.device.holding_registers[4:6] = [0x8000, 0x0013]
    expect(shown).to_have_text("over load, earth, last one (2147483667)")


def test_an_alarm_is_told_at_once_acknowledged_and_kept_in_the_journal(plant, signed):
    page = signed("operate")
    expect(row(page, "pump/level")).to_contain_text("7")
    plant.device.holding_registers[1] = 90
    expect(page.get_by_role("tab", name="Alarms: 1 active, 1 not acknowledged")).to_be_visible()
    page.click("#tab-alarms")
    page.get_by_role("button", name="Acknowledge pump/level H").click()
    expect(page.locator("#alarm-rows tr")).to_contain_text("by operate")
    expect(page.locator("#journal-rows tr").first).to_contain_text("acknowledged")
    plant.device.holding_registers[1] = 7
    expect(page.locator("#no-alarms")).to_be_visible()


def test_maintenance_stops_polling_until_it_ends(plant, signed, tmp_path):
    page = signed("operate")
    expect(row(page, "pump/level")).to_contain_text("7")
    page.click("#tab-devices")
    page.get_by_role("button", name="Begin the maintenance of pump").click()
    page.get_by_label("Reason").fill("new bearing")
    page.get_by_role("button", name="Begin", exact=True).click()
    expect(page.locator("#device-rows tr")).to_contain_text("maintenance")
    plant.device.holding_registers[1] = 55
    page.get_by_role("button", name="End the maintenance of pump").click()
    expect(page.locator("#device-rows tr")).to_contain_text("polled")
    page.click("#tab-values")
    expect(row(page, "pump/level")).to_contain_text("55")
    kept = busway.Store(tmp_path / "data").read("pump/level")
    (interval,) = [each for each in kept.intervals if each.reason == Reason.MAINTENANCE]
    assert all(sample.time > interval.end for sample in kept if sample.value == 55)


def test_a_device_in_maintenance_says_so_in_the_table_also_after_a_restart(tmp_path, new_page):
    with watched_collector(tmp_path, profile=PROFILE) as before:
        page = new_page(before.page.url)
        expect(row(page, "pump/level").locator(".c-quality")).to_have_text("good")
        begin = functools.partial(before.collector.maintenance, "pump", begins=True, why="new bearing")
        before.loop.call_soon_threadsafe(begin)
        expect(row(page, "pump/level").locator(".c-quality")).to_have_text("bad: maintenance")
        expect(row(page, "pump/level").locator(".c-value")).to_have_text("7")
        page.close()
    with watched_collector(tmp_path, profile=PROFILE) as after:
        wait_until(lambda: set(after.ask("/api/values")[1]["reason"]) == {"maintenance"})
        page = new_page(after.page.url)
        expect(row(page, "pump/level").locator(".c-quality")).to_have_text("bad: maintenance")
        expect(row(page, "pump/level").locator(".c-age")).to_have_text("–")
        page.locator("#quality").select_option("bad")
        expect(row(page, "pump/level")).to_be_visible()
        page.close()  # before its collector ends: it would complain


def test_a_configuration_that_is_wrong_is_refused_and_a_right_one_applied(plant, signed, complaints):
    page = signed("configure")
    page.click("#tab-configuration")
    text = page.get_by_label("Collector file")
    expect(text).to_have_value(re.compile("poll_class"))
    before = text.input_value()
    text.fill(before.replace("all.period = 0.1", "all.period = 0"))
    page.get_by_role("button", name="Check and apply").click()
    expect(page.locator("#configuration-message")).to_contain_text(re.compile(r"plant\.toml:\d+"))
    text.fill(before.replace("all.period = 0.1", "all.period = 0.2"))
    page.get_by_role("button", name="Check and apply").click()
    expect(page.locator("#configuration-done")).to_contain_text("hall")
    assert plant.collector.configuration.periods["all"] == 0.2
    complaints[:] = [each for each in complaints if "422" not in each]
