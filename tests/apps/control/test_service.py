"""The control service of a running server, asked over its real socket."""

import asyncio
import http.client
import json
import os
import socket
import stat
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from control_sockets import connected, exchange, received, short_directory
from handles import settled_handles
from waiting import until

import busway
from busway.apps.control import Control, Running, UnixAddress, ask, client, find_running, open_control
from busway.apps.control.client import find_one
from busway.apps.control.service import RELOAD_SECONDS
from busway.errors import ConfigError, LinkDown, NoReply
from busway.observe.http_messages import HttpRequest, HttpResponse

LOOPBACK = "127.0.0.1:0"


@pytest.fixture
def directory() -> Iterator[Path]:
    with short_directory() as path:
        yield path


@dataclass
class Subject:
    """Has a status, and nothing more."""

    connections: list[str] = field(default_factory=lambda: ["a", "b"])

    def status(self) -> Any:
        assert threading.current_thread() is threading.main_thread()
        return self


@pytest.fixture(params=[None, LOOPBACK], ids=["unix", "loopback"])
def at(request: pytest.FixtureRequest) -> str | None:
    return request.param


def running(directory: Path) -> Running:
    """The only one that runs."""
    (found,) = find_running(directory)
    return found


def files_of(directory: Path) -> list[Path]:
    """What stands in it."""
    return list(directory.iterdir())


async def asked(directory: Path, resource: str = "/status", method: str = "GET") -> Any:
    """The answer of the only one that runs, asked from another thread as another program would."""
    return await asyncio.to_thread(lambda: ask(running(directory), resource, method=method))


@pytest.mark.clause("T34")
async def test_the_whole_state_of_a_server_is_readable(directory: Path, at: str | None) -> None:
    device = busway.Device(holding_registers=10)
    server = busway.serve("tcp://127.0.0.1:0", units={1: device}, max_connections=7)
    async with server, Control(server, at, name="plant", directory=directory), busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=2)
        answer = await asked(directory)
        connections = await asked(directory, "/connections")
    assert (answer["name"], answer["pid"], answer["version"]) == ("plant", os.getpid(), busway.__version__)
    status = answer["status"]
    assert status["running"] is True
    assert status["uptime"] > 0
    assert len(status["endpoints"]) == 1
    assert status["counters"]["accepted"] == 1
    assert status["counters"]["requests"] == 1
    (connection,) = status["connections"]
    assert connection["received"] == 12
    assert connection["requests"] == 1
    assert connections["connections"][0]["peer"] == connection["peer"]


@pytest.mark.clause("S19")
async def test_the_indicators_of_each_listener_are_words(directory: Path) -> None:
    server = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)})
    async with server, Control(server, directory=directory):
        (listener,) = (await asked(directory))["status"]["listeners"]
    assert listener["indicators"] == {"communication": "off", "error": "off", "device_status": "on"}


@pytest.mark.clause("T34")
async def test_counters_are_reset_without_ending_a_connection(directory: Path, at: str | None) -> None:
    server = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)})
    async with server, Control(server, at, directory=directory):
        async with busway.open(server.endpoints[0]) as link:
            await link.unit(1).read_holding_registers(0, count=1)
            assert await asked(directory, "/reset-counters", "POST") == {"reset": True}
            counters = (await asked(directory))["status"]["counters"]
            assert not any(count for count in counters.values() if isinstance(count, int))
            await link.unit(1).read_holding_registers(0, count=1)
            assert (await asked(directory))["status"]["counters"]["requests"] == 1
        await until(lambda: not server.status().connections)
        counters = (await asked(directory))["status"]["counters"]
        assert (counters["requests"], counters["closed"]) == (1, 1)


async def test_a_subject_offers_what_it_can_and_no_more(directory: Path) -> None:
    async with Control(Subject(), directory=directory):
        assert (await asked(directory, "/connections"))["connections"] == ["a", "b"]
        assert "POST /reload" not in (await asked(directory, "/"))["resources"]
        for method, resource, words in (
            ("POST", "/reset-counters", "cannot be reset"),
            ("POST", "/reload", "there is no POST /reload"),
            ("GET", "/metrics", "there is no GET /metrics"),
            ("GET", "/../etc", "there is no GET"),
            ("POST", "/status", "there is no POST /status"),
            ("GET", "/reset-counters", "there is no GET"),
        ):
            with pytest.raises(ConfigError, match=words):
                await asked(directory, resource, method)


async def test_reloading_is_done_in_the_loop_of_the_subject_and_its_failure_is_told(directory: Path) -> None:
    loop = asyncio.get_running_loop()
    outcomes: list[Any] = [{"rules": 3}, ConfigError("unit must be 1…247", file="plant.toml", line=3)]

    async def reload() -> Any:
        assert asyncio.get_running_loop() is loop
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    async with Control(Subject(), directory=directory, reload=reload):
        assert await asked(directory, "/reload", "POST") == {"reloaded": {"rules": 3}}
        with pytest.raises(ConfigError, match=r"plant\.toml:3: unit must be"):
            await asked(directory, "/reload", "POST")


