"""``busway collect``: polls until it is stopped, shows its plan without traffic, reads its file again."""

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from left_behind import left_in
from program import Busway
from waiting import until, wait_until

import busway
from busway.apps.collector.configuration import load_collector
from busway.apps.collector.knowledge import DeviceKnowledge, Knowledge, LearntHole
from busway.apps.collector.learnt_file import LearntFile
from busway.apps.collector.store.committer import StoreStatus
from busway.apps.gateway.gateway import Gateway
from busway.cli import demo
from busway.cli.collect import _collect
from busway.cli.collect_demo import collect_demo
from busway.cli.collect_status import print_status
from busway.codes import Table
from busway.server.server import Server

PLANT = """\
[collector]
store = "data"
page = "off"
[poll_class]
all.period = 0.1
[[link]]
name = "a"
url = "{url}"
[[device]]
name = "meter-7"
link = "a"
unit = 1
profile = "meter"
"""


CLOSED = "tcp://127.0.0.1:9"
"""Where nothing listens."""


def written(folder: Path, url: str = CLOSED) -> str:
    file = folder / "plant.toml"
    file.write_text(PLANT.replace("{url}", url))
    return str(file)


def is_stored(folder: Path, device: str) -> bool:
    """Whether a sample of this device is in the store."""
    store = busway.Store(folder / "data")
    return any(point.device == device for point in store.points()) and len(store.read(device)) > 0


def device() -> busway.Device:
    return busway.Device(holding_registers=100, input_registers=200)


def test_the_plan_is_shown_without_traffic(run, tmp_path: Path) -> None:
    result = run("collect", "plan", written(tmp_path))
    assert result.code == 0
    assert "meter-7  all    3x1    34     17" in result.out
    assert "would learn what a read and a register cost" in result.out
    assert "link a: " in result.out
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_plan_opens_no_connection_to_a_device_that_is_there(run, tmp_path: Path, more: list[str]) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        assert run("collect", "plan", written(tmp_path, server.endpoints[0]), *more).code == 0
        assert server.status().counters.accepted == 0
    assert not (tmp_path / "data").exists()


def test_the_plan_as_json_has_a_line_for_each_read_and_link(run, tmp_path: Path) -> None:
    lines = [json.loads(line) for line in run("collect", "plan", written(tmp_path), "--json").out.splitlines()]
    assert lines[0]["first"] == "3x1"
    assert lines[-1]["link"] == "a"
    assert lines[-1]["problems"] == []


def test_a_plan_that_does_not_fit_ends_with_another_code_and_names_the_class(run, tmp_path: Path) -> None:
    file = Path(written(tmp_path))
    file.write_text(file.read_text().replace("0.1", "0.01"))
    result = run("collect", "plan", str(file))
    assert result.code == 4
    assert "give class all a period of" in result.out or "class all has a period of 0.01 s" in result.out


def test_a_file_with_errors_names_all_of_them(run, tmp_path: Path) -> None:
    file = Path(written(tmp_path))
    file.write_text(file.read_text().replace("period", "perod").replace('link = "a"', 'lnk = "a"'))
    result = run("collect", str(file))
    assert result.code == 2
    assert "plant.toml:5: poll_class.all.perod" in result.err
    assert "plant.toml:11: device[0].lnk" in result.err


