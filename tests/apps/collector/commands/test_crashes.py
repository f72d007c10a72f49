"""Collectors that are killed while they write: no key is written twice, and what is not known is said to be unknown."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commanded_plant import RecordedDevice, commanded_plant

import busway
from busway.apps.collector.commands.journal import CUT_OFF

WORKER = Path(__file__).parents[3] / "support" / "command_worker.py"
LIMIT = 60.0


class Plant:
    """A device in this process, and collectors for it in others."""

    def __init__(self, folder: Path, url: str, boiler: RecordedDevice) -> None:
        self.boiler, self.folder = boiler, folder
        self.file = commanded_plant(folder, url, period=0.05)
        self.pid = 0

    def start(self, *words: str) -> "subprocess.Popen[bytes]":
        worker = subprocess.Popen(
            [sys.executable, str(WORKER), str(self.file), "text", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,  # `communicate` does not give what `readline` has read ahead
        )
        assert worker.stdout is not None
        line = worker.stdout.readline()
        assert line.startswith(b"ready"), worker.communicate(timeout=LIMIT)
        self.pid = worker.pid
        return worker

    def run(self, *words: str) -> tuple[int, list[dict[str, Any]]]:
        """Exit code, and the results that were told."""
        worker = self.start(*words)
        output, _ = worker.communicate(timeout=LIMIT)
        return worker.returncode, [json.loads(line) for line in output.splitlines() if line.endswith(b"}")]

    def written(self) -> Counter[str]:
        """How often each value was written."""
        return Counter(
            b"".join(item.to_bytes(2, "big") for item in items).rstrip(b"\0").decode()
            for _, _, items in self.boiler.writes
        )


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    boiler = RecordedDevice()
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: boiler.device}) as server:
        yield Plant(tmp_path, server.endpoints[0], boiler)


@pytest.mark.parametrize(
    ("step", "writes", "state"),
    [("claimed", 0, "unknown"), ("sent", 1, "unknown"), ("answered", 1, "unknown"), ("recorded", 1, "done")],
)
def test_a_key_is_written_at_most_once_wherever_the_collector_is_killed(
    plant: Plant, step: str, writes: int, state: str
) -> None:
    if step == "sent":  # by the device, when the request has arrived and nothing was answered
        plant.boiler.before.append(lambda change: os.kill(plant.pid, signal.SIGKILL))
    code, told = plant.run("0", "1", step)
    assert (code, told) == (-signal.SIGKILL, [])
    plant.boiler.before.clear()
    assert plant.written()["k0"] == writes
    code, told = plant.run("0", "2")
    assert code == 0
    assert (told[0]["key"], told[0]["state"]) == ("k0", state)
    assert told[0]["reason"] == (CUT_OFF if state == "unknown" else "")
    assert told[1]["state"] == "done"
    assert plant.written() == Counter({"k0": writes, "k1": 1})
    lines = [json.loads(line) for line in (plant.folder / "data" / "audit.log").read_text().splitlines()]
    assert [line["outcome"] for line in lines if line.get("key") == "k0"][-1:] == [state]


def kill_at_random(plant: Plant, kills: int, seed: int) -> None:
    """Give the same commands again and again to collectors that are killed; then check what was written."""
    chance, said = random.Random(seed), dict[str, str]()
    for _ in range(kills):
        worker = plant.start("0", "400")
        time.sleep(chance.uniform(0.0, 0.3))
        worker.kill()
        output, _ = worker.communicate(timeout=LIMIT)
        note(said, [json.loads(line) for line in output.splitlines() if line.endswith(b"}")])
    code, told = plant.run("0", "400")
    assert code == 0
    note(said, told)
    written = plant.written()
    assert max(written.values()) == 1
    assert all(written[key] == 1 for key, state in said.items() if state == "done")
    assert set(said.values()) <= {"done", "unknown"}
    assert len(said) == 400
    assert sum(state == "unknown" for state in said.values()) <= kills


def note(said: dict[str, str], told: list[dict[str, Any]]) -> None:
    """What was told of a key once stays true."""
    for each in told:
        assert said.setdefault(each["key"], each["state"]) == each["state"]


def test_collectors_that_are_killed_at_random_write_no_key_twice(plant: Plant) -> None:
    kill_at_random(plant, 3, seed=1)


@pytest.mark.soak
def test_collectors_that_are_killed_a_hundred_times_write_no_key_twice(plant: Plant) -> None:
    kill_at_random(plant, 100, seed=2)
