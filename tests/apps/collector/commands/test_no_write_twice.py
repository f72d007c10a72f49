"""No command is written twice, by whom and on whichever way it comes: a walk by chance over a real collector.

Devices record each write on their wire; people, programs and brokers command; the collector is killed, ended and begun
anew. The oracle (`command_walk`) is written from the documentation.
"""

import os
import time
from pathlib import Path

import pytest
from command_plant import CommandedPlant
from command_walk import CommandWalk
from wire_recorder import WireRecorder

SEED = int(os.environ.get("BUSWAY_WALK_SEED", "20261122"))


def walk(folder: Path, seed: int, steps: int, ends: int) -> None:
    """Walk, and fail with what was written twice, without right, too late, or not told."""
    print(f"seed {seed}, {steps} steps")
    with WireRecorder() as wire:
        plant = CommandedPlant(folder, wire)
        try:
            plant.start()
            plant.wait_until_up()
            walking = CommandWalk(plant, seed)
            walking.run(steps, ends)
            walking.settle()
            wrong = walking.problems()
        finally:
            plant.close()
    assert wrong[:20] == []


@pytest.mark.timeout(600)  # it starts a program several times
def test_a_walk_over_a_collector_that_is_killed_writes_no_command_twice(tmp_path: Path) -> None:
    walk(tmp_path, SEED, 50, 2)


@pytest.mark.soak
def test_many_walks_write_no_command_twice(tmp_path: Path) -> None:
    end = time.monotonic() + float(os.environ.get("BUSWAY_WALK_SECONDS", "600"))
    seed = SEED
    while time.monotonic() < end:
        folder = tmp_path / str(seed)
        folder.mkdir()
        walk(folder, seed, 200, 6)
        seed += 1
