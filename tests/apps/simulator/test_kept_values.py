"""Values over restarts: what is saved, what is taken up again, and what becomes of a state that cannot be."""

import json
import logging
from pathlib import Path

import pytest
from simulated_points import PLANT_UNIT

from busway.apps.simulator.simulation import Simulation
from busway.errors import ConfigError
from busway.faults.clock import FakeClock


def kept(tmp_path: Path, text: str = PLANT_UNIT) -> Path:
    file = tmp_path / "plant.toml"
    file.write_text('[simulation]\nkeep = "state.json"\n' + text)
    return file


async def test_values_are_kept_over_a_restart_and_go_on_where_they_were(tmp_path: Path) -> None:
    file = kept(tmp_path)
    clock = FakeClock()
    first = Simulation(file, clock=clock)
    async with first.running("tcp://127.0.0.1:0"):
        clock.advance(20.0)
        first.set("1/level", 3.0)
        first.set("1/mode", "off")
        first.set("1/label", "kept")
        clock.advance(0.5)
    second = Simulation(file)
    assert second.warnings == []
    assert second.time == 20.5
    for key, value in {"1/energy": 40, "1/level": 3.0, "1/mode": 0, "1/label": "kept"}.items():
        assert second.points[key].value == value
    assert second.points["1/walk"].value == first.points["1/walk"].value
    second.tick(500.0)
    second.tick(510.0)
    first.tick(30.5)
    assert {key: each.value for key, each in second.points.items()} == {
        key: each.value for key, each in first.points.items()
    }
    assert second.points["1/level"].is_held


INPUTS_AND_SETPOINT = """
[[unit]]
unit = 1
[[unit.point]]
name = "inflow"
address = "3x1"
value = 5
[[unit.point]]
name = "setpoint"
address = "4x1"
value = 20
"""


def test_a_value_that_was_set_is_kept_over_restarts_where_clients_can_only_read_it(tmp_path: Path) -> None:
    file = kept(tmp_path, INPUTS_AND_SETPOINT)
    first = Simulation(file)
    first.set("1/inflow", 77)
    first.keep()
    for _ in range(2):
        again = Simulation(file)
        assert again.points["1/inflow"].value == 77
        assert again.points["1/inflow"].last_writer == "api"
        again.keep()


def test_a_first_value_that_changed_in_the_file_holds_after_a_restart_unless_the_point_was_set(tmp_path: Path) -> None:
    file = kept(tmp_path, INPUTS_AND_SETPOINT)
    Simulation(file).keep()
    file.write_text(file.read_text().replace("value = 20", "value = 25"))
    simulation = Simulation(file)
    assert simulation.points["1/setpoint"].value == 25
    simulation.set("1/setpoint", 30)
    simulation.keep()
    assert Simulation(file).points["1/setpoint"].value == 30


@pytest.mark.parametrize(
    "content",
    [
        "",
        '{"kind": "busway simulation state"',
        '{"kind": "busway simulation state", "version": 2, "time": 1, "points": {}}',
        '{"kind": "busway simulation state", "version": 1, "time": -1, "points": {}}',
        '{"kind": "busway simulation state", "version": 1, "time": "x", "points": {}}',
        '{"kind": "busway simulation state", "version": 1, "time": 1' + "0" * 400 + ', "points": {}}',
        '{"kind": "busway simulation state", "version": 1, "time": 1, "points": {"1/energy": {"value": null, '
        '"held": false, "behaviour": 1' + "0" * 400 + "}}}",
        '{"kind": "busway simulation state", "version": 1, "time": 1, "points": {"1/mode": 5}}',
        '{"kind": "busway simulation state", "version": 1, "time": 1, "points": []}',
        '{"kind": "busway simulation state", "points": ' + "[" * 100_000,
        '{"kind": "busway simulation state", \xff\xfe',
    ],
)
def test_a_state_that_means_nothing_is_put_aside_and_all_begins_anew(content: str, tmp_path: Path) -> None:
    file = kept(tmp_path)
    (tmp_path / "state.json").write_bytes(content.encode("latin-1"))
    simulation = Simulation(file)
    (warning,) = simulation.warnings
    assert "state.json" in warning
    assert "begins anew" in warning
    assert simulation.points["1/mode"].value == 1
    assert (tmp_path / "state.json.broken").read_bytes() == content.encode("latin-1")
    simulation.keep()
    assert Simulation(file).warnings == []


def test_kept_values_that_no_longer_fit_are_forgotten_one_by_one(tmp_path: Path) -> None:
    file = kept(tmp_path)
    simulation = Simulation(file)
    simulation.set("1/mode", "off")
    simulation.set("1/level", 3.0)
    simulation.keep()
    state = json.loads((tmp_path / "state.json").read_text())
    state["points"]["1/gone"] = {"value": 5, "held": False, "behaviour": None}
    state["points"]["1/level"]["value"] = 99
    (tmp_path / "state.json").write_text(json.dumps(state))
    again = Simulation(file)
    assert len(again.warnings) == 2
    assert again.points["1/mode"].value == 0
    assert again.points["1/level"].value == 0.0


def test_a_state_that_cannot_be_written_is_said_and_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = kept(tmp_path)
    simulation = Simulation(file)
    (tmp_path / "state.json").mkdir()
    with caplog.at_level(logging.WARNING, "busway.apps.simulator"):
        simulation.keep()
    assert "it is a directory, and a regular file is needed" in caplog.text


@pytest.mark.parametrize("content", ["{", "[]", "null", "[" * 100_000, "\xff\xfe", "# notes of a user"])
def test_a_file_that_is_no_state_is_refused_and_stays_as_it_is(content: str, tmp_path: Path) -> None:
    file = kept(tmp_path)
    state = tmp_path / "state.json"
    state.write_bytes(content.encode("latin-1"))
    with pytest.raises(ConfigError, match="is no state of a simulation, so it is not overwritten"):
        Simulation(file)
    assert state.read_bytes() == content.encode("latin-1")
    assert not (tmp_path / "state.json.broken").exists()


def test_a_file_that_takes_the_place_of_the_state_meanwhile_is_not_overwritten(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = kept(tmp_path)
    simulation = Simulation(file)
    state = tmp_path / "state.json"
    state.write_text("# notes of a user")
    with caplog.at_level(logging.WARNING, "busway.apps.simulator"):
        simulation.keep()
    assert state.read_text() == "# notes of a user"
    assert "is no state of a simulation" in caplog.text
