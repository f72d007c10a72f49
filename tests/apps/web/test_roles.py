"""What each role may do, tried for every route that there is: without a token, with each role, from other sites.

Routes come from the applications themselves, so a new one is tried as soon as it is added.
"""

import http.client
import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import httpx
import pytest
from fastapi import Depends, FastAPI
from fastapi.routing import APIRoute
from page_collector import WatchedCollector, watched_collector
from page_plant import watched
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from busway.apps.web.request_guard import (
    CHANGING,
    AccessToken,
    Caller,
    PageAccess,
    PageAccessRules,
    RequiredRole,
    Role,
    require,
)

OTHER_ORIGINS = ["http://evil.example", "null", "http://127.0.0.1:1", "https://evil.example:8503"]
OTHER_SITES = ["cross-site", "same-site"]
FOREIGN_HOSTS = ["evil.example", "127.0.0.1.evil.example", "10.0.0.7", "plant.example:8503", ""]
WRONG_TOKENS = ["", "x", "wrong-token-of-no-user-here", "view", "Bearer", "é"]


class Guarded:
    """A page on an address of the network, or on loopback, and its tokens by role."""

    def __init__(self, plant: WatchedCollector) -> None:
        self.plant = plant
        self.port = int(plant.page.url.rstrip("/").rpartition(":")[2])
        lines = plant.page.token_path.read_text().splitlines()
        self.tokens = {line.split()[0]: line.split()[1] for line in lines if line[0] != "#"}

    def ask(self, method: str, path: str, token: str | None = None, **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.putrequest(method, path, skip_host=True)
            sent = {"Host": f"127.0.0.1:{self.port}", **{key.replace("_", "-"): each for key, each in headers.items()}}
            if token is not None:
                sent["Authorization"] = f"Bearer {token}"
            body = b"{}" if method in CHANGING else b""
            if body:
                sent = {"Content-Type": "application/json", "Content-Length": str(len(body)), **sent}
            for name, value in sent.items():
                connection.putheader(name, value.encode("utf-8"))
            connection.endheaders(body)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read())
        finally:
            connection.close()


@pytest.fixture(scope="module", params=["127.0.0.1:0", "0.0.0.0:0"], ids=["loopback", "network"])
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with watched_collector(tmp_path_factory.mktemp("plant"), request.param) as plant:
        yield Guarded(plant)