async def test_metrics_are_those_that_the_owner_gives(directory: Path) -> None:
    def answer(request: HttpRequest) -> HttpResponse:
        return HttpResponse(b"busway_up 1\n")

    async with Control(Subject(), directory=directory, metrics=answer):
        assert await asked(directory, "/metrics") == "busway_up 1\n"


async def test_a_status_that_fails_is_an_answer_and_not_the_end(directory: Path) -> None:
    class Broken:
        def status(self) -> Any:
            raise ValueError("a bug")

    async with Control(Broken(), directory=directory):
        for _ in range(2):
            with pytest.raises(busway.BadReply, match="status 500"):
                await asked(directory)


def test_a_stuck_event_loop_is_told_and_not_waited_for(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.control.service.GATHER_SECONDS", 0.05)
    monkeypatch.setattr("busway.apps.control.service.Control._in_loop.__defaults__", (0.05,), raising=False)

    async def run() -> None:
        async with Control(Subject(), directory=directory):
            # Asked from the very thread that would have to answer.
            with pytest.raises(NoReply, match="did not answer within"):
                ask(running(directory), timeout=10)

    asyncio.run(run())


async def test_socket_and_directory_are_the_users_alone_and_are_taken_away(directory: Path) -> None:
    control = Control(Subject(), directory=directory)
    async with control:
        assert isinstance(control.address, UnixAddress)
        path = control.address.path
        assert path == directory / f"{os.getpid()}.sock"
        assert stat.S_ISSOCK(path.stat().st_mode)
        assert path.stat().st_mode & 0o777 == 0o600
    assert files_of(directory) == []
    assert control.address is None
    assert not [thread for thread in threading.enumerate() if thread.name == "busway control"]


async def test_the_token_is_the_users_alone_and_is_taken_away(directory: Path) -> None:
    async with Control(Subject(), LOOPBACK, directory=directory) as control:
        (path,) = files_of(directory)
        assert path.stat().st_mode & 0o777 == 0o600
        content = json.loads(path.read_text())
        assert content["url"] == str(control.address)
        assert len(content["token"]) >= 32
    assert files_of(directory) == []


async def test_two_in_one_process_have_sockets_of_their_own(directory: Path) -> None:
    async with Control(Subject(), directory=directory, name="one"), Control(Subject(), directory=directory, name="two"):
        names = [(await asyncio.to_thread(ask, one))["name"] for one in find_running(directory)]
    assert sorted(names) == ["one", "two"]


async def test_what_a_dead_program_left_behind_is_replaced(directory: Path) -> None:
    for name in ("plant.sock", "99999999.sock"):
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(directory / name))
    async with Control(Subject(), str(directory / "plant.sock"), directory=directory):
        assert str(running(directory)) == str(directory / "plant.sock")
        assert (await asked(directory))["pid"] == os.getpid()
    async with Control(Subject(), directory=directory):
        assert [path.name for path in files_of(directory)] == [f"{os.getpid()}.sock"]


async def test_where_a_living_program_answers_it_is_left_alone(directory: Path) -> None:
    path = str(directory / "plant.sock")
    async with Control(Subject(), path, directory=directory, name="first"):
        with pytest.raises(LinkDown, match="a running program answers there"):
            await Control(Subject(), path, directory=directory).start()
        assert (await asked(directory))["name"] == "first"


async def test_a_file_that_is_no_socket_is_left_alone(directory: Path) -> None:
    path = directory / "plant.sock"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="is no socket"):
        await Control(Subject(), str(path), directory=directory).start()
    assert path.read_text() == "precious"


async def test_a_path_that_no_socket_can_have_is_refused(directory: Path) -> None:
    with pytest.raises(ConfigError, match="longer than"):
        await Control(Subject(), str(directory / ("x" * 100)), directory=directory).start()
    with pytest.raises(LinkDown, match=r"can ?not listen on"):
        await Control(Subject(), str(directory / "gone" / "x"), directory=directory).start()


async def test_at_the_end_only_the_own_socket_is_taken_away(directory: Path) -> None:
    path = directory / "plant.sock"
    async with Control(Subject(), str(path), directory=directory):
        path.unlink()
        path.write_text("another program's")
    assert path.read_text() == "another program's"


async def test_a_control_can_be_started_again(directory: Path) -> None:
    control = Control(Subject(), directory=directory)
    for _ in range(2):
        async with control:
            await control.start()  # it is started already: nothing happens
            assert await asked(directory)
        await control.stop()


