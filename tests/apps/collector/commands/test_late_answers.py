"""A write on a serial line whose answer comes late: unknown, never repeated, and no answer of what comes after it."""

import time
from pathlib import Path

import pytest
from late_unit import LateUnit
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.collector.commands.command import CommandState

pytestmark = pytest.mark.real_time

UNIT = """\
[[unit]]
unit = 1

[[unit.point]]
name = "speed"
address = "4x1"
write = { function = 6, verify = "read-back" }
"""
PLANT = """\
[collector]
store = "data"
page = "off"
[poll_class]
all.period = 3600
[[link]]
name = "hall"
url = "{url}"
timeout = 0.6
write_retries = 2
[[device]]
name = "drive"
link = "hall"
unit = 1
profile = "drive.toml"
"""


class FirstWrite:
    """The requests that take long: the first write."""

    def __init__(self, unit: LateUnit) -> None:
        self.unit = unit

    def __contains__(self, number: object) -> bool:
        return self.unit.heard[-1][0] == 6 and sum(pdu[0] == 6 for pdu in self.unit.heard) == 1


async def test_a_late_answer_leaves_the_command_unknown_and_it_is_not_sent_again(tmp_path: Path) -> None:
    (tmp_path / "drive.toml").write_text(UNIT)
    with line_of_whole_frames(ports=2, baud=115_200) as line, LateUnit("rtu", path=line.paths[1], hiccups=()) as unit:
        (tmp_path / "plant.toml").write_text(PLANT.format(url=f"rtu://{line.paths[0]}?baud=115200"))
        async with busway.collect(tmp_path / "plant.toml") as collector:
            await until(lambda: collector.status()[0].state == "polled")
            unit.hiccups = FirstWrite(unit)
            result = await collector.write("drive", "speed", 100, by="anna", key="late")
            assert result.state is CommandState.UNKNOWN
            assert "may have been executed" in result.reason
            assert await collector.write("drive", "speed", 100, by="bernd", key="late") == result
            limit = time.monotonic() + 30
            while True:  # nothing is sent while the line is in doubt
                later = await collector.write("drive", "speed", 200, by="anna")
                if later.is_done:
                    break
                assert later.state in (CommandState.FAILED, CommandState.REFUSED), later
                assert "nothing was sent" in later.reason
                assert time.monotonic() < limit
            assert later.read_back == 200
    writes = [int.from_bytes(pdu[3:5], "big") for pdu in unit.heard if pdu[0] == 6]
    assert writes == [100, 200]
