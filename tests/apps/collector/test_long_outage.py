"""Servers that are down for a real hour while a collector goes on: all of it arrives, in order, when they are back.

``BUSWAY_OUTAGE_SECONDS`` makes the hour shorter or longer. The same on a clock of its own, in a second:
`sinks/test_hour_outage.py`.
"""

import os
import time
from pathlib import Path

import pytest
from collector_walk import until, walked

LONGEST_SETTLING = 900.0
"""Seconds for what waited: some 200 000 samples for each server, on a machine that does other things."""
SECONDS = float(os.environ.get("BUSWAY_OUTAGE_SECONDS", "3600"))


@pytest.mark.soak
def test_servers_that_were_down_for_an_hour_have_everything_in_order(tmp_path: Path) -> None:
    with walked(tmp_path, 20261122, segment=2_000_000, database=True) as walk:
        assert walk.receivers, "no server is installed"
        walk.write(0.5)
        walk.collecting.start()
        until(walk.is_up, walk.log)
        time.sleep(10)
        for receiver in walk.receivers:
            receiver.server.stop()
        time.sleep(SECONDS / 2)
        walk.kill()
        time.sleep(SECONDS / 2)
        told = {sink["name"]: sink["error"] for sink in walk.ask("sinks")["sinks"]}
        assert all(error for name, error in told.items() if name != "lines"), told
        assert not told["lines"]
        begin = time.monotonic()
        for receiver in walk.receivers:
            receiver.server.start()
        until(lambda: not any(sink["error"] for sink in walk.ask("sinks")["sinks"]), walk.log)
        back = time.monotonic() - begin
        until(lambda: not any(sink["behind"] > 1 for sink in walk.ask("sinks")["sinks"]), walk.log, LONGEST_SETTLING)
        print(f"all answer after {back:.0f} s, and have everything after {time.monotonic() - begin:.0f} s")
        print({device["name"]: device["skipped"] for device in walk.ask("devices")["devices"]})
        walk.settle(LONGEST_SETTLING)
        assert walk.problems()[:20] == []
