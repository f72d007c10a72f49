"""`busway status`: asking running programs, found by themselves or named."""

import asyncio
import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from control_sockets import short_directory
from program import Busway
from prometheus_client.parser import text_string_to_metric_families

import busway
from busway.apps.collector.running_notes import find_collectors, noted
from busway.apps.control import Control, ask, control_directories, find_running


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A place of its own where programs are found."""
    with short_directory() as path:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(path))
        monkeypatch.setattr("tempfile.tempdir", str(path))
        monkeypatch.setenv("TMPDIR", str(path))
        yield path


@contextmanager
def serving(home: Path, at: str | None = None, *, name: str = "plant", stuck: bool = False) -> Iterator[str]:
    """A server with control in a thread; where it answers. ``stuck``: its event loop is busy with something else."""
    ready, stop = threading.Event(), threading.Event()
    found: list[str] = []

    async def run() -> None:
        server = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)})
        async with server, Control(server, at, name=name) as control:
            found.append(str(control.address))
            found.append(server.endpoints[0])
            ready.set()
            if stuck:
                stop.wait()
            await asyncio.to_thread(stop.wait)

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    assert ready.wait(10)
    try:
        yield found[0]
    finally:
        stop.set()
        thread.join()


def endpoint_of(result: Any) -> str:
    """The endpoint in the JSON of a result."""
    return json.loads(result.out)["status"]["endpoints"][0]


@pytest.mark.clause("T34")
@pytest.mark.clause("S19")
def test_a_running_serve_is_found_and_tells_of_its_connections(home: Path, run: Callable[..., Any]) -> None:
    with Busway("serve", "--listen", "tcp://127.0.0.1:0") as program:
        program.wait_for("unit 1 has")
        # Its endpoints are printed once all of it stands, the control socket too.
        assert program.process.stdout is not None
        endpoint = program.process.stdout.readline().decode().strip()
        with busway.connect(endpoint) as link:
            link.unit(1).read_holding_registers(0, count=2)
            result = run("status")
            assert result.code == 0, result.err
            lines = result.out.splitlines()
            assert endpoint in lines[0]
            assert f"process {program.process.pid}" in lines[0]
            assert "1 remote connection of" in result.out
            heading = next(line for line in lines if line.startswith("listener"))
            assert {"communication", "error", "device"} <= set(heading.split())
            (connection,) = [line for line in lines if line.startswith("127.0.0.1:")]
            assert endpoint in connection
            assert "12 B" in connection  # a request; its answer has 13
            assert "13 B" in connection
            named = run("status", str(program.process.pid), "--json")
            assert json.loads(named.out)["pid"] == program.process.pid
        program.stop(signal.SIGTERM)
    gone = run("status")
    assert (gone.code, gone.out) == (5, "")
    assert "no server, gateway or collector of yours is running" in gone.err
    assert list((home / "busway").iterdir()) == []


def test_a_serve_that_was_killed_is_not_found_and_its_socket_is_replaced(home: Path, run: Callable[..., Any]) -> None:
    path = str(home / "plant.sock")
    for _ in range(2):
        with Busway("serve", "--listen", "tcp://127.0.0.1:0", "--control", path) as program:
            assert program.process.stdout is not None
            assert program.process.stdout.readline().startswith(b"tcp://")
            assert run("status", path).code == 0
            program.process.kill()
        result = run("status", path)
        assert result.code == 5
        assert path in result.err


@pytest.mark.parametrize("at", [None, "127.0.0.1:0"], ids=["unix", "loopback"])
def test_what_is_told_is_the_same_over_both_ways(home: Path, run: Callable[..., Any], at: str | None) -> None:
    with serving(home, at) as address:
        found, named = run("status", "--json"), run("status", address, "--json")
        assert found.code == named.code == 0
        assert endpoint_of(found) == endpoint_of(named)
        assert run("status", address).out.startswith("plant on tcp://127.0.0.1:")


def test_several_programs_are_listed(home: Path, run: Callable[..., Any]) -> None:
    with ExitStack() as stack:
        for name in ("mill", "kiln"):
            stack.enter_context(serving(home, name=name))
        stack.enter_context(serving(home, "127.0.0.1:0", name="silo"))
        result = run("status")
        assert result.code == 0
        heading, *lines = result.out.splitlines()
        assert heading.split() == ["process", "name", "state", "uptime", "connections", "endpoints"]
        assert sorted(line.split()[1] for line in lines) == ["kiln", "mill", "silo"]
        told = [json.loads(line) for line in run("status", "--json").out.splitlines()]
        assert sorted(one["name"] for one in told) == ["kiln", "mill", "silo"]
        assert all(run("status", one["control"]).code == 0 for one in told)


def test_a_program_that_does_not_answer_is_said_and_does_not_hide_the_others(
    home: Path, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.control.service.Control._in_loop.__defaults__", (0.05,))
    with serving(home, name="stuck", stuck=True) as address:
        alone = run("status", address)
        assert alone.code == 3
        assert "did not answer within" in alone.err
        with serving(home, name="mill"):
            result = run("status")
            assert result.code == 0
            assert "mill" in result.out
            assert "did not answer within" in result.err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["/nowhere/x.sock"], 5, "/nowhere/x.sock: no program answers"),
        (["http://127.0.0.1:1"], 2, "no token for http://127.0.0.1:1"),
        (["http://10.0.0.1:80"], 2, "only an address of this host's loopback"),
        (["--watch", "soon"], 2, "--watch: a time such as"),
        (["--watch", "10ms"], 2, "--watch: a time of 0.1"),
    ],
)
def test_what_cannot_be_asked_is_named(
    home: Path, run: Callable[..., Any], arguments: list[str], code: int, words: str
) -> None:
    result = run("status", *arguments)
    assert (result.code, result.out) == (code, "")
    (sentence,) = result.err.splitlines()
    assert words in sentence


def test_a_socket_of_something_else_is_no_server(home: Path, run: Callable[..., Any]) -> None:
    path = home / "other.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def greet() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(b"220 mail.example.org ready\r\n")

        thread = threading.Thread(target=greet)
        thread.start()
        result = run("status", str(path))
        thread.join()
    assert result.code == 6
    assert "no answer in HTTP" in result.err


def test_watching_shows_again_says_a_failure_and_ends_by_ctrl_c(home: Path) -> None:
    with serving(home) as address, Busway("status", address, "--watch", "100ms", "--json") as program:
        assert program.process.stdout is not None
        first, second = (json.loads(program.process.stdout.readline()) for _ in range(2))
        assert first["pid"] == second["pid"]
        assert second["status"]["uptime"] > first["status"]["uptime"]
        program.process.send_signal(signal.SIGINT)
        _, err = program.end()
        assert program.process.returncode == 0
        assert err == ""
    with serving(home) as address:
        watching = Busway("status", address, "--watch", "100ms")
        assert watching.process.stdout is not None
        assert watching.process.stdout.readline().startswith(b"plant on")
    with watching:
        assert "no program answers" in watching.wait_for("no program")
        watching.stop()
        assert watching.process.returncode == 0


def test_refusals_of_a_policy_are_told_by_rule(home: Path, run: Callable[..., Any]) -> None:
    with Busway("serve", "--listen", "tcp://127.0.0.1:0", "--policy", "read-only") as program:
        assert program.process.stdout is not None
        endpoint = program.process.stdout.readline().decode().strip()
        with busway.connect(endpoint) as link, pytest.raises(busway.ExceptionReply):
            link.unit(1).write_single_register(0, 1)
        result = run("status")
    _, _, refused = result.out.partition("refused by rule\n")
    assert refused.split()[-1] == "1"


def test_the_metrics_of_a_running_serve_are_scraped_and_read_over_its_control_socket(home: Path) -> None:
    with Busway("serve", "--listen", "tcp://127.0.0.1:0", "--metrics", "127.0.0.1:0") as program:
        assert program.process.stdout is not None
        endpoint = program.process.stdout.readline().decode().strip()
        with busway.connect(endpoint) as link:
            for address in (0, 0, 999):
                with suppress(busway.ExceptionReply):
                    link.unit(1).read_holding_registers(address, count=2)
        (running,) = find_running(*control_directories())
        counted = {
            (sample.labels["function"], sample.labels["exception"]): sample.value
            for family in text_string_to_metric_families(ask(running, "/metrics"))
            for sample in family.samples
            if sample.name == "busway_requests_total"
        }
        assert counted == {("3", "none"): 2, ("3", "02"): 1}


def test_a_running_serve_reads_its_policy_again_when_it_is_told(home: Path) -> None:
    policy = home / "policy.toml"
    policy.write_text('[policy]\ndefault = "deny"\n')
    with Busway("serve", "--listen", "tcp://127.0.0.1:0", "--policy", str(policy)) as program:
        assert program.process.stdout is not None
        endpoint = program.process.stdout.readline().decode().strip()
        (running,) = find_running(*control_directories())
        with busway.connect(endpoint) as link:
            with pytest.raises(busway.ExceptionReply, match="exception 01"):
                link.unit(1).read_holding_registers(0, count=1)
            policy.write_text("default = [")
            with pytest.raises(busway.ConfigError, match=r"policy\.toml"):
                ask(running, "/reload", method="POST")
            policy.write_text('[policy]\ndefault = "allow"\n')
            assert ask(running, "/reload", method="POST")["reloaded"]
            assert link.unit(1).read_holding_registers(0, count=1) == [0]


COLLECTOR = """
[collector]
store = "{store}"
page = "127.0.0.1:0"

