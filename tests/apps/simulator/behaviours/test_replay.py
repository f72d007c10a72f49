"""Recordings: what a file of them may be, and what is replayed."""

import pytest

from busway.apps.simulator.behaviours.replay import Replay, parse_recording
from busway.config.files.file_error import FileError

TEXT = """\
# a morning
time,value
10,1.5

11, 2.5
13;on
"""


def test_lines_are_read_from_their_first_time_on() -> None:
    recording = parse_recording(TEXT, "x.csv")
    assert recording.times == (0, 1, 3)
    assert recording.values == (1.5, 2.5, 1.0)
    assert recording.length == 5


def test_a_replay_steps_from_line_to_line_and_begins_anew() -> None:
    replay = Replay(parse_recording(TEXT, "x.csv"), "repeat", "step")
    assert [replay.value(float(time)) for time in range(7)] == [1.5, 2.5, 2.5, 1, 1, 1.5, 2.5]
    assert replay.state(1.0) is None


def test_a_replay_can_hold_its_last_value_and_go_in_straight_lines() -> None:
    replay = Replay(parse_recording(TEXT, "x.csv"), "hold", "line")
    assert [replay.value(time) for time in (0.0, 0.5, 2.0, 3.0, 100.0)] == [1.5, 2.0, 1.75, 1.0, 1.0]


def test_one_line_is_a_recording() -> None:
    replay = Replay(parse_recording("0,7", "x.csv"), "repeat", "line")
    assert replay.value(12345.6) == 7.0


@pytest.mark.parametrize(
    ("text", "line", "sentence"),
    [
        ("", 1, "there is no line"),
        ("time,value\n", 1, "there is no line"),
        ("0,1\n0,2\n", 2, "times rise, but 0 comes after 0"),
        ("0,1\n1\n", 2, "a line is time,value"),
        ("0,1\n1,2,3\n", 2, "a line is time,value"),
        ("0,1\n1,x\n", 2, "the value is no number: 'x'"),
        ("0,1\nnan,1\n", 2, "the time is no number"),
        ("0,1\n1,1_0\n", 2, "the value is no number"),
        ("0,1\ntime,value\n", 2, "the time is no number"),
    ],
)
def test_what_is_no_recording_is_refused_with_its_line(text: str, line: int, sentence: str) -> None:
    with pytest.raises(FileError) as caught:
        parse_recording(text, "x.csv")
    assert (caught.value.file, caught.value.line) == ("x.csv", line)
    assert sentence in str(caught.value)


def test_of_a_file_that_is_something_else_only_the_first_lines_are_told() -> None:
    with pytest.raises(FileError) as caught:
        parse_recording("what is this\n" * 10_000, "x.csv")
    assert len(caught.value.problems) == 20
