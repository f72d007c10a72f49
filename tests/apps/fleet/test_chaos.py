"""Real collectors, devices, engines and a sink, to which faults happen; judged from outside by `fleet_checker`.

Leases are shorter here than those of a plant (15 s), so that the runs are short: each prints how long it took.
"""

import os
import random
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from fleet_chaos import Run, Scenario
from fleet_checker import Logs, histogram, holes, judged, stood_still

from busway.apps.fleet.lease_times import LeaseTimes

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(600)]

SHORT = LeaseTimes(ttl=3.0, renew=0.6, guard=0.3, answer=0.8)
ELECTED = LeaseTimes(ttl=5.0, renew=1.0, guard=0.5, answer=1.5)
"""Not all leases lapse while three servers of NATS elect a leader."""
SCENARIOS = [
    Scenario("local", 1, ["freeze", "away", "kill"], SHORT, calm=1.0),
    Scenario("postgresql", 2, ["freeze", "cut", "leader", "kill"], SHORT, calm=1.0),
    Scenario("nats", 3, ["freeze", "cut", "leader", "sink_dies", "kill"], ELECTED, calm=1.0),
]
EDGES = [1.2, 2.0, 3.0, 4.3, 5.0, 6.5, 10.0, float("inf")]


def needs(backend: str) -> None:
    if backend != "local":
        pytest.importorskip("nats" if backend == "nats" else "asyncpg")
    if backend == "nats":
        pytest.importorskip("msgpack")


def run(folder: Path, scenario: Scenario) -> tuple[Run, Logs]:
    folder.chmod(0o755)
    with Run(folder, scenario) as made:
        made.go()
        logs = made.logs()
    if scenario.backend != "local" and not made.is_parted:
        print("without partitions of hosts: this process may make no network namespaces")
    return made, logs


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.backend)
def test_whatever_strikes_a_fleet_each_link_has_one_master_and_nothing_that_was_acknowledged_is_missing(
    tmp_path: Path, scenario: Scenario
) -> None:
    needs(scenario.backend)
    began = time.monotonic()
    made, logs = run(tmp_path, scenario)
    print(f"{scenario.backend}: {', '.join(scenario.faults)} in {time.monotonic() - began:.0f} s")
    problems = judged(logs, scenario.bounds)
    assert not problems, "\n".join([*problems, made.story()])
    print(f"struck: {made.struck(logs)}")


@pytest.mark.parametrize(
    ("mutants", "scenario", "finds"),
    [
        (["no deadline", "no compare-and-set"], Scenario("local", 1, ["away"], SHORT, period=0.05), " after "),
        (["acknowledgement too early"], Scenario("nats", 1, ["sink_dies"], SHORT, parts=False), "not in the sink"),
    ],
    ids=["two masters", "samples that are lost"],
)
def test_the_checker_catches_a_fleet_that_breaks_a_rule(
    tmp_path: Path, mutants: list[str], scenario: Scenario, finds: str
) -> None:
    needs(scenario.backend)

    def found(mutant: str) -> list[str]:
        folder = tmp_path / mutant.replace(" ", "-")
        folder.mkdir()
        return judged(run(folder, replace(scenario, mutant=mutant))[1], scenario.bounds)

    with ThreadPoolExecutor() as both:
        for mutant, sentences in zip(mutants, both.map(found, mutants), strict=True):
            assert [each for each in sentences if finds in each], mutant


@pytest.mark.soak
def test_a_rolling_restart_under_load_leaves_no_hole_above_a_period_and_a_second(tmp_path: Path) -> None:
    scenario = Scenario("local", 1, ["restart"], LeaseTimes(), calm=1.0)
    made, logs = run(tmp_path, scenario)
    found = holes(logs, scenario.bounds.unrecorded)
    long = [each for each in found if each[2] - each[1] - stood_still(logs, *each[1:]) > scenario.bounds.unrecorded]
    problems = [*judged(logs, scenario.bounds), *map(str, long)]
    assert not problems, "\n".join([*problems, made.story()])


def shuffled(scenario: Scenario, seed: int) -> Scenario:
    """A longer scenario, whose faults come in another order."""
    faults = [*scenario.faults, *scenario.faults, "nap", "away", "kill", "freeze"]
    random.Random(seed).shuffle(faults)
    return replace(scenario, seed=seed, faults=faults)


@pytest.mark.soak
@pytest.mark.timeout(6000)
def test_an_hour_of_faults(tmp_path: Path) -> None:
    """As long as BUSWAY_CHAOS_SECONDS says, an hour without it. Prints what docs/performance.md has of holes."""
    until = time.monotonic() + float(os.environ.get("BUSWAY_CHAOS_SECONDS", "3600"))
    lengths: dict[str, list[float]] = {scenario.backend: [] for scenario in SCENARIOS}
    faults = 0
    seed = 100
    while time.monotonic() < until:
        for scenario in SCENARIOS:
            needs(scenario.backend)
            seed += 1
            folder = tmp_path / str(seed)
            folder.mkdir()
            longer = shuffled(scenario, seed)
            made, logs = run(folder, longer)
            faults += len(longer.faults)
            problems = judged(logs, scenario.bounds)
            assert not problems, "\n".join([f"seed {seed}", *problems, made.story()])
            made.struck(logs)
            lengths[scenario.backend] += [end - begin for _, begin, end in holes(logs, 1.0)]
        print(f"{seed - 100} runs, {faults} faults; holes in seconds below:")
        for backend, of_backend in lengths.items():
            print(f"{backend}: {histogram(of_backend, EDGES)}, longest {max(of_backend, default=0.0):.1f}", flush=True)
