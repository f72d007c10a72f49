"""Commands and the configuration over HTTP: who may, what is answered, and that a refusal sends or changes nothing."""

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import pytest
from commanded_plant import RecordedDevice, commanded_plant

import busway
from busway.apps.collector.collector import Collector
from busway.apps.web.access_tokens import TOKEN_FILE
from busway.apps.web.collector_page import CollectorPage


class Plant:
    """A collector with its page, in a thread of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.boiler = folder, RecordedDevice()
        self.page: CollectorPage
        self.collector: Collector
        self._ready, self._loop, self._end = threading.Event(), asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._run()), daemon=True)

    async def _run(self) -> None:
        async with self.boiler.server() as server:
            self.url = server.endpoints[0]
            self.file = commanded_plant(self.folder, self.url)
            async with (
                busway.collect(self.file) as self.collector,
                CollectorPage(self.collector, "127.0.0.1:0") as page,
            ):
                self.page = page
                async with asyncio.timeout(60):
                    async for batch in self.collector.samples():
                        if "setpoint" in batch.points:
                            break
                self._ready.set()
                await self._end.wait()

    def __enter__(self) -> "Plant":
        self._thread.start()
        assert self._ready.wait(30)
        return self

    def __exit__(self, *error: object) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(30)
        self._loop.close()

    def ask(
        self, method: str, path: str, body: Any = None, *, role: str = "operate", kind: str = "application/json"
    ) -> tuple[int, Any]:
        """Status and content of an answer, for a caller of a role; an empty one shows no token."""
        connection = HTTPConnection(urlsplit(self.page.url).netloc, timeout=60)
        headers = {"Content-Type": kind} if body is not None else {}
        if role:
            headers["Authorization"] = f"Bearer {self.tokens[role]}"
        try:
            content = body if isinstance(body, str | None) else json.dumps(body)
            connection.request(method, path, None if content is None else content.encode(), headers)
            with contextlib.closing(connection.getresponse()) as answer:
                return answer.status, json.load(answer)
        finally:
            connection.close()

    @property
    def tokens(self) -> dict[str, str]:
        lines = (self.folder / "data" / TOKEN_FILE).read_text().splitlines()
        return {words[0]: words[1] for words in map(str.split, lines) if words[0] != "#"}


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with Plant(tmp_path_factory.mktemp("plant")) as running:
        yield running


@pytest.fixture(autouse=True)
def _no_writes(plant: Plant) -> None:
    plant.boiler.writes.clear()


def command(point: str, value: Any, **more: Any) -> dict[str, Any]:
    return {"device": "boiler", "point": point, "value": value, **more}


def test_a_command_is_armed_confirmed_and_sent_once(plant: Plant) -> None:
    status, armed = plant.ask("POST", "/api/commands/arm", command("setpoint", 21.5))
    assert (status, plant.boiler.writes) == (200, [])
    assert (armed["device"], armed["point"], armed["value"], armed["old"]["quality"]) == (
        "boiler",
        "setpoint",
        21.5,
        "good",
    )
    assert armed["confirm"].startswith("Write 21.5 °C to boiler/setpoint, now ")
    assert 0 < armed["expires"] - time.time() <= 60
    path = f"/api/commands/{quote(armed['key'])}/confirm"
    status, done = plant.ask("POST", path)
    assert (status, done["state"], done["read_back"], done["reason"]) == (200, "done", 21.5, None)
    assert plant.ask("POST", path) == (200, done)
    assert plant.boiler.writes == [("holding_registers", 0, [215])]
    newest = plant.ask("GET", "/api/commands?limit=1", role="view")[1]["commands"]
    assert newest == [done]
    assert (newest[0]["by"], newest[0]["origin"], newest[0]["old"]) == ("operate", "page", armed["old"]["value"])


@pytest.mark.parametrize(
    ("point", "value", "status", "sentence"),
    [
        ("setpoint", "21,5", 422, "a number is needed"),
        ("setpoint", 1000, 422, "must be 0…100"),
        ("setpoint", None, 422, "null is no value"),
        ("mode", "manual", 422, "there are off, auto, hand"),
        ("level", 3, 422, "only read"),
        ("setpoints", 3, 404, "there is no point"),
    ],
)
def test_what_cannot_be_written_is_refused_with_a_sentence_when_it_is_armed(
    plant: Plant, point: str, value: Any, status: int, sentence: str
) -> None:
    found, answer = plant.ask("POST", "/api/commands/arm", command(point, value))
    assert found == status
    assert sentence in answer["error"]
    assert plant.boiler.writes == []


def test_a_key_that_was_not_armed_is_not_there(plant: Plant) -> None:
    assert plant.ask("POST", "/api/commands/busway-0/confirm")[0] == 404


def test_a_journal_that_cannot_be_read_is_said_and_is_no_error_of_the_server(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*asked: object) -> None:
        raise OSError("the journal of commands cannot be read: disk I/O error")

    said = {"error": "the journal of commands cannot be read: disk I/O error"}
    for name in ("find", "newest"):
        monkeypatch.setattr(plant.collector.commands._journal, name, unreadable)
    assert plant.ask("POST", "/api/commands/busway-0/confirm") == (503, said)
    assert plant.ask("GET", "/api/commands", role="view") == (503, said)


def test_a_program_writes_in_one_step_with_a_key_of_its_own(plant: Plant) -> None:
    asked = command("mode", "hand", key="order-1", expires=time.time() + 20)
    status, done = plant.ask("POST", "/api/commands", asked)
    assert (status, done["state"], done["origin"], done["key"]) == (200, "done", "api", "order-1")
    assert plant.ask("POST", "/api/commands", asked) == (200, done)
    status, other = plant.ask("POST", "/api/commands", {**asked, "value": "auto"})
    assert (status, other["state"]) == (200, "refused")
    assert "used for another command" in other["reason"]
    assert plant.boiler.writes == [("holding_registers", 1, [2])]
    late = plant.ask("POST", "/api/commands", command("mode", "auto", expires=time.time() - 1))[1]
    assert late["state"] == "expired"
    assert plant.ask("POST", "/api/commands", command("mode", "auto"))[0] == 422  # without an expiry
    assert plant.ask("POST", "/api/commands", {**asked, "at_once": True})[0] == 422


@pytest.mark.parametrize(
    ("method", "path", "least"),
    [
        ("POST", "/api/commands/arm", "operate"),
        ("POST", "/api/commands/busway-0/confirm", "operate"),
        ("POST", "/api/commands", "operate"),
        ("GET", "/api/configuration", "configure"),
        ("POST", "/api/configuration", "configure"),
    ],
)
@pytest.mark.parametrize("role", ["", "view", "operate"])
def test_without_the_role_nothing_is_written_or_configured(
    plant: Plant, method: str, path: str, least: str, role: str
) -> None:
    if role == least:
        return
    body = command("setpoint", 1, expires=time.time() + 20) if method == "POST" else None
    status, answer = plant.ask(method, path, body, role=role)
    assert status == 403
    assert "needs the role" in answer["error"]
    assert plant.boiler.writes == []


def test_a_configuration_is_refused_as_a_whole_with_each_line_and_key(plant: Plant) -> None:
    held = plant.ask("GET", "/api/configuration", role="configure")[1]
    assert held["text"] == plant.file.read_text()
    wrong = held["text"].replace("unit = 1", "unit = 300\nunti = 1")
    status, answer = plant.ask("POST", "/api/configuration", wrong, role="configure", kind="application/toml")
    assert status == 422
    assert {problem["key"] for problem in answer["problems"]} == {"device[0].unit", "device[0].unti"}
    assert all(problem["line"] and problem["file"] == str(plant.file) for problem in answer["problems"])
    assert plant.file.read_text() == held["text"]
    assert plant.ask("GET", "/api/configuration", role="configure")[1] == held


def test_a_configuration_is_replaced_in_its_file_and_for_its_revision_alone(plant: Plant) -> None:
    held = plant.ask("GET", "/api/configuration", role="configure")[1]
    text = held["text"] + '[[link]]\nname = "b"\nurl = "tcp://127.0.0.1:1"\n'
    text += '[[device]]\nname = "other"\nlink = "b"\nunit = 2\nprofile = "valve.toml"\n'
    path = f"/api/configuration?revision={held['revision']}"
    status, answer = plant.ask("POST", path, text, role="configure", kind="application/toml")
    assert (status, answer["done"]) == (200, ["link b began"])
    assert plant.file.read_text() == text
    status, stale = plant.ask("POST", path, held["text"], role="configure", kind="application/toml")
    assert status == 422
    assert "read it again" in stale["error"]
    status, answer = plant.ask("POST", "/api/configuration", held["text"], role="configure", kind="application/toml")
    assert (status, answer) == (200, {"revision": held["revision"], "done": ["link b ended"]})


def test_another_store_is_refused_and_the_file_stays(plant: Plant) -> None:
    held = plant.ask("GET", "/api/configuration", role="configure")[1]
    text = held["text"].replace('store = "data"', 'store = "other"')
    status, answer = plant.ask("POST", "/api/configuration", text, role="configure", kind="application/toml")
    assert status == 422
    assert "restart it" in answer["error"]
    assert plant.file.read_text() == held["text"]
