"""One application: the pages of all programs have the same shell, files and access, and modules of their own."""

import re
from importlib.resources import files
from typing import Annotated

import httpx
import pytest
from fastapi import Depends, FastAPI

from busway.apps.web.application import guarded, page_resources
from busway.apps.web.request_guard import AccessToken, Caller, PageAccessRules, Role, require

PAGE = files("busway.apps.web") / "page"
PROGRAMS = [["simulation"], ["collector"], ["collector", "fleet"]]
"""The modules of the pages that there are."""
VIEWS = {
    "simulation": ["points", "trends", "traffic", "faults", "server"],
    "collector": ["values", "alarms", "devices", "links", "sinks", "commands", "log", "configuration"],
    "fleet": ["fleet"],
}


class Module:
    """A module with one route."""

    def __init__(self, name: str) -> None:
        self.name = name

    def add_to(self, application: FastAPI) -> None:
        async def answer(caller: Annotated[Caller, Depends(require(Role.VIEW))]) -> dict[str, str]:
            return {"name": caller.name}

        application.add_api_route(f"/api/{self.name}", answer, methods=["GET"], name=self.name)


def client(names: list[str], rules: PageAccessRules | None = None) -> httpx.AsyncClient:
    page = guarded(
        page_resources("page", "", [Module(name) for name in names]),
        names,
        rules or PageAccessRules(without_token=Role.VIEW),
    )
    return httpx.AsyncClient(transport=httpx.ASGITransport(page), base_url="http://127.0.0.1")


def html_of(names: list[str]) -> list[str]:
    return [(PAGE / f"{name}.html").read_text(encoding="utf-8") for name in ("index", *names)]


def scripts_of(name: str) -> dict[str, str]:
    """The texts of a script and of all that it imports, by name; without the library of charts."""
    found: dict[str, str] = {}
    waiting = [f"{name}.js"]
    while waiting:
        name = waiting.pop()
        if name not in found and "/" not in name:
            found[name] = (PAGE / name).read_text(encoding="utf-8")
            waiting += re.findall(r'(?:from|import) "\./([^"]+)"', found[name])
    return found


@pytest.mark.parametrize("names", PROGRAMS, ids="+".join)
async def test_a_page_is_the_shell_with_the_views_of_its_modules_and_no_others(names: list[str]) -> None:
    async with client(names) as page:
        html = (await page.get("/")).text
        assert f'data-modules="{" ".join(names)}"' in html
        assert re.findall(r'<section id="(\w+)"', html) == [view for name in names for view in VIEWS[name]]
        assert "<!--" not in html
        assert html.count("<main") == html.count("<nav") == html.count('role="tablist"') == 1
        assert html.count('<dialog id="token"') == 1
        identifiers = re.findall(r'\sid="([^"]+)"', html)
        assert len(identifiers) == len(set(identifiers))
        for name in names:
            assert (await page.get(f"/api/{name}")).json() == {"name": "loopback"}
        assert (await page.get("/api/caller")).json() == {"name": "loopback", "role": "view"}


async def test_all_pages_have_the_same_files() -> None:
    paths = [f"/{one.name}" for one in PAGE.iterdir() if one.is_file() and not one.name.endswith(".html")]
    paths += ["/uplot/uPlot.esm.js", "/uplot/uPlot.min.css", "/uplot/LICENSE"]
    found = []
    for names in PROGRAMS:
        async with client(names) as page:
            answers = [await page.get(path) for path in paths]
            assert {each.status_code for each in answers} == {200}
            found.append([(each.headers["content-type"], each.headers["etag"], each.content) for each in answers])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("names", PROGRAMS, ids="+".join)
def test_every_element_that_a_script_looks_for_is_on_its_page(names: list[str]) -> None:
    html = "".join(html_of(names))
    there = set(re.findall(r'\sid="([^"]+)"', html)) | set(re.findall(r'data-badge="([^"]+)"', html))
    there |= {f"tab-{view}" for view in re.findall(r'<section id="(\w+)"', html)}
    made = {"point-input"}
    for name in ("app", *names):
        for script, text in scripts_of(name).items():
            missing = set(re.findall(r'byId\("([^"]+)"\)', text)) - there - made
            assert not missing, f"{script}: {missing}"


def test_no_script_is_left_that_no_page_uses_and_none_is_there_twice() -> None:
    used = set().union(*(scripts_of(name) for name in ("app", *VIEWS)))
    assert used == {one.name for one in PAGE.iterdir() if one.name.endswith(".js")}
    shared = set(scripts_of("simulation")) & set(scripts_of("collector"))
    assert shared >= {"course.js", "charts.js", "dom.js", "link.js", "theme.js", "typed.js"}
    functions: dict[str, str] = {}
    for script in used:
        for name in re.findall(
            r"^(?:export )?(?:async )?(?:function|class) ([a-z]\w+)", scripts_of(script[:-3])[script], re.M
        ):
            if name not in ("start", "update", "moment", "row"):
                assert name not in functions, f"{name} in {functions[name]} and {script}"
                functions[name] = script


async def test_the_files_need_no_token_and_the_api_of_every_module_needs_one() -> None:
    token = AccessToken.of("a-token-that-was-chosen", "anna", Role.OPERATE)
    for names in PROGRAMS:
        async with client(names, PageAccessRules(lambda: (token,))) as page:
            assert (await page.get("/")).status_code == 200
            for path in ("/api/caller", *(f"/api/{name}" for name in names)):
                assert (await page.get(path)).status_code == 401
                with_it = await page.get(path, headers={"Authorization": "Bearer a-token-that-was-chosen"})
                assert with_it.json()["name"] == "anna"
