"""bench/late_replies.py, shortened: busway gives no caller the reply to another request where a slave answers late."""

import json
import subprocess
import sys
from typing import Any

import foreign
import pytest

SCRIPT = foreign.CHECKOUT / "bench" / "late_replies.py"
READS = 60
SLAVE = ["--reads", str(READS), "--timeout", "0.3", "--late", "0.05", "--late-by", "0.4"]


def measured(master: str) -> dict[str, Any]:
    command = [sys.executable, SCRIPT, *SLAVE, "--only", master, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    if found["left_out"]:
        foreign.missing(found["left_out"])
    assert found["right"] + found["wrong"] + found["errors"] == READS
    return found


@pytest.mark.parametrize("master", ["busway", "busway asyncio"])
def test_busway_takes_no_late_reply_for_another_request(master: str) -> None:
    found = measured(master)
    assert found["wrong"] == 0
    assert found["right"] > READS / 2


@pytest.mark.parametrize("master", ["pymodbus", "minimalmodbus", "libmodbus"])
def test_slave_is_one_at_which_other_masters_take_late_replies_for_those_of_other_requests(master: str) -> None:
    assert measured(master)["wrong"] > 0
