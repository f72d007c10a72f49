"""``busway fleet demo``: what it shows, and that nothing of it is left."""

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

pytest.importorskip("nats")
pytest.importorskip("msgpack")

COLLECTORS = ("west", "middle", "east")


def lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


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
        assert len(started(said)) == 3
        assert all(map(lives, started(said)))
        assert list(tmp_path.iterdir())
        program.process.send_signal(end)
        assert program.process.wait(60) == 0
    assert not any(map(lives, started(said)))
    assert not left_in(tmp_path)


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
