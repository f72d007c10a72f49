"""Includes and parameters: one profile for many units, and every fault at its line in its file."""

import os
import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from busway.apps.simulator.includes import SimulationDeclaration, load_declaration, parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.config.files.file_error import FileError
from busway.errors import ConfigError

FILES = Path(__file__).parents[2] / "config" / "files"

METER = """\
required = ["base"]

[parameters]
kind = "meter"
scale = 1

[[unit]]
name = "${kind} ${unit}"

[[unit.point]]
name = "voltage"
address = "4x1"
type = "float32"
value = "${base + index * scale}"
description = "costs $${a} and ${scale}, is ${kind}"
"""


def declared(text: str, **files: str) -> SimulationDeclaration:
    """The declaration of a text, with included files ``name.toml`` beside it."""

    def read(name: str) -> str:
        stem = Path(name).stem
        if stem not in files:
            raise ConfigError("cannot be read: no such file", file=name)
        return files[stem]

    return parse_declaration(text, "plant.toml", read=read)


def refused(text: str, **files: str) -> list[str]:
    with pytest.raises(FileError) as caught:
        declared(text, **files)
    assert all(each.file and each.line for each in caught.value.problems)
    return str(caught.value).splitlines()


def including(units: str = '"1-100"', given: str = "{ base = 230.0 }") -> str:
    return f'[[include]]\nfile = "meter.toml"\nunits = {units}\nwith = {given}\n'


def test_a_hundred_meters_come_from_one_profile_each_with_its_own_values() -> None:
    simulation = Simulation(declared(including(), meter=METER))
    assert len(simulation.units) == 100
    assert simulation.units[7].name == "meter 7"
    assert [simulation.points[f"{unit}/voltage"].value for unit in (1, 2, 100)] == [230.0, 231.0, 329.0]
    assert simulation.points["3/voltage"].description == "costs ${a} and 1, is meter"
    simulation.set("1/voltage", 5.0)
    assert simulation.points["2/voltage"].value == 231.0


def test_units_that_do_not_differ_share_one_section_but_no_memory() -> None:
    profile = '[[unit]]\nname = "x"\nholding_registers = 5\n'
    declaration = declared('[[include]]\nfile = "meter.toml"\nunits = "1-9"\n', meter=profile)
    assert len(declaration.units) == 1
    simulation = Simulation(declaration)
    simulation.units[1].device.holding_registers[0] = 5
    assert simulation.units[2].device.holding_registers[0] == 0


def test_a_file_without_units_in_its_include_is_taken_as_it_is_includes_and_all() -> None:
    hall = '[[unit]]\nunit = 50\nname = "hall ${unit}"\ncoils = 3\n' + including('"60"')
    declaration = declared('[[include]]\nfile = "hall.toml"\n', hall=hall, meter=METER)
    assert [each.section.unit for each in declaration.units] == [[50], [60]]
    assert declaration.units[0].section.name == "hall 50"


def test_parameters_keep_their_type_where_nothing_stands_around_them() -> None:
    text = '[parameters]\nn = 3\nw = true\n[[unit]]\nunit = "${n}"\nname = "${n} ${w}"\ncoils = "${n * 2}"\n'
    (unit,) = declared(text).units
    assert unit.section.unit == [3]
    assert unit.section.name == "3 true"
    assert unit.section.coils is not None
    assert unit.section.coils.size == 6


