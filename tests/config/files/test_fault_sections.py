"""``[[fault]]`` sections, and the words of a command line that stand for one."""

import random

import pytest
from damaged_texts import after_accidents
from pydantic import Field

from busway import ConfigError
from busway.apps.simulator.added_faults import fault_problems
from busway.codes import Table
from busway.config.files.fault_sections import FaultSection, parse_fault_words
from busway.config.files.file_error import FileError
from busway.config.files.section import Section, json_schema
from busway.config.files.toml_source import read_source

TEXT = """\
[[fault]]
name = "slow meters"
fault_profile = "late"
units = "1-3"
functions = ["read_holding_registers", 4]
addresses = ["4x101-4x110", 7]
probability = 0.25
schedule = { from = 60, for = 10, every = 300, skip = 1, times = 5 }
on = false
parameters = { delay = 2.0 }

[[fault]]
fault_profile = "busy"
"""


class File(Section):
    fault: list[FaultSection] = Field(default_factory=list)


def _parsed(text: str) -> list[FaultSection]:
    return read_source(text, "plant.toml").checked(File).fault


def test_section_says_which_requests_are_meant_and_when() -> None:
    slow, busy = _parsed(TEXT)
    assert (slow.name, slow.fault_profile, slow.probability, slow.on) == ("slow meters", "late", 0.25, False)
    assert slow.chosen_units() == {1, 2, 3}
    assert slow.chosen_functions() == {3, 4}
    assert slow.chosen_addresses() == {
        Table.COILS: ((7, 8),),
        Table.DISCRETE_INPUTS: ((7, 8),),
        Table.INPUT_REGISTERS: ((7, 8),),
        Table.HOLDING_REGISTERS: ((7, 8), (100, 110)),
    }
    schedule = slow.schedule
    assert (schedule.from_, schedule.for_, schedule.every, schedule.skip, schedule.times) == (60, 10, 300, 1, 5)
    assert slow.parameters == {"delay": 2.0}
    assert (busy.chosen_units(), busy.chosen_functions(), busy.chosen_addresses()) == (None, None, None)
    assert busy.on


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("fault_profil = 1", "fault[0].fault_profil: unknown key; is it fault_profile?"),
        ('units = "1-300"', "fault[0].units: a unit is 0…255, not 300"),
        ('functions = ["8/1"]', "fault[0].functions: a fault is for whole functions, not for sub-function 8/1"),
        ("functions = [128]", "fault[0].functions: a function code is 1…127, not 128"),
        ('addresses = "4x5-3x7"', "fault[0].addresses: '4x5-3x7' does not end in the table where it begins"),
        ('addresses = "somewhere"', "fault[0].addresses: "),
        ("probability = 1.5", "fault[0].probability: must be 0…1, not 1.5"),
        ('on = "yes"', "fault[0].on: must be true or false, not 'yes'"),
        ("schedule = { until = 1 }", "fault[0].schedule.until: unknown key"),
        ("schedule = { from = -1 }", "fault[0].schedule.from: must be 0…31622400, not -1"),
        ("schedule = { every = 5 }", "fault[0].schedule.every: must be at least as long as for, which it needs"),
        ('parameters = { delay = "2" }', "fault[0].parameters.delay: must be a number, true or false, not '2'"),
    ],
)
def test_what_cannot_be_is_said_with_file_line_and_key(line: str, sentence: str) -> None:
    with pytest.raises(FileError) as caught:
        _parsed(f'[[fault]]\nfault_profile = "late"\n{line}\n')
    (problem,) = caught.value.problems
    assert str(problem).startswith(f"plant.toml:3: {sentence}")


def test_fault_profile_its_parameters_and_names_given_twice_are_said_with_file_line_and_key() -> None:
    text = """\
[[fault]]
name = "x"
fault_profile = "lazy"
[[fault]]
name = "x"
fault_profile = "late"
[fault.parameters]
seconds = 3
delay = -1
"""
    source = read_source(text, "plant.toml")
    problems = [str(one) for one in fault_problems(source.checked(File).fault, source)]
    assert problems[0].startswith(
        "plant.toml:3: fault[0].fault_profile: there is no fault profile 'lazy'; there are late,"
    )
    assert problems[1:] == [
        "plant.toml:8: fault[1].parameters.seconds: late has no such option; there are: delay",
        "plant.toml:9: fault[1].parameters.delay: must be 0…86400, not -1",
        "plant.toml:5: fault[1].name: another fault has the same name",
    ]


def test_bad_file_never_ends_in_a_traceback_and_always_names_a_line() -> None:
    for seed in range(200, 400):
        text = after_accidents(TEXT, random.Random(seed))
        try:
            source = read_source(text, "plant.toml")
            problems: list[ConfigError] = fault_problems(source.checked(File).fault, source)
        except FileError as error:
            problems = list(error.problems)
        for one in problems:
            assert one.file == "plant.toml"
            assert one.line is not None, text
            assert one.line >= 1


def test_schema_can_be_exported() -> None:
    keys = json_schema(File, "faults")["$defs"]["FaultSection"]["properties"]
    assert {"fault_profile", "units", "schedule", "parameters"} <= set(keys)


def test_words_of_a_command_line_stand_for_a_section() -> None:
    assert parse_fault_words("late").fault_profile == "late"
    one = parse_fault_words("late:delay=2.5, units=1-3,functions=3,for=10,every=60,probability=0.5,on=no,name=slow")
    assert (one.name, one.parameters, one.probability, one.on) == ("slow", {"delay": 2.5}, 0.5, False)
    assert (one.chosen_units(), one.chosen_functions()) == ({1, 2, 3}, {3})
    assert (one.schedule.for_, one.schedule.every) == (10, 60)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("late:delay", "delay: must be NAME=VALUE, not 'delay'"),
        ("late:delay=soon", "delay: must be a number, true or false, not 'soon'"),
        ("late:unit=3", "unit: unknown key; is it units?"),
        ("late:units=999", "units: a unit is 0…255, not 999"),
        ("late:times=-1", "schedule.times: must be at least 0, not -1"),
        ("late:every=3", "schedule.every: must be at least as long as for, which it needs"),
    ],
)
def test_words_that_cannot_be_name_the_key(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_fault_words(text)
    assert str(caught.value) == sentence
