"""The plant: its physics as functions of state and time, and the device that shows and obeys."""

from dataclasses import replace

import pytest

from busway.apps.simulator.demo_plant import (
    BAND,
    METER,
    TANK,
    TANK_HEIGHT,
    THERMOMETER,
    Controls,
    Plant,
    PlantState,
    advance,
    consumption,
    flow,
    power,
    temperature,
)

CONTROLS = Controls(target=2.0)


def test_a_running_pump_fills_the_tank_and_counts_what_it_delivers() -> None:
    before = PlantState(level=1.8, is_pumping=True)
    after = advance(before, CONTROLS, 1.0)
    assert after.level > before.level
    assert after.volume > before.volume
    assert after.time == pytest.approx(1.0)


def test_without_the_pump_the_tank_empties_and_nothing_is_delivered() -> None:
    before = PlantState(level=2.2, is_pumping=False)
    after = advance(before, CONTROLS, 1.0)
    assert after.level < before.level
    assert after.volume == before.volume


def test_the_pump_starts_below_the_band_and_stops_above_it() -> None:
    assert advance(PlantState(level=2.0 - BAND - 0.01, is_pumping=False), CONTROLS, 0.1).is_pumping
    assert not advance(PlantState(level=2.0 + BAND + 0.01, is_pumping=True), CONTROLS, 0.1).is_pumping


@pytest.mark.parametrize("is_pumping", [True, False])
def test_within_the_band_the_pump_stays_as_it_is(is_pumping: bool) -> None:
    assert advance(PlantState(level=2.0, is_pumping=is_pumping), CONTROLS, 0.1).is_pumping is is_pumping


def test_a_disabled_pump_does_not_run() -> None:
    assert not advance(PlantState(level=0.5, is_pumping=True), replace(CONTROLS, pump_enabled=False), 0.1).is_pumping


@pytest.mark.parametrize("target", [-5.0, 0.0, 2.0, 100.0, float("nan"), float("inf")])
def test_whatever_is_asked_for_the_level_stays_in_the_tank(target: float) -> None:
    state = PlantState()
    for _ in range(200):
        state = advance(state, Controls(target), 1.0)
        assert 0.0 <= state.level <= TANK_HEIGHT
        assert 0 <= state.volume < 2**32


def test_the_level_swings_around_its_target_within_ten_seconds() -> None:
    state, running = PlantState(), set()
    for _ in range(100):
        state = advance(state, CONTROLS, 0.1)
        running.add(state.is_pumping)
    assert running == {True, False}
    assert abs(state.level - 2.0) < 2 * BAND


def test_a_long_step_is_many_short_ones() -> None:
    state = advance(PlantState(), CONTROLS, 60.0)
    assert abs(state.level - 2.0) < 2 * BAND


def test_what_depends_on_time_alone_stays_within_its_range() -> None:
    for second in range(100):
        assert 10.0 <= consumption(second) <= 20.0
        assert 16.5 <= temperature(second) <= 19.5


def test_a_resting_plant_draws_little() -> None:
    assert power(PlantState(is_pumping=False)) < 100 < power(PlantState(is_pumping=True))
    assert flow(PlantState(is_pumping=False)) == 0.0


def test_the_devices_show_the_plant_in_typed_registers() -> None:
    plant = Plant()
    plant.tick(1.0)
    tank, meter, thermometer = (plant.devices[unit] for unit in (TANK, METER, THERMOMETER))
    assert tank.read("3x1", "float32") == pytest.approx(plant.state.level, rel=1e-6)
    assert meter.read("3x5", "float32", order="CDAB") == pytest.approx(flow(plant.state), rel=1e-6)
    assert meter.read("3x7", "uint32") == int(plant.state.volume)
    assert tank.read("1x1") is plant.state.is_pumping
    assert thermometer.read("3x1", "int16") == round(10 * temperature(plant.state.time))


def test_the_plant_obeys_what_is_written_to_its_device() -> None:
    plant = Plant()
    tank = plant.devices[TANK]
    tank.write("0x1", False)
    plant.tick(0.1)
    assert tank.read("1x1") is False
    tank.write("0x1", True)
    tank.write("4x1", 3.5, "float32")
    for _ in range(100):
        plant.tick(0.1)
    assert plant.points[TANK]["tank.level"] > 3.0