@pytest.mark.parametrize(
    ("text", "meter", "sentence"),
    [
        (including(given="{}"), METER, "plant.toml:4: include[0].with: meter.toml needs base"),
        (
            including(given="{ base = 1.0, bass = 2 }"),
            METER,
            "plant.toml:4: include[0].with.bass: meter.toml has no such parameter; there are kind, scale, base",
        ),
        (
            including(),
            METER.replace("float32", "float31"),
            "meter.toml:13: unit[0].point[0].type: unknown type 'float31'",
        ),
        (including(), METER.replace("float32", "float31"), "(included by plant.toml:1)"),
        (including(given='{ base = "x" }'), METER, "meter.toml:14: unit[0].point[0].value: base is no number, but 'x'"),
        (including(), METER.replace("${kind}", "${kin}"), "there is no parameter 'kin'; there are kind, scale, base"),
        (including(), METER.replace("${kind}", "${kind +}"), "meter.toml:8: unit[0].name: 'kind +' is no expression"),
        (including(), METER.replace("scale = 1", "scale = 1\nunit = 5"), "'unit' cannot be the name of a parameter"),
        (including(), METER + "[[unit]]\n", "plant.toml:3: include[0].units: needs a file with one [[unit]]"),
        (including(), "nothing = 1\n" + METER, "meter.toml:1: nothing: unknown key"),
        (including(), "listen = []\n" + METER, "meter.toml:1: listen: unknown key"),
        (including(), "[[", "meter.toml:1:"),
        (
            "[[unit]]\nunit = 3\ncoils = 1\n" + including('"1-3"'),
            METER,
            "meter.toml:7: unit[0]: unit 3 is there already",
        ),
        ('required = ["a"]\n[[unit]]\nunit = 1\n', METER, "plant.toml:1: required: can only be given by who includes"),
        ('[[unit]]\nunit = [1, 2]\nname = "${unit}"\n', METER, "plant.toml:3: unit[0].name: there is no parameter"),
        ('[[include]]\nfile = "away.toml"\n', METER, "plant.toml:2: include[0].file: away.toml: cannot be read"),
        ('[[include]]\nfile = "plant.toml"\n', METER, "plant.toml:2: include[0].file: plant.toml would include itself"),
        ("[server]\nunit_policy = 'any'\n" + including(), METER, "plant.toml:2: server.unit_policy: any needs exactly"),
    ],
)
def test_what_cannot_be_included_is_refused_where_it_stands(text: str, meter: str, sentence: str) -> None:
    found = refused(text, meter=meter)
    assert any(sentence in line for line in found), found


def test_files_that_include_each_other_are_refused_with_who_includes_them() -> None:
    found = refused(
        '[[include]]\nfile = "a.toml"\n', a='[[include]]\nfile = "b.toml"\n', b='\n[[include]]\nfile = "a.toml"\n'
    )
    assert found == ["b.toml:3: include[0].file: a.toml would include itself (included by a.toml:1)"]


def test_a_fault_that_all_units_of_a_profile_share_is_said_once() -> None:
    assert len(refused(including(), meter=METER.replace("4x1", "5x1"))) == 1


def test_paths_are_relative_to_the_file_in_which_they_stand(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "meter.toml").write_text(
        '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "3x1"\n'
        'behaviour = { kind = "replay", file = "a.csv" }\n'
    )
    (tmp_path / "sub" / "a.csv").write_text("0,5\n1,6\n")
    (tmp_path / "plant.toml").write_text(
        '[simulation]\nkeep = "state.json"\n[[include]]\nfile = "sub/meter.toml"\n', encoding="utf-8"
    )
    declaration = load_declaration(tmp_path / "plant.toml")
    assert declaration.state == str(tmp_path / "state.json")
    assert Simulation(declaration).points["1/a"].value == 5


def _mutations(text: str, count: int, seed: int) -> list[str]:
    """Texts that differ from one in some place, as slips of a hand and of a program do."""
    chance = random.Random(seed)
    lines = text.splitlines()
    values = [
        "",
        "-1",
        "1e400",
        '"x"',
        "[]",
        "{}",
        "true",
        "65536",
        "0.5",
        '"${base"',
        '"${x}"',
        "nan",
        '"1/0"',
        "[[1]]",
    ]
    found = []
    while len(found) < count:
        fresh = list(lines)
        at = chance.randrange(len(fresh))
        line = fresh[at]
        kind = chance.randrange(7)
        if kind == 0:
            del fresh[at]
        elif kind == 1:
            fresh.insert(at, fresh[chance.randrange(len(fresh))])
        elif kind == 2 and "=" in line:
            fresh[at] = f"{line.partition('=')[0]}= {chance.choice(values)}"
        elif kind == 3 and line:
            place = chance.randrange(len(line))
            fresh[at] = line[:place] + chance.choice("x\"'[]{}=,.0-é\0") + line[place + 1 :]
        elif kind == 4 and line:
            place = chance.randrange(len(line))
            fresh[at] = line[:place]
        elif kind == 5 and "=" in line:
            words = line.split(" ")
            words[chance.randrange(len(words))] = chance.choice(values)
            fresh[at] = " ".join(words)
        elif kind == 6:
            other = chance.randrange(len(fresh))
            fresh[at], fresh[other] = fresh[other], fresh[at]
        found.append("\n".join(fresh) + "\n")
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_bad_file_never_ends_in_a_traceback_and_always_names_file_and_line(seed: int, tmp_path: Path) -> None:
    plant = (FILES / "simulation.toml").read_text(encoding="utf-8")
    profile = (FILES / "profile.toml").read_text(encoding="utf-8")
    file, included = tmp_path / "simulation.toml", tmp_path / "profile.toml"
    bad = 0
    for number, text in enumerate(_mutations(plant, 45, seed) + _mutations(profile, 25, seed)):
        file.write_text(text if number < 45 else plant, encoding="utf-8")
        included.write_text(profile if number < 45 else text, encoding="utf-8")
        problems = _problems(file)
        bad += bool(problems)
        for problem in problems:
            assert problem.file in (str(file), str(included)), text
            assert problem.line is not None, text
            assert 1 <= problem.line <= text.count("\n") + plant.count("\n"), text
    assert bad > 25


