"""The collector's page for those who operate and configure, in a browser: roles, writes, alarms, maintenance, the file.

Where a test is about what the page does with an answer, the answer comes from a small fake in the browser.
"""

import json
import re
import time

import pytest
from browser_pages import PHONE, expect
from page_collector import watched_collector

from busway.apps.collector.samples import PointGroup, SampleBatch

VIEWS = ("values", "alarms", "devices", "links", "sinks", "commands", "log", "configuration")
WRITABLE = """\
[[unit]]
unit = 1
point = [
    { name = "speed", address = "4x1", scale = 0.1, unit_of_measure = "rpm", minimum = 0, maximum = 3000 },
    { name = "level", address = "4x2", access = "read" },
    { name = "gone", address = "4x5000", access = "read" },
]
"""


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    with watched_collector(tmp_path_factory.mktemp("operated"), profile=WRITABLE) as running:
        yield running


@pytest.fixture
def sign_in(plant):
    lines = [line.split() for line in plant.page.token_path.read_text().splitlines() if line[0] != "#"]
    tokens = {words[0]: words[1] for words in lines}

    def sign(page, role):
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("textbox", name="Token").fill(tokens[role])
        page.get_by_role("button", name="Use it").click()
        expect(page.locator("#who")).to_have_text(role)

    return sign


def row(page, key):
    return page.locator("#value-rows [role=row]", has=page.get_by_role("button", name=key, exact=True))


def answer(page, path, content, status=200):
    """Answer requests for a path with JSON; gives the list of the bodies that came."""
    asked = []

    def handle(route):
        asked.append(route.request.post_data)
        route.fulfill(status=status, content_type="application/json", body=json.dumps(content))

    page.route(re.compile(re.escape(path) + r"(\?.*)?$"), handle)
    return asked


def armed(**more):
    return {
        "key": "busway-1", "device": "pump", "point": "speed", "value": 2.5,
        "old": {"value": 1.5, "quality": "good", "time": time.time()}, "expires": time.time() + 60,
        "confirm": "Write 2.5 rpm to pump/speed, which is 1.5 rpm now?", **more,
    }  # fmt: skip


def outcome(**more):
    return {
        "key": "busway-1", "at": time.time(), "by": "operate", "origin": "page", "device": "pump", "point": "speed",
        "old": 1.5, "value": 2.5, "state": "done", "read_back": 2.5, "reason": None, **more,
    }  # fmt: skip


# Roles.


def test_without_a_token_one_may_look_and_nothing_offers_to_change(new_page, plant):
    page = new_page(plant.page.url)
    expect(page.locator("#who")).to_have_text("loopback: view")
    expect(row(page, "pump/speed")).to_contain_text("rpm")
    expect(page.get_by_role("button", name=re.compile("^Write"))).to_have_count(0)
    expect(page.locator("#tab-configuration")).to_be_hidden()
    page.click("#tab-devices")
    expect(page.locator("#device-rows tr")).to_have_count(1)
    expect(page.get_by_role("button", name=re.compile("maintenance"))).to_have_count(0)


