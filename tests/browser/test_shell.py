"""What the pages of all programs have in common, in a browser: one shell, its views, colours, and who the user is."""

import pytest
from browser_pages import SIZES, expect
from page_collector import watched_collector
from page_plant import watched

VIEWS = {
    "simulation": ("points", "trends", "traffic", "faults", "server"),
    "collector": ("values", "alarms", "devices", "links", "sinks", "commands", "log"),
}


@pytest.fixture(scope="module", params=["simulation", "collector"])
def program(request, tmp_path_factory):
    """Which program it is, and the address of its page."""
    if request.param == "simulation":
        with watched() as running:
            yield request.param, running.page.url
    else:
        with watched_collector(tmp_path_factory.mktemp("plant")) as running:
            yield request.param, running.page.url


@pytest.mark.parametrize("width", SIZES)
def test_every_page_has_the_same_frame_with_the_views_of_its_program(new_page, program, width):
    name, url = program
    page = new_page(url, viewport=SIZES[width])
    page.locator("#live[data-state=live]").wait_for()
    assert page.locator("body").get_attribute("data-modules") == name
    tabs = page.locator("[role=tab]:visible")
    assert tabs.evaluate_all("all => all.map((one) => one.id)") == [f"tab-{view}" for view in VIEWS[name]]
    frame = page.evaluate(
        "[...document.querySelectorAll('header [id]:not(#pause), nav [role=tablist]')].map(e => e.id)"
    )
    assert frame == ["name", "live", "summary", "who", "theme", "sign", "problem", "notes", "tabs"]
    expect(page.locator("#who")).to_have_text(f"loopback: {'configure' if name == 'simulation' else 'view'}")
    expect(page.locator("#name")).to_have_text("plant")
    for view in VIEWS[name]:
        page.click(f"#tab-{view}")
        expect(page.locator(f"#{view}")).to_be_visible()
        assert page.evaluate("location.hash") == f"#{view}"
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[width]["width"]
    page.close()


def test_a_view_is_opened_by_its_address_and_goes_back_with_the_arrows(new_page, program):
    name, url = program
    last, before = VIEWS[name][-1], VIEWS[name][-2]
    page = new_page(f"{url}#{last}")
    expect(page.locator(f"#{last}")).to_be_visible()
    page.locator(f"#tab-{last}").focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator(f"#tab-{before}")).to_be_focused()
    page.wait_for_url(f"{url}#{before}")  # else the browser may still believe that it is where it is to go
    page.goto(f"{url}#{last}")
    expect(page.locator(f"#{last}")).to_be_visible()
    page.close()


def test_colours_are_chosen_on_every_page(new_page, program):
    page = new_page(program[1], color_scheme="light")
    page.locator("#live[data-state=live]").wait_for()
    ground = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(ground)
    page.click("#theme")
    page.click("#theme")
    expect(page.locator("#theme")).to_have_text("Theme: dark")
    assert page.evaluate(ground) != light
    page.close()


def test_what_only_some_may_do_is_not_offered_to_those_who_may_look(new_page, program):
    name, url = program
    page = new_page(url)
    page.locator("#live[data-state=live]").wait_for()
    if name == "simulation":
        expect(page.locator("#pause")).to_be_visible()
        expect(page.locator("#sign")).to_be_hidden()  # there is no more to get
        page.evaluate("document.body.dataset.role = 'view'")
        expect(page.locator("#pause")).to_be_hidden()
    else:
        expect(page.locator("#sign")).to_be_visible()
        expect(page.locator("#tab-configuration")).to_be_hidden()
    page.close()
