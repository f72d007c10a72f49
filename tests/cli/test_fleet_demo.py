"""``busway fleet demo``: what it shows, and that nothing of it is left."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from foreign_servers import needed
from left_behind import left_in
from program import Busway
from waiting import wait_until

import busway
from busway.apps.collector.configuration import load_collector
from busway.errors import ConfigError

pytest.importorskip("nats")
pytest.importorskip("msgpack")

COLLECTORS = ("west", "middle", "east")


def lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def children(process: int) -> dict[int, str]:
    """The processes that a process has started and that live, each with its command line."""
    found = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return {int(each): Path(f"/proc/{each}/cmdline").read_text().replace("\0", " ") for each in found}


def polled(folder: Path) -> set[str]:
    """The devices of which the collectors of a demonstration have values."""
    found: set[str] = set()
    for name in COLLECTORS:
        with contextlib.suppress(ConfigError):  # its store is being made
            found |= set(busway.Store(folder / name).read("*/*").device)
    return found


def started(lines: str) -> list[int]:
    return [int(number) for number in re.findall(r"is started, process (\d+)", lines)]


@pytest.mark.real_time
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGHUP], ids=["ctrl-c", "closed terminal"])
def test_ctrl_c_or_a_closed_terminal_ends_the_demonstration_and_all_that_it_has_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: signal.Signals
) -> None:
    needed("nats-server")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Busway("fleet", "demo", alone=True) as program:
        said = "".join(program.wait_for(f"collector {name} is started") for name in COLLECTORS)
        program.wait_for("shards of links")
        below = children(program.process.pid)
        assert set(started(said)) < below.keys()
        others = " ".join(words for number, words in below.items() if number not in started(said))
        assert ("nats-server" in others, " fleet sink archive " in others, len(below)) == (True, True, 5)
        assert all(map(lives, below))
        assert list(tmp_path.iterdir())
        program.process.send_signal(end)
        assert program.process.wait(60) == 0
    assert not any(map(lives, below))
    assert not left_in(tmp_path)


@pytest.mark.real_time
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell a process that its parent has died")
def test_a_killed_demonstration_leaves_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needed("nats-server")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Busway("fleet", "demo") as program:
        program.wait_for("collector west is started")
        own = children(program.process.pid)
        assert len(own) >= 3, own  # nats-server, sink, a collector
        program.process.kill()
        program.process.wait(60)
        wait_until(lambda: not any(map(lives, own)), 60)


@pytest.mark.real_time
def test_the_collectors_of_the_demonstration_poll_two_hundred_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed("nats-server")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Busway("fleet", "demo", alone=True) as program:
        program.wait_for("200 devices on 20 links, in this process")
        program.wait_for("shards of links")
        (folder,) = tmp_path.glob("busway-fleet-demo-*")
        devices = load_collector(str(folder / "plant.toml")).devices
        assert (len(devices), len({device.link for device in devices.values()})) == (200, 20)
        wait_until(lambda: polled(folder) == devices.keys())
        program.stop()


@pytest.mark.soak
def test_a_killed_collectors_links_are_taken_over_and_it_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed("nats-server")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-m", "busway", "fleet", "demo"], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr
    (seconds,) = re.findall(r"after ([\d.]+) s the others poll all links", done.stderr)
    assert 10 < float(seconds) < 30
    (samples,) = re.findall(r"the sink has (\d+) samples", done.stderr)
    assert int(samples) > 2000
    assert not left_in(tmp_path)
    assert not any(map(lives, started(done.stderr)))


def test_without_a_nats_server_one_sentence_says_what_to_install(run: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr("busway.cli.fleet_demo.SERVER_FOLDERS", "/nowhere")
    outcome = run("fleet", "demo")  # type: ignore[operator]
    assert outcome.code == 2
    assert "nats-server: is not installed: apt-get install nats-server" in outcome.err
