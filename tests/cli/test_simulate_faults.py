"""`busway simulate --fault`: faults of a file and of the command line, played on what is served."""

import subprocess
import sys
from pathlib import Path

import pytest

import busway
from busway.testing import FAULT_PROFILES

PROGRAM = [sys.executable, "-m", "busway", "simulate"]

FILE = """\
listen = ["tcp://127.0.0.1:0"]

[[unit]]
unit = 3

[[unit.point]]
name = "level"
address = "4x1"
value = 5

[[unit]]
unit = 4

[[unit.point]]
name = "level"
address = "4x1"
value = 6

[[fault]]
name = "monday"
fault_profile = "busy"
units = 3
on = false
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A simulation file with a fault that is off."""
    path = tmp_path / "plant.toml"
    path.write_text(FILE)
    return path


def _run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*PROGRAM, *arguments], capture_output=True, text=True, timeout=60, check=False)


def test_faults_of_the_file_and_of_the_command_line_are_played(file: Path) -> None:
    words = ["--fault", "monday", "--fault", "unit=255:units=4"]
    with subprocess.Popen(
        [*PROGRAM, str(file), *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            endpoint = process.stdout.readline().strip()
            with busway.connect(endpoint, timeout=5, retries=0) as link:
                with pytest.raises(busway.ExceptionReply) as refused:
                    link.unit(3).read("4x1")
                assert refused.value.code == 6
                with pytest.raises(busway.BadReply) as broken:
                    link.unit(4).read("4x1")
                assert broken.value.reason == "unit 255 answered where 4 was asked"
            process.terminate()
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "fault monday: answers exception 06 for some time; seconds=60, units=3" in said
    assert "fault unit=255: answers as unit 255" in said


def test_check_names_the_faults_and_plays_none(file: Path) -> None:
    done = _run(str(file), "--check", "--fault", "late:delay=2,units=1-3")
    assert done.returncode == 0
    assert done.stdout.splitlines()[-2:] == [
        "fault monday: busy, off; seconds=60, units=3",
        "fault late: late, on; delay=2, units=1-3",
    ]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("lazy", "--fault lazy: lazy: there is no fault profile 'lazy'; there are late,"),
        ("late:delay=x", "--fault late:delay=x: delay: must be a number, true or false, not 'x'"),
        (
            "noise",
            "--fault noise: it would never strike: noise strikes on RTU and ASCII, on a line or over a network only, "
            "and no listener is one of them",
        ),
        ("hole:units=9", "--fault hole:units=9: it would never strike: no unit 9 is simulated; there are 3, 4"),
        ("late:delay=-1", "--fault late:delay=-1: delay: must be 0…86400, not -1"),
    ],
)
def test_fault_that_there_is_not_is_said_with_its_words(file: Path, words: str, sentence: str) -> None:
    done = _run(str(file), "--check", "--fault", words)
    assert done.returncode == 2
    assert f"busway: {sentence}" in done.stderr
    assert "Traceback" not in done.stderr


def test_fault_of_a_file_that_cannot_be_is_said_with_its_line(file: Path) -> None:
    file.write_text(FILE + "parameters = { seconds = -1.0 }\n")
    done = _run(str(file), "--check")
    assert done.returncode == 2
    assert done.stderr.startswith(f"{file}:24: fault[0].parameters.seconds: must be 0…86400, not -1")


def test_place_of_the_page_is_refused_with_an_example_of_its_own(file: Path) -> None:
    done = _run(str(file), "--api", "foo")
    assert done.returncode == 2
    assert "--api: an address such as 127.0.0.1:8502 is needed, not 'foo'" in done.stderr


def test_list_needs_no_file() -> None:
    done = _run("--list-faults")
    assert done.returncode == 0
    assert [line.split()[0] for line in done.stdout.splitlines() if not line.startswith(" ")] == list(FAULT_PROFILES)


def test_fault_of_lines_is_taken_where_a_listener_has_frames_of_lines(file: Path) -> None:
    done = _run(str(file), "--check", "--fault", "noise", "--listen", "rtu+tcp://127.0.0.1:0")
    assert done.returncode == 0
    assert done.stdout.splitlines()[-1] == "fault noise: noise, on; size=3, before=true, after=true"


def test_fault_of_the_file_that_no_request_can_meet_is_told(file: Path) -> None:
    file.write_text(FILE.replace("units = 3\non = false", "units = 9"))
    done = _run(str(file), "--check")
    assert done.returncode == 0
    assert "busway: fault monday never strikes: no unit 9 is simulated; there are 3, 4" in done.stderr


def test_begin_and_end_of_a_timed_fault_are_told_without_a_request(file: Path) -> None:
    done = _run(str(file), "--fault", "wedged:from=0.1,for=0.1", "--for", "2s")
    assert done.returncode == 0
    told = [line for line in done.stderr.splitlines() if "wedged" in line]
    assert told == [
        "busway: fault wedged: the socket is up and Modbus is dead; from=0.1, for=0.1; begins in 0.1 s",
        "busway: fault wedged begins",
        "busway: fault wedged ends",
    ]
