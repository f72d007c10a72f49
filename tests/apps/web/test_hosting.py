"""Starting and stopping, the files of the page, and the headers that every answer has."""

import asyncio
import gzip
import re
import socket
from importlib.resources import files

import pytest
from page_plant import watched, watching

import busway
from busway.apps.web.simulation_page import ControlPage
from busway.errors import ConfigError, LinkDown
from busway.observe.trace import TRACE

PAGE = files("busway.apps.web") / "page"


@pytest.fixture(scope="module")
def plant():
    with watched() as running:
        yield running


def test_the_page_and_all_that_it_names_are_served(plant):
    status, page, headers = plant.exchange("GET", "/")
    assert status == 200
    assert headers["content-type"].startswith("text/html")
    assert 'data-modules="simulation"' in page.decode()
    named = {*re.findall(r'(?:src|href)="(/[^"]+)"', page.decode()), "/simulation.js"}
    assert "/app.js" in named
    for path in named | scripts_of(plant, "/app.js") | scripts_of(plant, "/simulation.js"):
        assert plant.exchange("GET", path)[0] == 200, path


def scripts_of(plant, path):
    """The script of a path with all that it imports."""
    found, waiting = set(), [path]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            text = plant.exchange("GET", path)[1].decode()
            waiting += [f"/{name}" for name in re.findall(r'(?:from|import) "\.?/([^"]+)"', text)]
    return found


def test_every_file_of_the_page_is_served_or_a_part_of_it_or_a_note(plant):
    for one in PAGE.iterdir():
        if one.is_file() and not one.name.endswith(".html"):
            assert plant.exchange("GET", f"/{one.name}")[0] == 200, one.name
    assert plant.exchange("GET", "/simulation.html")[0] == 404
    assert sorted(one.name for one in (PAGE / "uplot").iterdir()) == [
        "LICENSE",
        "NOTICE",
        "uPlot.esm.js",
        "uPlot.min.css",
    ]
    assert b"MIT" in plant.exchange("GET", "/uplot/LICENSE")[1]


def test_the_page_brings_nothing_from_elsewhere_and_no_script_within_html():
    for html in (one.read_text(encoding="utf-8") for one in PAGE.iterdir() if one.name.endswith(".html")):
        assert not re.search(r"<script(?![^>]*\bsrc=)", html)
        assert not re.search(r"\son[a-z]+=|\sstyle=|<style", html)
    own = [one.read_text(encoding="utf-8") for one in PAGE.iterdir() if one.name.endswith((".js", ".css", ".html"))]
    for text in own:
        assert not re.search(r"https?://(?!www\.w3\.org/)", text)
        assert "innerHTML" not in text
        assert "eval(" not in text


def test_the_page_is_small(plant):
    paths = {"/", "/style.css", "/uplot/uPlot.min.css"} | scripts_of(plant, "/app.js")
    paths |= scripts_of(plant, "/simulation.js")
    whole = b"".join(plant.exchange("GET", path)[1] for path in sorted(paths))
    assert len(gzip.compress(whole)) < 100_000


@pytest.mark.parametrize("path", ["/", "/app.js", "/api/units", "/nothing", "/openapi.json"])
def test_every_answer_lets_nothing_in(plant, path):
    headers = plant.exchange("GET", path)[2]
    policy = headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert "server" not in headers
    assert headers["cache-control"] in ("no-store", "no-cache")


def test_a_file_that_a_browser_has_is_not_sent_again(plant):
    tag = plant.exchange("GET", "/app.js")[2]["etag"]
    status, content, _ = plant.exchange("GET", "/app.js", If_None_Match=tag)
    assert (status, content) == (304, b"")


async def test_stopping_leaves_nothing_behind():
    before = TRACE.capture
    async with watching() as plant:
        port = int(plant.host.rpartition(":")[2])
        assert TRACE.capture is plant.page.traffic
        await plant.page.stop()
        await plant.page.stop()
        assert plant.page.url == ""
        assert TRACE.capture is before
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0
        await plant.page.start()
        assert plant.page.url


async def test_an_address_that_is_taken_is_said():
    async with watching() as plant:
        with pytest.raises(LinkDown, match="cannot listen"):
            await ControlPage(plant.simulation, plant.host).start()
        link = busway.open(plant.endpoints[0])
        async with link:
            assert await link.unit(1).read("4x3") == 0


@pytest.mark.parametrize(("failure", "error"), [(OSError(28, "No space left"), LinkDown), (KeyError("x"), KeyError)])
async def test_a_page_whose_server_cannot_listen_says_so_and_can_be_started_later(monkeypatch, failure, error):
    async with watching() as plant:
        page = ControlPage(plant.simulation, "127.0.0.1:0")

        async def fail(*_, **__):
            raise failure

        with monkeypatch.context() as patched:
            patched.setattr(asyncio.get_running_loop(), "create_server", fail)
            with pytest.raises(error, match=r"No space left|x"):
                await page.start()
        assert page.url == ""
        await page.stop()
        async with page:
            assert page.url


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1", "127.0.0.1:99999", "::1:80"])
async def test_an_address_that_cannot_be_is_refused(address):
    async with watching() as plant:
        with pytest.raises(ConfigError):
            ControlPage(plant.simulation, address)
