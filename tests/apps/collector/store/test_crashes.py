"""A store whose process is ended by SIGKILL: at each named step of writing, sealing and dropping, and at random."""

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import store_worker
from store_checker import check_after_crash, handed_on

from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.folder import SEGMENTS, StoreLock

pytest.importorskip("pyarrow")

STEPS = (
    ("segment-listed", 1),
    ("segment-made", 1),
    ("segment-listed", 2),
    ("segment-made", 2),
    ("before-commit", 1),
    ("before-commit", 4),
    ("after-commit", 4),
    ("handed-on", 4),
    ("segment-closed", 1),
    ("seal-written", 2),
    ("seal-begun", 2),
    ("seal-renamed", 2),
    ("seal-folder-synced", 2),
    ("seal-listed", 2),
    ("seal-unlinked", 2),
    ("drop-listed", 1),
    ("drop-unlinked", 1),
)


def work(folder: Path, *options: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, store_worker.__file__, str(folder), *options])


@pytest.mark.parametrize(("step", "times"), STEPS)
def test_a_store_is_whole_after_a_kill_at_any_step(tmp_path: Path, step: str, times: int) -> None:
    with work(tmp_path, "--end-at", step, "--times", str(times), "--commits", "12", "--keep", "1e9") as worker:
        assert worker.wait(60) == -signal.SIGKILL
    check_after_crash(tmp_path, handed_on(tmp_path), begins=10_000)
    assert check_store_files(tmp_path) == []
    unlisted = [path.name for path in (tmp_path / SEGMENTS).iterdir() if path.name.endswith(".unfinished")]
    assert unlisted == []


@pytest.mark.parametrize("seed", range(3))
def test_a_store_is_whole_after_kills_at_random_moments(tmp_path: Path, seed: int) -> None:
    kill_at_random(tmp_path, random.Random(seed), kills=3)


@pytest.mark.soak
def test_a_store_is_whole_after_a_hundred_kills(tmp_path: Path) -> None:
    for seed in range(20):
        kill_at_random(tmp_path / str(seed), random.Random(seed), kills=5)


def kill_at_random(folder: Path, moments: random.Random, *, kills: int) -> None:
    """Let a worker write, end it at some moment, check, and go on in the same store."""
    folder.mkdir(exist_ok=True)
    for crash in range(kills):
        first = crash * 100_000
        with work(folder, "--first", str(first), "--commits", "100000") as worker:
            until = time.monotonic() + 30
            while not any(number >= first for number in handed_on(folder)) and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(moments.uniform(0, 0.6))
            worker.send_signal(signal.SIGKILL)
            worker.wait(60)
        begins = (crash + 1) * 100_000 * store_worker.SECONDS_PER_COMMIT - 5
        check_after_crash(folder, handed_on(folder), begins=begins, crashes=crash + 1)
        assert check_store_files(folder) == []


def test_a_store_whose_writer_has_just_ended_is_opened_although_its_lock_is_still_held(tmp_path: Path) -> None:
    program = f"""
import os, subprocess
from pathlib import Path
from busway.apps.collector.store.folder import StoreLock
lock = StoreLock(Path({str(tmp_path)!r}))
subprocess.Popen(["sleep", "0.5"], pass_fds=[lock._handle], stdout=subprocess.DEVNULL)
print("started", flush=True)
os.kill(os.getpid(), 9)
"""
    ended = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (-signal.SIGKILL, b"started\n")
    StoreLock(tmp_path).release()