async def test_starting_asking_and_stopping_again_and_again_keeps_no_handle(directory: Path, at: str | None) -> None:
    handles = []
    for _ in range(12):
        async with Control(Subject(), at, directory=directory) as control:
            await asked(directory)
            unfinished = connected(str(control.address))
            unfinished.sendall(b"GET /sta")
        unfinished.close()
        handles.append(settled_handles())
    assert max(handles[3:]) <= handles[2]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        (["Host: {host}", "Authorization: Bearer {token}"], 200),
        (["Host: localhost:1", "Authorization: Bearer {token}"], 200),
        (["Host: [::1]:1", "Authorization: Bearer {token}"], 200),
        (["Host: {host}"], 401),
        (["Host: {host}", "Authorization: Bearer {token}x"], 401),
        (["Host: {host}", "Authorization: Bearer "], 401),
        (["Host: {host}", "Authorization: {token}"], 401),
        (["Host: evil.example", "Authorization: Bearer {token}"], 403),
        (["Host: 127.0.0.1.evil.example:80", "Authorization: Bearer {token}"], 403),
        (["Host: 10.0.0.1:80", "Authorization: Bearer {token}"], 403),
        (["Authorization: Bearer {token}"], 403),
        (["Host: {host}", "Origin: http://evil.example", "Authorization: Bearer {token}"], 403),
    ],
)
async def test_over_loopback_only_the_token_opens_and_no_web_page_does(
    directory: Path, headers: list[str], status: int
) -> None:
    async with Control(Subject(), LOOPBACK, directory=directory) as control:
        token = running(directory).token
        host = str(control.address).removeprefix("http://")
        lines = [one.format(host=host, token=token) for one in ("GET /status HTTP/1.1", *headers)]
        request = "\r\n".join([*lines, "", ""]).encode()
        answer = await asyncio.to_thread(exchange, str(control.address), request)
    assert answer[9:12] == str(status).encode()
    assert (b'"connections"' in answer) is (status == 200)


async def test_the_token_is_asked_for_until_the_last_moment(directory: Path) -> None:
    control = Control(Subject(), LOOPBACK, directory=directory)
    await control.start()
    with connected(str(control.address)) as connection:
        connection.sendall(b"GET /status HTTP/1.1\r\nHost: 127.0.0.1:1\r\n\r\n")
        await control.stop()
        assert b'"connections"' not in received(connection)


async def test_a_peer_of_another_user_is_closed_unread(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Control(Subject(), directory=directory) as control:
        monkeypatch.setattr(os, "getuid", lambda: 12345)
        request = b"GET /status HTTP/1.1\r\n\r\n"
        answer = await asyncio.to_thread(exchange, str(control.address), request)
        # Root may ask every process, and runs the tests in some places.
        monkeypatch.undo()
        assert (answer == b"") is (os.getuid() != 0)


async def test_a_wrong_token_and_a_dead_address_are_told_apart(directory: Path) -> None:
    async with Control(Subject(), LOOPBACK, directory=directory):
        found = running(directory)
        with pytest.raises(ConfigError, match="token is missing or wrong"):
            await asyncio.to_thread(ask, Running(found.address, "wrong"))
        assert find_one(str(found.address), directory) == found
    assert find_running(directory) == []
    with pytest.raises(LinkDown, match="no program answers"):
        await asyncio.to_thread(ask, found)
    with pytest.raises(LinkDown, match="no program answers"):
        await asyncio.to_thread(ask, Running(UnixAddress(directory / "none.sock")))
    with pytest.raises(ConfigError, match="no token for"):
        find_one(str(found.address), directory)


async def test_a_program_is_found_by_its_process_id(directory: Path) -> None:
    async with Control(Subject(), directory=directory) as control:
        assert find_one(str(os.getpid()), directory).address == control.address
        assert find_one(str(control.address), directory).address == control.address


@pytest.mark.parametrize("url", ["/tmp/x", "name", 5, None, []])
def test_a_token_file_without_an_address_of_http_is_not_ours_and_left_out(directory: Path, url: Any) -> None:
    (directory / "1-2.json").write_text(json.dumps({"url": url, "token": "t"}), encoding="utf-8")
    assert find_running(directory) == []


@pytest.mark.parametrize(("resource", "method", "seconds"), [("/status", "GET", 5), ("/reload", "POST", 35)])
def test_a_reload_is_waited_for_longer_than_the_service_takes_for_it(
    directory: Path, monkeypatch: pytest.MonkeyPatch, resource: str, method: str, seconds: float
) -> None:
    asked: list[float] = []

    class NoConnection(http.client.HTTPConnection):
        def __init__(self, address: object, timeout: float) -> None:
            super().__init__("localhost", timeout=timeout)
            asked.append(timeout)

        def connect(self) -> None:
            raise ConnectionRefusedError

    monkeypatch.setattr(client, "_Connection", NoConnection)
    with pytest.raises(LinkDown):
        ask(Running(UnixAddress(directory / "none.sock")), resource, method=method)
    assert asked == [seconds]
    assert seconds > RELOAD_SECONDS or resource != "/reload"


async def test_a_default_socket_that_cannot_be_had_is_lived_without(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(directory))
    (directory / "busway").write_text("in the way")
    async with open_control(Subject()) as control:
        assert control is None
    assert "without a control socket" in caplog.text
    with pytest.raises(LinkDown):
        async with open_control(Subject(), str(directory / "gone" / "x")):
            pass
    (directory / "busway").unlink()
    async with open_control(Subject(), "off") as control:
        assert control is None
        assert not (directory / "busway").exists()
    async with open_control(Subject(), name="plant") as control:
        assert control is not None
        assert (await asked(directory / "busway"))["name"] == "plant"