[poll_class.normal]
period = 1

[[link]]
name = "line"
url = "tcp://127.0.0.1:1"

[[device]]
name = "tank"
link = "line"
unit = 1
profile = "tank.toml"
"""
TANK = """
[[unit]]
unit = 1
point = [{ name = "level", address = "4x1" }]
"""


def test_a_running_collector_is_named_with_its_page_and_gone_with_its_process(
    home: Path, run: Callable[..., Any]
) -> None:
    (home / "tank.toml").write_text(TANK)
    file, store = home / "plant.toml", home / "samples"
    file.write_text(COLLECTOR.format(store=store))
    with Busway("collect", str(file)) as program:
        page = program.wait_for("page on").split()[3]
        pid = str(program.process.pid)
        result = run("status")
        assert result.code == 0, result.err
        heading, row, _, hint = result.out.splitlines()
        assert heading.split() == ["process", "collector", "store", "page"]
        assert row.split() == [pid, str(file), str(store), page]
        assert "its page" in hint
        told = json.loads(run("status", "--json").out)
        assert (told["pid"], told["page"], told["is_in_fleet"]) == (program.process.pid, page, False)
        assert row in run("status", pid).out
        with serving(home):
            both = run("status").out
            assert both.startswith("plant on tcp://127.0.0.1:")
            assert row in both
        program.process.kill()
        program.process.wait(60)
        gone = run("status")  # its note is left behind
        assert (gone.code, gone.out) == (5, "")
    with Busway("collect", str(file)) as program:
        program.wait_for("collects into")
        program.stop(signal.SIGTERM)
    assert not (home / "busway" / f"{program.process.pid}.collector").exists()


def test_paths_of_a_running_collector_are_whole_as_status_is_asked_from_elsewhere(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(home)
    monkeypatch.setattr("busway.apps.collector.running_notes.holder_of", lambda folder: os.getpid())
    Path("plant.toml").touch()
    for file, told in (("plant.toml", str(home / "plant.toml")), ("zone hall", "zone hall")):
        with noted(file, "samples", "", is_in_fleet=False):
            (found,) = find_collectors(*control_directories())
            assert (found.file, found.store) == (told, str(home / "samples"))
    assert find_collectors(*control_directories()) == []


def test_a_word_that_collect_does_not_know_as_an_action_leads_to_the_page(run: Callable[..., Any]) -> None:
    result = run("collect", "status", "plant.toml")
    assert result.code == 2
    assert "which busway status names" in result.err
