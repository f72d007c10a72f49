"""The page on the simulator: its code runs, its files are right, its tables have every key."""

import re
from collections.abc import Callable
from inspect import signature
from pathlib import Path

import pytest

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.cli.simulate import simulate
from busway.config.files.behaviours import KINDS, BehaviourSection
from busway.config.files.file_error import FileError
from busway.config.files.simulation import SimulatedPointSection, SimulationFile
from busway.points.expression import FUNCTION_NAMES

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "simulator.md"


@pytest.fixture(scope="module")
def text() -> str:
    return GUIDE.read_text(encoding="utf-8")


def files_of(text: str) -> list[str]:
    """The simulation files of the page."""
    return re.findall(r"^```toml\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def test_its_program_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    run_page(GUIDE)


def test_its_files_can_be_simulated(text: str, tmp_path: Path) -> None:
    plant, kept, including, profile, faults, ready_made = files_of(text)
    first = Simulation(parse_declaration(plant, "plant.toml"))
    first.tick(0.0)
    first.tick(600.0)
    assert first.points["1/energy"].value > 0
    assert Simulation(parse_declaration(kept, str(tmp_path / "plant.toml"))).points["1/setpoint"].value == 20
    many = Simulation(parse_declaration(including, "plant.toml", read=lambda name: profile))
    assert many.units[100].name == "Acme meter 100"
    misbehaving = Simulation(parse_declaration(plant + faults, "plant.toml"))
    assert [(fault.name, fault.is_on) for fault in misbehaving.switchboard] == [("slow meters", False)]
    assert list(Simulation(parse_declaration(ready_made, "plant.toml")).units) == [1, 2, 3]


@pytest.mark.parametrize(
    ("right", "wrong"), [(", period = 60", ", periode = 60"), ('rate = "power', 'rate = "powre')], ids=["key", "name"]
)
def test_its_messages_are_those_of_a_file_with_these_mistakes(text: str, right: str, wrong: str) -> None:
    plant = files_of(text)[0].replace(right, wrong)
    with pytest.raises(FileError) as caught:
        Simulation(parse_declaration(plant, "plant.toml"))
    shown = [line.removesuffix("…") for line in re.findall(r"^plant\.toml:.*$", text, re.MULTILINE)]
    for problem in caught.value.problems:
        assert any(str(problem).startswith(line) for line in shown), problem


def test_no_section_is_empty(text: str) -> None:
    assert re.findall(r"^(## .*)\n+(?=## |\Z)", text, re.MULTILINE) == []


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_behaviour_is_explained(kind: str, text: str) -> None:
    section = text.partition("\n## Behaviours\n")[2].partition("\n## ")[0]
    assert len(re.findall(rf"^\| `{kind}` \| (?!.*\|.*\|.*\|).*$", section, re.MULTILINE)) == 1


def test_every_key_of_points_and_of_the_simulation_is_explained(text: str) -> None:
    own = set(SimulatedPointSection.__annotations__)
    own |= set(BehaviourSection.__annotations__) - {"expressions", "begins"}
    assert all(f"`{key}`" in text for key in own)
    assert set(SimulationFile.model_fields) >= {"simulation", "include", "parameters", "required"}


def test_every_function_of_expressions_is_named(text: str) -> None:
    assert all(f"`{name}`" in text for name in FUNCTION_NAMES)


def test_the_command_line_reference_names_every_option() -> None:
    page = (GUIDE.parent / "reference" / "cli.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE))
    told = sections["serve"] + sections["simulate"]
    of_many = {"-v", "--verbose", "-q", "--quiet", "--capture"}
    declared = {
        name
        for parameter in signature(simulate).parameters.values()
        for name in getattr(parameter.default, "param_decls", None) or ()
    }
    assert len(declared) > 20
    assert [name for name in sorted(declared - of_many) if f"`{name}" not in told] == []
