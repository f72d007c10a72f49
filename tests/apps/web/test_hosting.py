"""Starting and stopping, the files of the page, and the headers that every answer has."""

import gzip
import re
import socket
from importlib.resources import files

import pytest
from page_plant import watched, watching

import busway
from busway.apps.web.collector_page import _SCRIPTS
from busway.apps.web.hosting import ControlPage
from busway.errors import ConfigError, LinkDown
from busway.observe.trace import TRACE

PAGE = files("busway.apps.web") / "page"
COLLECTORS = {"collector.html", *(f"{name}.js" for name in _SCRIPTS)}
"""What belongs to the page of the collector; test_collector_page.py looks at it."""


@pytest.fixture(scope="module")
def plant():
    with watched() as running:
        yield running


def test_the_page_and_all_that_it_names_are_served(plant):
    status, page, headers = plant.exchange("GET", "/")
    assert status == 200
    assert headers["content-type"].startswith("text/html")
    named = re.findall(r'(?:src|href)="(/[^"]+)"', page.decode())
    assert "/app.js" in named
    scripts = set(named)
    for path in named:
        if path.endswith(".js"):
            scripts |= {
                f"/{name}" for name in re.findall(r'from "\.?/([^"]+)"', plant.exchange("GET", path)[1].decode())
            }
    for path in scripts:
        assert plant.exchange("GET", path)[0] == 200, path


def test_every_file_of_the_page_is_served_or_a_note(plant):
    found = [one.name for one in PAGE.iterdir() if one.is_file()]
    assert set(found) >= COLLECTORS
    for name in set(found) - COLLECTORS:
        path = "/" if name == "index.html" else f"/{name}"
        assert plant.exchange("GET", path)[0] == 200, path
    assert sorted(one.name for one in (PAGE / "uplot").iterdir()) == [
        "LICENSE",
        "NOTICE",
        "uPlot.esm.js",
        "uPlot.min.css",
    ]
    assert b"MIT" in plant.exchange("GET", "/uplot/LICENSE")[1]


def test_the_page_brings_nothing_from_elsewhere_and_no_script_within_html():
    html = (PAGE / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<script(?![^>]*\bsrc=)", html)
    assert not re.search(r"\son[a-z]+=|\sstyle=|<style", html)
    own = [one.read_text(encoding="utf-8") for one in PAGE.iterdir() if one.name.endswith((".js", ".css", ".html"))]
    for text in own:
        assert not re.search(r"https?://(?!www\.w3\.org/)", text)
        assert "innerHTML" not in text
        assert "eval(" not in text


def test_the_page_is_small(plant):
    paths = [
        "/",
        "/style.css",
        "/uplot/uPlot.min.css",
        "/uplot/uPlot.esm.js",
        *(f"/{name}.js" for name in ("app", "points", "link", "dom", "trends", "traffic", "faults", "status")),
    ]
    whole = b"".join(plant.exchange("GET", path)[1] for path in paths)
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


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1", "127.0.0.1:99999", "::1:80"])
async def test_an_address_that_cannot_be_is_refused(address):
    async with watching() as plant:
        with pytest.raises(ConfigError):
            ControlPage(plant.simulation, address)
