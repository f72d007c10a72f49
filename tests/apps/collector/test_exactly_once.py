"""Every sample that was shown or handed on is in the store once, and sinks have all, also where the collector dies.

One random walk (`collector_walk`) kills and ends the collector, takes sinks away, reads, copies and restores the store
meanwhile.
"""

import os
from pathlib import Path

import pytest
from collector_walk import check_a_walk

SEED = int(os.environ.get("BUSWAY_WALK_SEED", "20261122"))


@pytest.mark.real_time
@pytest.mark.timeout(120)
def test_what_was_shown_or_handed_on_is_kept_once_and_sinks_have_it_all(tmp_path: Path) -> None:
    check_a_walk(tmp_path, SEED, None)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(SEED, SEED + 5))
def test_the_same_over_long_walks(tmp_path: Path, seed: int) -> None:
    check_a_walk(tmp_path, seed, 150)


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_retention_takes_the_oldest_and_nothing_that_sinks_lack(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    check_a_walk(tmp_path, SEED, 75, "keep_days = 2\n")