@pytest.mark.parametrize("action", ["plan", "learnt"])
def test_an_action_without_a_file_says_what_is_missing(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("collect", action)
    assert (result.code, result.err) == (2, f"busway: FILE: is missing: busway collect {action} FILE\n")


@pytest.mark.parametrize("words", [("plans", "x"), ("plan", "x", "y")])
def test_other_words_are_refused(run, words: tuple[str, ...]) -> None:
    assert run("collect", *words).code == 2


def test_what_was_learnt_is_shown_pinned_and_forgotten(run, tmp_path: Path) -> None:
    file = written(tmp_path)
    (tmp_path / "data").mkdir()
    hole = LearntHole(Table.INPUT_REGISTERS, 20, 22, 2)
    knowledge = Knowledge({"meter-7": DeviceKnowledge("meter", "", 0.02, (hole,))})
    LearntFile(tmp_path / "data" / "learnt.json").write(knowledge.text())
    assert "meter-7: input register 20…21: exception 02\n" in run("collect", "learnt", file).out
    assert "(pinned)" in run("collect", "learnt", file, "--pin", "meter-7").out
    assert (
        "meter-7/reactive_power is not read: input registers 20…21 must not be read" in run("collect", "plan", file).out
    )
    assert run("collect", "learnt", file, "--forget", "meter-7").out == ""
    assert run("collect", "learnt", file, "--forget", "meter-9").code == 2
    assert run("collect", file, "--pin", "meter-7").code == 2


@pytest.mark.parametrize(("words", "code"), [((), 2), (("plan",), 0)])
def test_a_system_without_file_locks_refuses_to_collect_and_shows_the_plan(
    tmp_path: Path, words: tuple[str, ...], code: int
) -> None:
    """Such as Windows: what only POSIX has cannot be imported there."""
    missing = "import sys; sys.modules |= dict.fromkeys(('fcntl', 'termios', 'resource', 'pwd', 'grp', 'pty'))"
    arguments = [sys.executable, "-c", f"{missing}; from busway.cli import main; main()", "collect", *words]
    done = subprocess.run([*arguments, written(tmp_path)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code, done.stderr
    assert ("busway: a store cannot be written on this system" in done.stderr) == (code == 2)
    assert len(done.stderr.splitlines()) == (code == 2)
    assert not (tmp_path / "data").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_it_collects_until_it_is_stopped_and_reads_its_file_again(tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = Path(written(tmp_path, server.endpoints[0]))
        with Busway("collect", str(file), "--status-every", "100ms") as program:
            assert "links 1, devices 1, points 26" in program.wait_for("collects into")
            wait_until(lambda: is_stored(tmp_path, "meter-7"))
            file.write_text(file.read_text().replace("meter-7", "meter-8"))
            program.process.send_signal(signal.SIGHUP)
            assert "link a began anew" in program.wait_for("read again")
            file.write_text(file.read_text().replace("0.1", "0.01"))
            program.process.send_signal(signal.SIGHUP)
            assert program.wait_for("warning: ")
            file.write_text(file.read_text().replace("0.01", "0.1"))
            file.write_text(file.read_text().replace("0.1", "none"))
            program.process.send_signal(signal.SIGHUP)
            program.wait_for("nothing was changed")
            wait_until(lambda: is_stored(tmp_path, "meter-8"))
            out, _ = program.stop()
        assert "1 of 1 devices answer" in out


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
async def test_a_hangup_while_the_collector_begins_is_a_reload_once_it_has_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unheard: list[int] = []
    before = signal.signal(signal.SIGHUP, lambda number, frame: unheard.append(number))
    begin, told = busway.Collector.__aenter__, ""

    async def begin_slowly(collector: busway.Collector) -> busway.Collector:
        os.kill(os.getpid(), signal.SIGHUP)
        await asyncio.sleep(0)
        return await begin(collector)

    def has_read_again() -> bool:
        nonlocal told
        told += capsys.readouterr().err
        return "read again: nothing changed" in told

    monkeypatch.setattr(busway.Collector, "__aenter__", begin_slowly)
    try:
        running = asyncio.create_task(_collect(load_collector(written(tmp_path, CLOSED)), 60.0, as_json=False))
        await until(has_read_again)
        os.kill(os.getpid(), signal.SIGTERM)
        await running
        assert unheard == []
    finally:
        signal.signal(signal.SIGHUP, before)


def test_the_status_line_says_that_the_store_cannot_be_written(capsys: pytest.CaptureFixture[str]) -> None:
    status = StoreStatus(12, 340, 15, 0, "database or disk is full", None)
    print_status(StatusOfStore(status), as_json=False)  # type: ignore[arg-type]
    assert capsys.readouterr().out == (
        "340 samples kept, 15 waiting because the store cannot be written: database or disk is full;"
        " 0 of 0 devices answer\n"
        "  link a: 50 % busy, 3.1 % for probes of silent devices\n"
    )


class StatusOfStore:
    """What `print_status` asks of a collector without devices."""

    def __init__(self, status: StoreStatus) -> None:
        self._status = status

    def store_status(self) -> StoreStatus:
        return self._status

    def status(self) -> list[Any]:  # no device
        return []

    sink_statuses = status

    def loads(self) -> dict[str, tuple[float, float]]:
        return {"a": (0.5, 0.031)}


def test_a_second_collector_on_the_store_is_refused_with_the_pid_of_the_first(run, tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = written(tmp_path, server.endpoints[0])
        with Busway("collect", file) as program:
            program.wait_for("collects into")
            result = run("collect", file)
            assert result.code == 2
            assert str(program.process.pid) in result.err
            assert run("collect", "learnt", file, "--forget", "meter-7").code == 2
            program.stop()
    assert os.path.exists(tmp_path / "data" / "learnt.json")


def test_the_page_is_served_and_its_address_is_said(tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = Path(written(tmp_path, server.endpoints[0]))
        file.write_text(file.read_text().replace('"off"', '"127.0.0.1:0"'))
        with Busway("collect", str(file)) as program:
            url = program.wait_for("page on").split("page on ")[1].split()[0]
            with urlopen(url + "api/points", timeout=60) as answer:
                assert len(json.load(answer)["points"]) == 26
            program.stop()


def test_without_a_free_port_the_page_is_left_out_and_polling_goes_on(tmp_path: Path) -> None:
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server,
        socket.create_server(("127.0.0.1", 0)) as taken,
    ):
        file = Path(written(tmp_path, server.endpoints[0]))
        file.write_text(file.read_text().replace('"off"', f'"127.0.0.1:{taken.getsockname()[1]}"'))
        with Busway("collect", str(file), "--status-every", "100ms") as program:
            assert "no page: " in program.wait_for("no page")
            program.wait_for("collects into")
            out, _ = program.stop()
        assert "of 1 devices answer" in out


def page_of(program: Busway) -> str:
    """The address that a program prints for its page."""
    return program.wait_for("page on ").partition("page on ")[2].split()[0]


def answer_of(url: str) -> Any:
    with urlopen(url, timeout=60) as answer:
        return json.load(answer)


def test_the_demo_shows_a_plant_from_its_line_to_the_page_and_ends_by_itself() -> None:
    with Busway("collect", "demo", "--for", "8s") as program:
        points = answer_of(page_of(program) + "api/points")["points"]
        assert {"tank.level", "meter.power", "tank.temperature"} <= {each["point"] for each in points}
        out, _ = program.end()
    assert "of 3 devices answer" in out


def test_the_values_of_the_demo_change_and_have_a_history() -> None:
    with Busway("collect", "demo") as program:
        page = page_of(program)
        names = [each["point"] for each in answer_of(page + "api/points")["points"]]
        energy = names.index("meter.volume")
        seen: set[float] = set()

        def has_changed() -> bool:
            value = answer_of(page + "api/values")["value"][energy]
            if value is not None:
                seen.add(value)
            return len(seen) > 1

        wait_until(has_changed, 20)
        trend = answer_of(page + "api/trend?device=meter&point=meter.volume&seconds=60&buckets=60")
        assert any(value is not None for value in trend["mean"])
        program.stop()


async def test_the_demo_takes_a_free_port_for_its_page_where_the_wanted_one_is_taken(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        running = asyncio.create_task(collect_demo(60.0, f"127.0.0.1:{port}"))
        said = ""
        async with asyncio.timeout(60):
            while "page on " not in said:
                await asyncio.sleep(0.01)
                said += capsys.readouterr().err
        page = said.partition("page on ")[2].split()[0]
        assert f"port {port} is taken" in said
        assert f":{port}/" not in page
        assert (await asyncio.to_thread(answer_of, page + "api/points"))["points"]
        signal.raise_signal(signal.SIGINT)
        await running


async def test_what_the_demo_shows_came_through_a_gateway_from_a_serial_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its devices listen on the line alone; the other end of this line is what the gateway forwards to."""
    servers: list[Server] = []
    gateways: list[tuple[str, Gateway]] = []
    serve, start = demo._devices, demo._started

    def served(plant: Any, url: str) -> Server:
        servers.append(serve(plant, url))
        return servers[0]

    async def started(line: str, port: int) -> Gateway:
        gateways.append((line, await start(line, port)))
        return gateways[0][1]

    monkeypatch.setattr(demo, "_devices", served)
    monkeypatch.setattr(demo, "_started", started)
    running = asyncio.create_task(collect_demo(60.0, "127.0.0.1:0"))
    said, good = "", set[str]()
    async with asyncio.timeout(60):
        while "page on " not in said:
            await asyncio.sleep(0.01)
            said += capsys.readouterr().err
        page = said.partition("page on ")[2].split()[0]
        points = (await asyncio.to_thread(answer_of, page + "api/points"))["points"]
        while len(good) < 3:
            qualities = (await asyncio.to_thread(answer_of, page + "api/values"))["quality"]
            good |= {each["device"] for each, quality in zip(points, qualities, strict=True) if quality == "good"}
    (server,), ((line, gateway),) = servers, gateways
    (listener,) = server.status().listeners
    assert re.fullmatch(r"rtu:///.+/port0\?baud=19200", line)
    assert listener.endpoint.partition("?")[0] == line.partition("?")[0].replace("port0", "port1")
    assert listener.requests >= 3
    assert len(gateway.status().upstreams) == 1
    assert f"behind a gateway on {gateway.endpoints[0]};" in said
    signal.raise_signal(signal.SIGINT)
    await running


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_demo_that_is_interrupted_leaves_no_file_and_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Busway("collect", "demo", alone=True) as program:
        page = page_of(program)
        assert list(tmp_path.glob("busway-demo-*"))
        program.stop(number)
    assert program.process.returncode == 0
    assert left_in(tmp_path) == []
    with pytest.raises(ProcessLookupError):  # its session has no process any more
        os.killpg(program.process.pid, 0)
    with pytest.raises((URLError, ValueError)):  # ValueError: another program has taken the port since
        answer_of(page)


def test_how_long_the_demo_lasts_is_for_the_demo_alone(run, tmp_path: Path) -> None:
    assert run("collect", written(tmp_path), "--for", "1s").code == 2
