"""The schema of simulation files: what is refused with which sentence, and that every device file is one."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from json_schema import faults

from busway.codes import Table
from busway.config.files.behaviours import KINDS
from busway.config.files.file_error import FileError
from busway.config.files.section import json_schema
from busway.config.files.simulation import SimulationFile, simulation_schema
from busway.config.files.toml_source import read_source

HERE = Path(__file__).parent
POINT = '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\n'


def parsed(text: str) -> SimulationFile:
    return read_source(text, "x.toml").checked(SimulationFile)


def refused(text: str) -> list[str]:
    with pytest.raises(FileError) as caught:
        parsed(text)
    assert all(each.file == "x.toml" and each.line for each in caught.value.problems)
    return str(caught.value).splitlines()


@pytest.mark.parametrize("name", ["good.toml", "system.toml"])
def test_device_and_configuration_files_are_simulation_files(name: str) -> None:
    assert parsed((HERE / name).read_text(encoding="utf-8")).unit


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ("minimum = 5\nmaximum = 4", "x.toml:7: unit[0].point[0].maximum: must be at least the minimum, 5, not 4"),
        ("minimum = 5\nvalue = 4", "x.toml:7: unit[0].point[0].value: must be at least 5, not 4"),
        ("minimum = 1\nmaximum = 3\nvalue = 4", "x.toml:8: unit[0].point[0].value: must be 1…3, not 4"),
        (
            'type = "string:4"\nmaximum = 4',
            "x.toml:7: unit[0].point[0].maximum: 'a' holds no number and has no maximum",
        ),
        ('value = "on"\nenumeration = { off = 0 }', "unit[0].point[0].value: there is no 'on'; there are off"),
        ("value = 3\nenumeration = { off = 0, on = 1 }", "point[0].value: must be off (0), on (1), not 3"),
        ("enumeration = { off = 0, on = 0 }", "unit[0].point[0].enumeration.on: 0 is 'off' already"),
        ("enumeration = { off = -1 }", "unit[0].point[0].enumeration.off: -1 does not fit uint16"),
        ("enumeration = { off = 5 }\nmaximum = 4", "unit[0].point[0].enumeration.off: must be at most 4, not 5"),
        ('type = "float32"\nenumeration = { off = 5 }', "names stand for whole numbers without a scale"),
        ("behaviour = 3", 'unit[0].point[0].behaviour: must be a table such as { kind = "sine", … }, not 3'),
        ("behaviour = { period = 3 }", "unit[0].point[0].behaviour.kind: is missing; there are constant, ramp"),
        ('behaviour = { kind = "sin" }', "unit[0].point[0].behaviour.kind: must be one of constant, ramp"),
        ('behaviour = { kind = "sine", period = 3 }', "unit[0].point[0].behaviour.amplitude: is missing"),
        (
            'behaviour = { kind = "sine", amplitude = 1, periode = 3 }',
            "unit[0].point[0].behaviour.periode: unknown key; is it period?",
        ),
        ('behaviour = { kind = "counter", rate = true }', "behaviour.rate: must be a number, or an expression"),
        ('behaviour = { kind = "square", period = 0 }', "unit[0].point[0].behaviour.period: must be 0.001…"),
        ('behaviour = { kind = "constant", value = nan }', "unit[0].point[0].behaviour.value"),
        ('maximum = 4\nbehaviour = { kind = "constant", value = 5 }', "behaviour.value: must be at most 4, not 5"),
        ('behaviour = { kind = "constant", value = -5 }', "behaviour.value: -5 does not fit uint16"),
        ('behaviour = { kind = "square", period = 1, every = 0 }', "behaviour.every: must be 0.01…86400, not 0"),
        (
            'value = 3\nbehaviour = { kind = "square", period = 1 }',
            "x.toml:6: unit[0].point[0].value: would never be seen: the behaviour, square, gives the value at once",
        ),
        ('type = "bits"\nbehaviour = { kind = "square", period = 1 }', "bits is no number and has no behaviour"),
        (
            'maximum = 40\nbehaviour = { kind = "random-walk", step = 1, low = 50 }',
            "unit[0].point[0].behaviour.low: low, 50, must be below high, 40",
        ),
        (
            'behaviour = { kind = "random-walk", step = 1, low = 3, high = 3 }',
            "unit[0].point[0].behaviour.high: must be above low, 3, not 3",
        ),
    ],
)
def test_a_point_that_cannot_be_is_refused_with_line_and_key(keys: str, sentence: str) -> None:
    assert any(sentence in line for line in refused(POINT + keys))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('[[include]]\nunits = "1"\n', "x.toml:1: include[0].file: is missing"),
        ('[[include]]\nfile = "a"\nunits = "1-"\n', "x.toml:3: include[0].units: "),
        ('[[include]]\nfile = "a"\nunits = "5-4"\n', "include[0].units: "),
        ('[[include]]\nfile = "a"\nunits = "256"\n', "include[0].units: a unit is 0…255, not 256"),
        ('[[include]]\nfile = "a"\nwith = { a = [] }\n', "x.toml:3: include[0].with.a"),
        ('[[include]]\nfile = "a"\nwit = { a = 1 }\n', "include[0].wit: unknown key; is it with?"),
        ("[simulation]\nkeep_every = 0\n" + POINT, "simulation.keep_every: must be 0.1…86400, not 0"),
        ("[simulation]\nseeds = 0\n" + POINT, "simulation.seeds: unknown key; is it seed?"),
        ('[[unit]]\nunit = 1\nholes = "zero"\n', 'must be "refuse", or the value that is read, 0…65535'),
        ("[[unit]]\nunit = 1\nholes = { coil = 0 }\n", "holes.coil: unknown key; is it coils?"),
        ("", "x.toml:1: unit: is missing"),
    ],
)
def test_a_file_that_cannot_be_is_refused_with_line_and_key(text: str, sentence: str) -> None:
    assert any(sentence in line for line in refused(text)), refused(text)


def test_holes_are_for_each_table_or_for_all() -> None:
    for text, registers, coils in (("7", 7, 1), ('"refuse"', None, None), ("{ coils = 0 }", None, 0)):
        (unit,) = parsed(f"[[unit]]\nunit = 1\nholes = {text}\n").unit
        assert unit.holes.value(Table.INPUT_REGISTERS) == registers
        assert unit.holes.value(Table.COILS) == coils


def example(name: str) -> dict[str, Any]:
    return tomllib.loads((HERE / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["simulation.toml", "profile.toml", "good.toml", "system.toml"])
def test_the_exported_schema_permits_simulation_files_and_profiles_with_their_parameters(name: str) -> None:
    assert faults(simulation_schema("x"), example(name)) == []


def test_the_exported_schema_refuses_unknown_keys_and_texts_that_are_no_parameters() -> None:
    schema = simulation_schema("x")
    for text in (
        "speed = 1",
        "[simulation]\nsped = 1",
        '[[unit]]\nunit = "one"',
        '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "3x1"\n'
        'behaviour = { kind = "sine", mean = "x", amplitude = 1, period = 1 }',
        '[[fault]]\nfault_profile = "late"\ndelay = 1',
    ):
        assert faults(schema, tomllib.loads(text)), text


def test_the_schema_knows_every_kind_of_behaviour() -> None:
    schema: dict[str, Any] = json_schema(SimulationFile, "simulation")
    text = str(schema)
    assert all(f"'{kind}'" in text for kind in KINDS)
    assert "with" in schema["$defs"]["IncludeSection"]["properties"]