def test_a_token_gives_its_role_until_one_signs_out_and_is_nowhere_to_be_seen(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    expect(row(page, "pump/speed").get_by_role("button", name="Write pump/speed")).to_be_visible()
    expect(row(page, "pump/level").get_by_role("button", name="Write")).to_have_count(0)
    assert "token" not in page.url
    page.reload()
    expect(page.locator("#who")).to_have_text("operate")
    page.get_by_role("button", name="Sign out").click()
    expect(page.locator("#who")).to_have_text("loopback: view")
    expect(page.get_by_role("button", name="Write pump/speed")).to_have_count(0)
    kept = page.evaluate("Object.values(sessionStorage).join('')")
    assert kept == ""


def test_a_wrong_token_is_refused_with_a_sentence(new_page, plant, complaints):
    page = new_page(plant.page.url)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("textbox", name="Token").fill("a-wrong-token-of-no-user")
    page.get_by_role("button", name="Use it").click()
    expect(page.locator("#token-message")).to_have_text("The token is wrong.")
    complaints[:] = [each for each in complaints if "401" not in each and "WebSocket" not in each and "403" not in each]


def test_a_page_whose_token_is_removed_or_permits_less_says_so_and_offers_less(new_page, plant, complaints):
    path = plant.page.token_path
    first = path.read_text()
    try:
        path.write_text(first + "operate a-token-of-many-letters anna\n")
        page = new_page(plant.page.url)
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("textbox", name="Token").fill("a-token-of-many-letters")
        page.get_by_role("button", name="Use it").click()
        expect(row(page, "pump/speed").get_by_role("button", name="Write pump/speed")).to_be_visible()
        path.write_text(first + "view a-token-of-many-letters anna\n")
        expect(page.locator("#who")).to_have_text("anna: view")
        expect(page.get_by_role("button", name="Write pump/speed")).to_have_count(0)
        expect(page.locator("#live")).to_have_text("live")
        path.write_text(first)
        expect(page.locator("#token-message")).to_have_text("The token is wrong.")
        expect(page.locator("#live")).to_have_text("The token is wrong.")
        path.write_text(first + "operate a-token-of-many-letters anna\n")
        page.get_by_role("textbox", name="Token").fill("a-token-of-many-letters")
        page.get_by_role("button", name="Use it").click()
        expect(page.locator("#who")).to_have_text("anna: operate")
        expect(page.locator("#live")).to_have_text("live")
    finally:
        path.write_text(first)
    complaints[:] = [each for each in complaints if "401" not in each and "WebSocket" not in each and "403" not in each]


# Writes.


def open_write(page):
    button = row(page, "pump/speed").get_by_role("button", name="Write pump/speed")
    button.click()
    if not page.locator("#write").is_visible():  # the row was made anew, for the role, while the mouse was down
        button.click()
    expect(page.locator("#write")).to_be_visible()
    expect(page.locator("#write-value")).to_be_focused()


def test_a_write_is_asked_for_confirmed_and_its_outcome_shown(new_page, plant, sign_in, keep):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    asked, confirmed = (
        answer(page, "/api/commands/arm", armed()),
        answer(page, "/api/commands/busway-1/confirm", outcome()),
    )
    open_write(page)
    page.keyboard.type("2.5")
    page.keyboard.press("Enter")
    expect(page.locator("#write-sentence")).to_have_text("Write 2.5 rpm to pump/speed, which is 1.5 rpm now?")
    assert json.loads(asked[0]) == {"device": "pump", "point": "speed", "value": 2.5}
    assert confirmed == []
    expect(page.get_by_role("button", name="Write now")).to_be_focused()
    keep(page, "collector-write")
    page.keyboard.press("Enter")
    expect(page.locator("#write-outcome")).to_have_text("Written. The device now has 2.5.")
    assert len(confirmed) == 1
    expect(page.get_by_role("button", name="Close", exact=True)).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#write")).to_be_hidden()
    expect(row(page, "pump/speed").get_by_role("button", name="Write pump/speed")).to_be_focused()


def test_the_focus_goes_back_to_the_points_button_though_the_rows_were_made_anew_meanwhile(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    expect(row(page, "pump/speed")).to_contain_text("1.5")
    held = []

    def hold(route):
        held.append(route)

    page.route(re.compile("/api/points$"), hold)
    sign_in(page, "operate")
    open_write(page)
    page.evaluate("document.querySelector('#value-rows [role=row]').id = 'before'")
    for route in held:
        route.continue_()
    expect(page.locator("#before")).to_have_count(0)
    expect(row(page, "pump/speed")).to_contain_text("1.5")
    page.keyboard.press("Escape")
    expect(page.locator("#write")).to_be_hidden()
    expect(row(page, "pump/speed").get_by_role("button", name="Write pump/speed")).to_be_focused()


@pytest.mark.parametrize(
    "typed", ["1,5", "1.000,5", "1,000", "1.2.3", "0x10", "12 rpm", "١٢", "NaN", "1e999", "", "9007199254740993"]
)
def test_a_wrong_number_is_refused_with_a_sentence_and_not_guessed(new_page, plant, sign_in, typed):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    asked = answer(page, "/api/commands/arm", armed())
    open_write(page)
    page.locator("#write-value").fill(typed)
    page.keyboard.press("Enter")
    expect(page.locator("#write-message")).to_have_text(re.compile(r"[A-Za-z0-9].*\.$"))
    expect(page.locator("#write-question")).to_be_hidden()
    assert asked == []


def test_what_was_armed_no_longer_counts_once_another_value_is_typed_or_the_time_is_over(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    answer(page, "/api/commands/arm", armed())
    confirmed = answer(page, "/api/commands/busway-1/confirm", outcome())
    open_write(page)
    page.locator("#write-value").fill("2.5")
    page.keyboard.press("Enter")
    expect(page.locator("#write-question")).to_be_visible()
    page.locator("#write-value").fill("3")
    expect(page.locator("#write-question")).to_be_hidden()
    page.unroute_all()
    answer(page, "/api/commands/arm", armed(expires=time.time() + 0.5))
    page.get_by_role("button", name="Write…").click()
    expect(page.locator("#write-message")).to_contain_text("nothing was sent")
    assert confirmed == []


def test_an_answer_that_comes_too_late_is_not_taken_for_that_of_what_was_typed_since(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    late = """(content) => new Promise((done) => {
      const fetched = window.fetch;
      window.fetch = async (...given) => {
        window.fetch = fetched;
        await new Promise((go) => { window.go = go; });
        setTimeout(done, 50);
        return new Response(JSON.stringify(content));
      };
      window.held = done;
    })"""
    open_write(page)
    page.locator("#write-value").fill("2.5")
    page.evaluate(f"(content) => {{ window.late = ({late})(content); }}", armed())
    page.keyboard.press("Enter")
    page.locator("#write-value").fill("3")
    page.evaluate("() => { window.go(); return window.late; }")
    expect(page.locator("#write-question")).to_be_hidden()
    expect(page.locator("#write-arm")).to_be_visible()


def test_a_write_of_unknown_outcome_says_so(new_page, plant, sign_in, complaints):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    answer(page, "/api/commands/arm", armed())
    page.route("**/api/commands/busway-1/confirm", lambda route: route.abort())
    open_write(page)
    page.locator("#write-value").fill("2.5")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Write now").click()
    expect(page.locator("#write-outcome")).to_contain_text("It is not known whether it was written")
    complaints[:] = [each for each in complaints if "Failed to load" not in each]


@pytest.mark.parametrize(
    ("state", "said"),
    [("failed", "Not written"), ("refused", "Refused"), ("expired", "nothing was sent"), ("unknown", "not known")],
)
def test_each_outcome_has_its_words_and_the_reason(new_page, plant, sign_in, state, said):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    answer(page, "/api/commands/arm", armed())
    answer(page, "/api/commands/busway-1/confirm", outcome(state=state, read_back=None, reason="the device is busy"))
    open_write(page)
    page.locator("#write-value").fill("2.5")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Write now").click()
    expect(page.locator("#write-outcome")).to_contain_text(said)
    expect(page.locator("#write-outcome")).to_contain_text("the device is busy")


def test_commands_are_listed_with_who_and_outcome(new_page, plant, keep):
    page = new_page(plant.page.url)
    answer(page, "/api/commands", {"commands": [outcome(by="anna", state="failed", reason="exception 02")]})
    page.click("#tab-commands")
    for text in ("anna", "pump/speed", "failed", "exception 02"):
        expect(page.locator("#command-rows tr")).to_contain_text(text)
    keep(page, "collector-commands")


# Alarms.


def alarm(**more):
    now = int(time.time() * 1000)
    return {
        "device": "pump", "point": "speed", "limit": "H", "state": "raised", "since": now, "value": 81.5,
        "acknowledged": None, "needs_acknowledgement": True, "cleared": None, "text": "above 80 rpm", "quality": "good",
        "reason": "", **more,
    }  # fmt: skip


def test_alarms_are_counted_and_acknowledged_by_those_who_operate(new_page, plant, sign_in, keep):
    page = new_page(plant.page.url)
    event = {
        "at": alarm()["since"],
        "device": "pump",
        "point": "speed",
        "limit": "H",
        "event": "raised",
        "value": 81.5,
        "by": "",
        "text": "",
    }
    answer(page, "/api/alarms", {"active": [alarm()], "journal": [event]})
    page.click("#tab-alarms")
    expect(page.locator("#alarm-rows tr")).to_contain_text("above 80 rpm")
    expect(page.locator("#journal-rows tr")).to_contain_text("raised")
    expect(page.get_by_role("tab", name="Alarms: 1 active, 1 not acknowledged")).to_be_visible()
    expect(page.get_by_role("button", name="Acknowledge pump/speed H")).to_have_count(0)
    sign_in(page, "operate")
    asked = answer(page, "/api/alarms/acknowledge", event)
    page.get_by_role("button", name="Acknowledge pump/speed H").click()
    keep(page, "collector-alarms")
    page.wait_for_function("() => true")
    assert json.loads(asked[0]) == {"device": "pump", "point": "speed", "limit": "H"}


# Maintenance and the configuration.


def test_maintenance_begins_with_a_reason(new_page, plant, sign_in, keep):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    asked = answer(
        page,
        "/api/devices/pump/maintenance",
        {"device": "pump", "on": True, "since": 0, "by": "operate", "reason": "x"},
    )
    page.click("#tab-devices")
    page.get_by_role("button", name="Begin the maintenance of pump").click()
    page.get_by_role("button", name="Begin", exact=True).click()
    assert asked == []  # the reason is missing
    page.get_by_label("Reason").fill("new bearing")
    keep(page, "collector-maintenance")
    page.get_by_role("button", name="Begin", exact=True).click()
    expect(page.locator("#maintenance")).to_be_hidden()
    assert json.loads(asked[0]) == {"on": True, "reason": "new bearing"}


def test_the_configuration_is_replaced_as_a_whole_or_refused_with_all_that_is_wrong(
    new_page, plant, sign_in, keep, complaints
):
    page = new_page(plant.page.url)
    sign_in(page, "configure")
    answer(page, "/api/configuration", {"revision": "abc", "text": "[collector]\n"})
    page.click("#tab-configuration")
    expect(page.get_by_label("Collector file")).to_have_value("[collector]\n")
    keep(page, "collector-configuration")
    page.unroute_all()
    answer(page, "/api/configuration", {"error": "plant.toml:3: poll_class: is missing", "problems": []}, 422)
    page.get_by_role("button", name="Check and apply").click()
    expect(page.locator("#configuration-message")).to_contain_text("plant.toml:3: poll_class: is missing")
    page.unroute_all()
    asked = answer(page, "/api/configuration", {"revision": "def", "done": ["link hall began anew"]})
    page.get_by_label("Collector file").fill("[collector]\nlearn = false\n")
    page.get_by_role("button", name="Check and apply").click()
    expect(page.locator("#configuration-done")).to_contain_text("link hall began anew")
    expect(page.locator("#configuration-revision")).to_have_text("Revision def")
    assert asked == ["[collector]\nlearn = false\n"]
    complaints[:] = [each for each in complaints if "422" not in each]


def test_a_configuration_that_is_slow_to_load_is_loaded_once_and_not_over_what_is_typed(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    sign_in(page, "configure")
    waiting = []
    page.route(re.compile(r"/api/configuration$"), lambda route: waiting.append(route))  # noqa: PLW0108 - the library marks what it calls
    page.click("#tab-configuration")
    page.click("#tab-values")
    page.click("#tab-configuration")
    expect(page.locator("#configuration-text")).to_be_visible()
    first = waiting.pop(0)
    first.fulfill(json={"revision": "1", "text": "first"})
    expect(page.locator("#configuration-text")).to_have_value("first")
    page.locator("#configuration-text").fill("typed")
    for each in waiting:
        each.fulfill(json={"revision": "2", "text": "second"})
    expect(page.locator("#configuration-revision")).to_have_text("Revision 1")
    expect(page.locator("#configuration-text")).to_have_value("typed")
    assert waiting == []


def test_a_file_that_was_refused_or_needs_a_restart_is_told_in_every_view(new_page, plant):
    page = new_page(plant.page.url)
    about = plant.ask("/api/collector")[1]
    expect(page.locator("#notes")).to_be_empty()
    answer(page, "/api/collector", {**about, "restart_needed": ["[collector] page", "[audit]"]})
    expect(page.locator("#notes")).to_have_text(
        "A restart is needed: changes of [collector] page, [audit] hold after the next start."
    )
    page.click("#tab-devices")
    page.unroute_all()
    answer(page, "/api/collector", {**about, "refused": ["line 3: poll_class", "line 4: link[0].url"]})
    expect(page.locator("#notes")).to_contain_text("nothing was changed: line 3: poll_class; line 4: link[0].url.")
    expect(page.locator("#notes")).to_be_visible()
    page.unroute_all()
    expect(page.locator("#notes")).to_be_empty()


# The log, the table, and what all tests need.


def test_the_log_is_filtered_by_level_and_words(new_page, plant):
    import logging

    page = new_page(plant.page.url)
    logging.getLogger("busway.collector").warning("the pump of the tests is silent")
    logging.getLogger("busway.collector").info("the tank of the tests is full")
    page.click("#tab-log")
    expect(page.locator("#log-rows li").first).to_contain_text("the tank of the tests is full")
    page.get_by_label("Least level").select_option("warning")
    expect(page.locator("#log-rows")).not_to_contain_text("the tank of the tests")
    page.get_by_label("Search messages").fill("nothing like this")
    expect(page.locator("#log-rows li")).to_have_count(0)
    expect(page.locator("#no-log")).to_be_visible()


def test_a_row_has_raw_value_age_and_course(new_page, plant):
    page = new_page(plant.page.url)
    plant.device.holding_registers[0] = 0x00FF
    expect(row(page, "pump/speed").locator(".c-value")).to_have_text("25.5 rpm")
    expect(row(page, "pump/speed").locator(".c-raw")).to_have_text("00FF")
    expect(row(page, "pump/speed").locator(".c-age")).to_have_text(re.compile(r"^\d\.\d s$"))
    expect(row(page, "pump/speed").locator("canvas")).to_have_attribute("data-drawn", re.compile("."))


def test_the_course_of_a_point_is_drawn(new_page, plant):
    page = new_page(plant.page.url)
    canvas = row(page, "pump/speed").locator("canvas")
    expect(canvas).to_have_attribute("data-drawn", re.compile("^[2-9]"))
    drawn = "(it) => it.getContext('2d').getImageData(0, 0, it.width, it.height).data.some((each) => each)"
    assert canvas.evaluate(drawn)


RUNS = """(canvas) => {
  const { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  const near = (at) => Math.abs(data[at] - 15) + Math.abs(data[at + 1] - 110) + Math.abs(data[at + 2] - 132) < 60;
  const has = (x) => {
    for (let at = 4 * x; at < data.length; at += 4 * width) if (near(at) && data[at + 3] > 200) return true;
    return false;
  };
  const columns = [...Array(width).keys()].map(has);
  return columns.filter((here, x) => here && !columns[x - 1]).length;
}"""
"""Runs of columns of the chart in which the colour of the line stands."""


def test_time_without_samples_is_a_gap_in_the_history(new_page, plant, keep):
    page = new_page(plant.page.url, color_scheme="light")
    level, now, committer = PointGroup("pump", ("level",)), time.time(), plant.collector._committer
    for begin, end in ((300, 200), (100, 50)):  # seconds ago
        for tenths in range(10 * end, 10 * begin):
            committer.add(SampleBatch(level, int(1e9 * (now - tenths / 10)), 1_000_000, [7 + tenths % 5]))
    committer.flush()
    row(page, "pump/level").get_by_role("button", name="pump/level", exact=True).click()
    page.locator("#span").select_option("600")
    expect(page.locator("#chart")).to_have_attribute("data-gaps", re.compile("[1-9]"))
    keep(page, "collector-gap")
    mean = plant.ask("/api/trend", device="pump", point="level", seconds=600, buckets=1100)[1]["mean"]
    known = "".join("-" if each is None else "x" for each in mean)
    assert re.search("xx-+xx", known), known
    assert page.locator("#chart canvas").evaluate(RUNS) >= 2


def test_links_say_how_long_reads_take(new_page, plant):
    page = new_page(plant.page.url)
    page.click("#tab-links")
    expect(page.locator("#link-rows td").nth(3)).to_have_text(re.compile(r"^[\d.]+ / [\d.]+ / [\d.]+$"))


@pytest.mark.parametrize("width", ["desktop", "phone"])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_nothing_overflows_and_axe_finds_no_barrier(new_page, plant, sign_in, keep, axe, width, theme):
    page = new_page(plant.page.url, color_scheme=theme, **({"viewport": PHONE} if width == "phone" else {}))
    sign_in(page, "configure")
    answer(page, "/api/alarms", {"active": [alarm()], "journal": []})
    answer(page, "/api/commands", {"commands": [outcome()]})
    answer(page, "/api/configuration", {"revision": "abc", "text": "[collector]\n"})
    expect(row(page, "pump/speed")).to_contain_text("rpm")
    found = []
    for view in VIEWS:
        page.click(f"#tab-{view}")
        expect(page.locator(f"#{view}")).to_be_visible()
        if view in ("devices", "links", "sinks"):
            expect(page.locator(f"#{view} tbody tr").first).to_be_visible()
        keep(page, f"collector-{view}-{width}-{theme}")
        assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), view
        found += [f"{view}: {each}" for each in barriers(axe.run(page))]
    page.click("#tab-values")
    open_write(page)
    found += [f"write: {each}" for each in barriers(axe.run(page))]
    assert page.evaluate("document.querySelector('#write').getBoundingClientRect().right <= innerWidth")
    assert not found, "\n".join(found)


def barriers(results):
    """What axe complains of, with the places."""
    return [
        f"{each['id']}: {each['help']}: " + "; ".join(str(node["target"]) for node in each["nodes"][:3])
        for each in results.response["violations"]
    ]


def test_the_keyboard_reaches_every_control_in_order(new_page, plant, sign_in):
    page = new_page(plant.page.url)
    sign_in(page, "operate")
    expect(row(page, "pump/gone")).to_be_visible()
    page.reload()
    expect(row(page, "pump/gone")).to_be_visible()
    seen = []
    for _ in range(14):
        page.keyboard.press("Tab")
        seen.append(page.evaluate("document.activeElement.id || document.activeElement.textContent"))
    for wanted in ("sign", "tab-values", "search", "quality", "value-grid", "pump/speed", "Write", "pump/level"):
        assert wanted in seen, seen
    assert [each for each in seen if each in ("sign", "search", "quality")][:3] == ["sign", "search", "quality"]