@pytest.fixture(scope="module")
def on_loopback(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with watched_collector(tmp_path_factory.mktemp("plant")) as plant:
        yield Guarded(plant)


@pytest.fixture(scope="module")
def on_network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with watched_collector(tmp_path_factory.mktemp("plant"), "0.0.0.0:0") as plant:
        yield Guarded(plant)


def routes_of(application: FastAPI) -> list[tuple[str, str, Role]]:
    """Method, path with its parameters filled, and the role that it declares, of every route."""
    found = []
    for route in application.routes:
        methods = getattr(route, "methods", None) or ()
        path = re.sub(r"{[^}]*}", "x", getattr(route, "path", ""))
        found += [(method, path, declared(route)) for method in sorted(methods) if method != "HEAD"]
    return found


def declared(route: Any) -> Role:
    if isinstance(route, APIRoute):
        for each in route.dependant.dependencies:
            if isinstance(each.call, RequiredRole):
                return each.call.role
    return Role.VIEW


def changing(page: Guarded) -> list[tuple[str, str, Role]]:
    return [each for each in routes_of(page.plant.page.resources()) if each[0] in CHANGING]


def test_every_route_that_changes_something_says_which_role_it_needs(on_loopback: Guarded) -> None:
    for method, path, role in changing(on_loopback):
        assert role >= Role.OPERATE, f"{method} {path}"


def test_the_routes_that_change_something_are_tried(on_loopback: Guarded) -> None:
    paths = {path for _, path, _ in changing(on_loopback)}
    assert paths >= {
        "/api/commands",
        "/api/commands/arm",
        "/api/commands/x/confirm",
        "/api/configuration",
        "/api/alarms/acknowledge",
        "/api/devices/x/maintenance",
    }


def test_without_a_token_nothing_is_changed(page: Guarded) -> None:
    for method, path, _ in changing(page):
        assert page.ask(method, path)[0] in (401, 403), f"{method} {path}"


def test_a_wrong_token_is_refused_everywhere_and_not_taken_for_none(page: Guarded) -> None:
    for method, path, _ in routes_of(page.plant.page.resources()):
        for token in WRONG_TOKENS:
            assert page.ask(method, path, token)[0] == 401, f"{method} {path} {token!r}"


@pytest.mark.parametrize("role", list(Role), ids=lambda role: role.label)
def test_a_role_changes_what_it_may_and_nothing_else(page: Guarded, role: Role) -> None:
    for method, path, needed in changing(page):
        status, answer = page.ask(method, path, page.tokens[role.label])
        if role >= needed:
            assert status not in (401, 403), f"{method} {path}: {answer}"
        else:
            assert (status, "needs the role" in answer["error"]) == (403, True), f"{method} {path}: {answer}"


@pytest.mark.parametrize("role", list(Role), ids=lambda role: role.label)
def test_each_role_may_view(page: Guarded, role: Role) -> None:
    assert page.ask("GET", "/api/values", page.tokens[role.label])[0] == 200
    assert page.ask("GET", "/api/caller", page.tokens[role.label]) == (200, {"name": role.label, "role": role.label})


def test_a_page_of_another_origin_changes_nothing_with_any_token(page: Guarded) -> None:
    for method, path, _ in changing(page):
        for token in (None, *page.tokens.values()):
            for origin in OTHER_ORIGINS:
                assert page.ask(method, path, token, Origin=origin)[0] == 403, f"{method} {path} {origin}"
            for site in OTHER_SITES:
                assert page.ask(method, path, token, Sec_Fetch_Site=site)[0] == 403, f"{method} {path} {site}"


def test_a_name_that_was_pointed_at_loopback_reaches_nothing_with_any_token(on_loopback: Guarded) -> None:
    for method, path, _ in routes_of(on_loopback.plant.page.resources()):
        for token in (None, *on_loopback.tokens.values()):
            for host in FOREIGN_HOSTS:
                assert on_loopback.ask(method, path, token, Host=host)[0] == 403, f"{method} {path} {host}"


def test_what_a_form_can_send_changes_nothing(page: Guarded) -> None:
    for method, path, _ in changing(page):
        for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
            status = page.ask(method, path, page.tokens["configure"], Content_Type=kind)[0]
            assert status == 415, f"{method} {path} {kind}"


def test_on_loopback_callers_without_a_token_may_view(on_loopback: Guarded) -> None:
    assert on_loopback.ask("GET", "/api/caller") == (200, {"name": "loopback", "role": "view"})
    assert on_loopback.ask("GET", "/api/values")[0] == 200


def test_elsewhere_callers_without_a_token_get_nothing_but_the_files_of_the_page(on_network: Guarded) -> None:
    for method, path, _ in routes_of(on_network.plant.page.resources()):
        assert on_network.ask(method, path)[0] == 401, f"{method} {path}"
    assert on_network.plant.page.token == ""
    assert "token" not in on_network.plant.page.announced_url


def test_a_token_in_the_address_is_none(on_network: Guarded) -> None:
    for name in ("token", "access_token", "authorization"):
        assert on_network.ask("GET", f"/api/values?{name}={on_network.tokens['configure']}")[0] == 401


def test_tokens_are_in_no_log_whatever_its_level(on_network: Guarded, caplog: pytest.LogCaptureFixture) -> None:
    token = on_network.tokens["operate"]
    with caplog.at_level(logging.DEBUG):
        on_network.ask("GET", "/api/values", token)
        on_network.ask("GET", "/api/values", token[:-1])
        on_network.ask("POST", "/api/values", token)
        url = f"ws://127.0.0.1:{on_network.port}/nothing"
        with pytest.raises(InvalidStatus), connect(url, subprotocols=["busway", f"bearer.{token}"], proxy=None):
            pass
    said = [each for each in caplog.records if not each.name.startswith("websockets.client")]
    assert any("a wrong token was shown" in each.getMessage() for each in said)
    assert not [each for each in said if token[:-1] in each.getMessage()]


# The rules themselves, with a route for each role and one that forgot its own.


def guarded_routes(rules: PageAccessRules) -> PageAccess:
    inner = FastAPI()

    async def named(caller: Caller) -> dict[str, str]:
        return {"name": caller.name}

    def add(path: str, role: Role) -> None:
        async def answer(caller: Annotated[Caller, Depends(require(role))]) -> dict[str, str]:
            return await named(caller)

        inner.add_api_route(path, answer, methods=["POST"])

    for role in Role:
        add(f"/{role.label}", role)

    async def forgot() -> dict[str, str]:
        return {}

    inner.add_api_route("/forgot", forgot, methods=["POST"])
    return PageAccess(inner, rules, lambda path: False)


async def post(application: Any, path: str, token: str = "") -> httpx.Response:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    async with httpx.AsyncClient(transport=httpx.ASGITransport(application), base_url="http://127.0.0.1") as client:
        return await client.post(path, headers=headers)


TOKENS = tuple(AccessToken.of(f"the-token-to-{role.label}", f"one who may {role.label}", role) for role in Role)


@pytest.mark.parametrize("needed", [Role.OPERATE, Role.CONFIGURE])
@pytest.mark.parametrize("shown", [None, *Role])
async def test_a_route_is_for_its_role_and_those_above(needed: Role, shown: Role | None) -> None:
    routes = guarded_routes(PageAccessRules(lambda: TOKENS, without_token=Role.VIEW))
    answer = await post(routes, f"/{needed.label}", "" if shown is None else f"the-token-to-{shown.label}")
    if shown is not None and shown >= needed:
        assert answer.json() == {"name": f"one who may {shown.label}"}
    else:
        assert answer.status_code == 403
        assert needed.label in answer.text or "operate" in answer.text


async def test_a_route_that_forgets_its_role_still_needs_that_to_operate() -> None:
    routes = guarded_routes(PageAccessRules(lambda: TOKENS, without_token=Role.VIEW))
    assert (await post(routes, "/forgot")).status_code == 403
    assert (await post(routes, "/forgot", "the-token-to-view")).status_code == 403
    assert (await post(routes, "/forgot", "the-token-to-operate")).status_code == 200


async def test_a_token_is_wrong_where_all_were_removed_and_is_not_taken_for_none() -> None:
    routes = guarded_routes(PageAccessRules(tuple, without_token=Role.OPERATE))
    assert (await post(routes, "/operate", "the-token-to-operate")).status_code == 401
    assert (await post(routes, "/operate")).status_code == 200


async def test_a_route_behind_no_rules_of_access_knows_no_caller_and_refuses() -> None:
    inner = FastAPI()

    async def answer(caller: Annotated[Caller, Depends(require(Role.VIEW))]) -> dict[str, str]:
        return {"name": caller.name}

    inner.add_api_route("/bare", answer, methods=["POST"])
    assert (await post(inner, "/bare")).status_code == 401


def test_every_route_of_the_simulators_page_needs_its_token() -> None:
    with watched(token="a-token-that-was-chosen") as plant:
        for method, path, role in routes_of(plant.page.resources()):
            assert method not in CHANGING or role >= Role.OPERATE, f"{method} {path}"
            for headers in ({}, {"Authorization": "Bearer a-token-that-was-chose"}):
                assert plant.ask(method, path, **headers)[0] == 401, f"{method} {path}"


def test_the_files_of_tokens_are_kept_over_a_restart(tmp_path: Path) -> None:
    with watched_collector(tmp_path) as first:
        before = first.page.token_path.read_text()
        assert first.page.token_path.parent == Path(first.collector.configuration.store)
    with watched_collector(tmp_path) as second:
        assert second.page.token_path.read_text() == before