def _problems(file: Path) -> Sequence[ConfigError]:
    """What is wrong with a file; nothing of one that can be simulated."""
    try:
        simulation = Simulation(file)
        simulation.tick(0.0)
        simulation.tick(10.0)
    except FileError as error:
        return error.problems
    return ()


def test_a_pipe_a_device_and_a_link_of_another_user_are_no_files_to_include(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "unit.toml").write_text("[[unit]]\nunit = 1\ncoils = 1\n")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("unit.toml")
    plant = tmp_path / "plant.toml"
    if os.geteuid() == 0:
        os.lchown(tmp_path / "link", 12_345, 12_345)
    else:
        monkeypatch.setattr("os.geteuid", lambda: 12_345)
    for name, sentence in (
        ("pipe", "it is a pipe, and a regular file is needed"),
        ("/dev/zero", "it is a device, and a regular file is needed"),
        ("link", "of another user"),
    ):
        plant.write_text(f'[[include]]\nfile = "{name}"\n')
        with pytest.raises(FileError, match=sentence) as caught:
            load_declaration(plant)
        assert (caught.value.file, caught.value.line) == (str(plant), 2)


def test_a_replay_takes_regular_files_only(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\n'
        'behaviour = { kind = "replay", file = "pipe" }\n'
    )
    with pytest.raises(FileError, match="it is a pipe, and a regular file is needed"):
        Simulation(load_declaration(plant))


def test_files_that_each_include_the_next_twice_are_refused_at_a_thousand() -> None:
    twice = '[[include]]\nfile = "f{0}.toml"\n[[include]]\nfile = "f{0}.toml"\n'
    files = {f"f{number}": twice.format(number + 1) for number in range(1, 30)}
    (sentence,) = refused(twice.format(1), **files, f30="[[unit]]\nunit = 1\ncoils = 1\n")
    assert "more than 1000 files would be included" in sentence


def test_a_parameter_that_doubles_with_each_file_is_refused() -> None:
    def file(number: int) -> str:
        given = 'with = { a = "${a}${a}" }\n'
        return f'required = ["a"]\n[[include]]\nfile = "f{number + 1}.toml"\n{given}'

    files = {f"f{number}": file(number) for number in range(1, 60)}
    (sentence, *_) = refused('[[include]]\nfile = "f1.toml"\nwith = { a = "xx" }\n', **files)
    assert "more than 10000 characters of parameters would be put into it" in sentence


def test_files_that_include_one_another_too_deeply_are_refused() -> None:
    files = {f"f{number}": f'[[include]]\nfile = "f{number + 1}.toml"\n' for number in range(1, 500)}
    (sentence,) = refused('[[include]]\nfile = "f1.toml"\n', **files)
    assert "more than 32 files would include one another" in sentence


@pytest.mark.parametrize("text", ["n is ${n}", "${n + 1}"])
def test_a_whole_number_of_any_size_is_refused_where_it_is_put_in(text: str) -> None:
    profile = f'[parameters]\nn = 0x{"f" * 100_000}\n[[unit]]\nname = "{text}"\ncoils = 1\n'
    (sentence,) = refused('[[include]]\nfile = "f.toml"\nunits = "1"\n', f=profile)
    assert "400000 bits" in sentence
