"""The ready-made devices: what a client of such a device would find, and that their pages say it."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import pytest
from generated import assert_up_to_date
from whole_frames import line_of_whole_frames

import busway
from busway.apps.simulator.includes import load_declaration, parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.config.profiles import DEVICES, ready_made
from busway.errors import ConfigError, ExceptionReply
from busway.testing import simulated_device

ROOT = Path(__file__).resolve().parents[3]


def simulation_of(name: str, **parameters: object) -> Simulation:
    """The device at its first moment, with a time that the test moves by `Simulation.tick`."""
    given = ", ".join(f"{key} = {value}" for key, value in parameters.items())
    text = f'[[include]]\nfile = "device:{name}"\nunits = "1"\nwith = {{ {given} }}\n'
    simulation = Simulation(parse_declaration(text, "test.toml"))
    simulation.tick(0.0)
    return simulation


@contextmanager
def asked(simulation: Simulation, unit: int = 1) -> Iterator[busway.BlockingUnit]:
    """A unit as a client sees it."""
    devices = {number: each.device for number, each in simulation.units.items()}
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units=devices) as server,
        busway.connect(server.endpoints[0], timeout=5) as link,
    ):
        yield link.unit(unit)


def test_every_device_of_the_package_is_listed_and_every_listed_one_is_there() -> None:
    there = {each.name for each in files("busway.config.profiles").iterdir() if each.name.endswith(".toml")}
    assert there == {f"{name}.toml" for name in DEVICES}


def test_a_device_that_is_not_there_is_refused_with_the_list() -> None:
    with pytest.raises(ConfigError, match="toaster: there is no such device, but meter, inverter, drive"):
        ready_made("toaster")


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_runs_for_a_day_and_every_point_says_what_it_is(name: str) -> None:
    simulation = simulation_of(name)
    for hour in range(24):
        simulation.tick(hour * 60.0)  # a minute of each hour is enough to let everything move
    for point in simulation.points.values():
        assert point.value is not None, point
        assert point.description, point
        if isinstance(point.value, float):
            assert math.isfinite(point.value), point
        if point.behaviour and point.enumeration:
            assert point.label is not None, point


@pytest.mark.parametrize("name", DEVICES)
def test_a_client_reads_every_point_as_the_simulation_has_it(name: str) -> None:
    simulation = simulation_of(name)
    simulation.tick(60.0)
    with asked(simulation) as unit:
        for point in simulation.points.values():
            section = point.section
            raw = unit.read(section.place, section.form)
            assert section.physical(raw) == point.value, point


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_can_be_served_by_itself(name: str) -> None:
    device = ready_made(name)
    assert len(Simulation(parse_declaration(device.text, device.file)).units) == 1


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_says_who_it_is(name: str) -> None:
    with asked(simulation_of(name)) as unit:
        objects = unit.read_device_identification("regular")
        assert objects[0] == b"busway"
        assert objects[1].decode() == name
        assert unit.report_server_id() == name.encode() + b"\xff"


@pytest.mark.parametrize("name", DEVICES)
def test_what_is_read_only_cannot_be_written(name: str) -> None:
    simulation = simulation_of(name)
    with asked(simulation) as unit:
        for point in simulation.points.values():
            if point.table.is_writable and point.access == "read":
                with pytest.raises(ExceptionReply) as caught:
                    unit.write_single_register(point.address, 1)
                assert caught.value.code == 2


def test_the_meter_counts_the_energy_that_it_measures() -> None:
    simulation = simulation_of("meter")
    before = simulation.point("1/energy_import").value
    total = 0.0
    for second in range(1, 3601):
        total += simulation.point("1/power").value / 3600
        simulation.tick(float(second))
    gained = simulation.point("1/energy_import").value - before
    assert 2000 < gained == pytest.approx(total, abs=20)


def test_the_meter_s_phases_add_up_and_its_values_are_floats_high_word_first() -> None:
    simulation = simulation_of("meter")
    simulation.tick(10.0)
    with asked(simulation) as unit:
        phases = unit.read("3x13", "float32", count=3)
        total = unit.read("3x19", "float32")
        voltages = unit.read("3x1", "float32", count=3)
        assert unit.read_input_registers(34, count=66) == [0] * 66, "between the blocks zeros are read"
    assert total == pytest.approx(sum(phases), rel=1e-6)
    assert all(220 < voltage < 240 for voltage in voltages)


def test_the_meter_s_partial_counter_begins_again_when_it_is_written() -> None:
    simulation = simulation_of("meter")
    simulation.tick(3600.0)
    with asked(simulation) as unit:
        assert unit.read("4x21", "uint32") > 100
        unit.write("4x21", 0, "uint32")
        simulation.tick(3660.0)
        assert 5 < unit.read("4x21", "uint32") < 50


def models_of(unit: busway.BlockingUnit) -> dict[int, tuple[int, int]]:
    """A SunSpec map as a client walks it: model → first register after its head, and length."""
    assert unit.read("holding:40000", "string:4") == "SunS"
    at = 40002
    found = {}
    while True:
        model, length = unit.read_holding_registers(at, count=2)
        if model == 0xFFFF:
            assert length == 0
            return found
        found[model] = (at + 2, length)
        at += 2 + length


def test_the_inverter_s_models_are_found_by_walking_from_the_marker_to_the_end() -> None:
    with asked(simulation_of("inverter")) as unit:
        models = models_of(unit)
        assert {model: length for model, (_, length) in models.items()} == {1: 66, 103: 50, 120: 26}
        for first, length in models.values():
            assert len(unit.read_holding_registers(first, count=length)) == length
        (common, _) = models[1]
        assert unit.read(f"holding:{common}", "string:32") == "busway"
        assert unit.read(f"holding:{common + 48}", "string:32") == "BW-0001"
        assert unit.read(f"holding:{common + 64}") == 1


SCALED = {
    "A": (0, "uint16", 4),
    "PhVphA": (8, "uint16", 11),
    "W": (12, "int16", 13),
    "Hz": (14, "uint16", 15),
    "VA": (16, "int16", 17),
    "VAr": (18, "int16", 19),
    "PF": (20, "int16", 21),
    "WH": (22, "uint32", 24),
    "DCA": (25, "uint16", 26),
    "DCV": (27, "uint16", 28),
    "DCW": (29, "int16", 30),
    "TmpCab": (31, "int16", 35),
    "TmpSnk": (32, "int16", 35),
}
"""Values of model 103: offset behind the head, type, and offset of the scale factor, as the specification has them."""


def test_the_inverter_s_scale_factors_give_its_values() -> None:
    simulation = simulation_of("inverter", day=400)
    simulation.tick(70.0)
    with asked(simulation) as unit:
        first, _ = models_of(unit)[103]
        for name, (offset, kind, factor) in SCALED.items():
            raw = unit.read(f"holding:{first + offset}", kind)
            exponent = unit.read(f"holding:{first + factor}", "int16")
            assert raw * 10.0**exponent == pytest.approx(simulation.point(f"1/{name}").value), name
    assert simulation.point("1/W").value > 1000


def test_the_inverter_sleeps_at_night_and_counts_what_it_gave_by_day() -> None:
    simulation = simulation_of("inverter", day=2400)
    energy, states = simulation.point("1/WH").value, set()
    for quarter in range(96):
        simulation.tick(quarter * 25.0)
        states.add(simulation.point("1/St").label)
        assert simulation.point("1/W").value <= 10_000
    assert {"sleeping", "mppt"} <= states
    assert 700 < simulation.point("1/WH").value - energy < 3300


def test_the_inverter_stops_for_a_ground_fault_and_off_the_grid() -> None:
    simulation = simulation_of("inverter", day=400)
    simulation.tick(70.0)
    with asked(simulation) as unit:
        unit.write("coil:1", True)
        simulation.tick(72.0)
        assert unit.read("holding:40108") == 7
        assert unit.read("holding:40110", "uint32") == 1
        assert unit.read("holding:40084") == 0
        unit.write("coil:1", False)
        unit.write("coil:0", False)
        simulation.tick(74.0)
        assert (unit.read("holding:40108"), unit.read("holding:40084")) == (1, 0)


def test_the_drive_follows_its_set_point_and_says_so_in_its_status_word() -> None:
    simulation = simulation_of("drive")
    with asked(simulation) as unit:
        assert unit.read("3x1") == 0b1
        unit.write("4x2", 900)
        unit.write("4x1", 0b1)
        simulation.tick(1.5)
        assert 400 < unit.read("3x2", "int16") < 700
        assert unit.read("3x1") == 0b11
        simulation.tick(12.0)
        assert unit.read("3x2", "int16") == pytest.approx(900, abs=2)
        assert unit.read("3x1") == 0b111
        unit.write("4x1", 0b11)
        simulation.tick(30.0)
        assert unit.read("3x2", "int16") == pytest.approx(-900, abs=2)
        unit.write("4x1", 0b111)
        simulation.tick(50.0)
        assert unit.read("3x2", "int16") == 0
        assert unit.read("3x1") == 0b1
        with pytest.raises(ExceptionReply) as caught:
            unit.write("4x2", 5000)
        assert caught.value.code == 4


def test_the_drive_stops_with_a_fault_until_it_is_reset() -> None:
    simulation = simulation_of("drive")
    with asked(simulation) as unit:
        unit.write("4x1", 0b1)
        simulation.tick(10.0)
        unit.write("4x4", 200)
        simulation.tick(11.0)
        assert unit.read("3x1") & 0b1001 == 0b1000
        assert unit.read("3x8") == 1
        unit.write("4x4", 50)
        simulation.tick(30.0)
        assert unit.read("3x1") & 0b1001 == 0b1000, "the cause has gone, the fault stays"
        assert unit.read("3x8") == 1
        unit.write("4x1", 0b1000_0000)
        simulation.tick(31.0)
        assert unit.read("3x1") == 0b1
        assert unit.read("3x8") == 0


def test_the_io_block_connects_outputs_to_inputs_and_counts() -> None:
    simulation = simulation_of("io")
    with asked(simulation) as unit:
        unit.write("0x1", [True, False])
        unit.write("4x1", 7500, "int16")
        simulation.tick(100.0)
        assert unit.read("1x1", count=2) == [True, False]
        assert unit.read("3x4", "int16") == 7500
        assert unit.read("3x9", "uint32", count=2) == [50, 20]
        unit.write("0x17", False)
        simulation.tick(200.0)
        assert unit.read("3x9", "uint32", count=2) == [50, 20]


def test_the_io_block_s_watchdog_lets_the_outputs_fall_when_it_is_not_fed() -> None:
    simulation = simulation_of("io")
    with asked(simulation) as unit:
        unit.write("4x1", 5000, "int16")
        unit.write("4x17", 30)
        unit.write("4x18", 0)
        for tenth in range(1, 60):
            simulation.tick(tenth / 10)
            if tenth % 20 == 0:
                unit.write("4x18", 0)
        assert unit.read("1x17") is False
        simulation.tick(10.0)
        assert unit.read("1x17") is True
        assert unit.read("3x4", "int16") == 0
        unit.write("4x18", 0)
        simulation.tick(10.5)
        assert unit.read("1x17") is False
        assert unit.read("3x4", "int16") == 5000


def test_the_thermostat_reaches_its_set_point_and_alarms_where_it_should() -> None:
    simulation = simulation_of("thermostat")
    with asked(simulation) as unit:
        assert unit.read("4x1", "int16") == 210
        assert unit.read("4x4") == 1
        simulation.tick(600.0)
        assert unit.read("4x1", "int16") == pytest.approx(1500, abs=30)
        assert unit.read("4x4") == 2
        unit.write("4x14", 1000, "int16")
        simulation.tick(602.0)
        assert unit.read("4x5") == 0b1
        unit.write("4x22", 1)
        simulation.tick(604.0)
        assert unit.read("4x5") == 0b101
        assert unit.read("4x4") == 4
        with pytest.raises(ExceptionReply) as caught:
            unit.write("4x11", 7)
        assert caught.value.code == 4


@pytest.mark.real_time
def test_the_thermostat_sits_on_a_serial_line() -> None:
    with line_of_whole_frames(ports=2, baud=19_200) as line:
        near, far = (f"rtu://{path}?baud=19200&parity=even" for path in line.paths)
        with simulated_device("device:thermostat", url=near), busway.connect(far, timeout=5) as link:
            unit = link.unit(1)
            unit.write("4x2", 900, "int16")
            assert unit.read("4x2", "int16") == 900
            assert unit.read_device_identification()[1] == b"thermostat"


def test_a_hundred_meters_come_of_one_profile_with_parameters(tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text(
        '[[include]]\nfile = "device:meter"\nunits = "1-100"\nwith = { voltage = 120.0, current = 5.0 }\n'
        '[[include]]\nfile = "device:inverter"\nunits = "101-102"\nwith = { serial_number = "PV" }\n',
        encoding="utf-8",
    )
    simulation = Simulation(load_declaration(plant))
    simulation.tick(0.0)
    assert len(simulation.units) == 102
    assert simulation.point("100/voltage_l1").value == pytest.approx(120, abs=6)
    assert simulation.point("100/voltage_l1").value != simulation.point("99/voltage_l1").value
    assert simulation.point("102/common.DA").value == 102


def test_an_unknown_device_in_an_include_is_said_with_its_line(tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    plant.write_text('[[include]]\nfile = "device:toaster"\nunits = "1"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"plant\.toml:2: include\[0\]\.file: .*there is no such device, but meter"):
        load_declaration(plant)


def test_the_pages_of_the_devices_are_those_that_the_devices_give() -> None:
    assert_up_to_date("register_maps.py")
