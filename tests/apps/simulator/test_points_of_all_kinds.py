"""The simulator plays what the schema of points can say: offsets, lines, fields, halves, 48 bits, groups."""

import pytest

import busway
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.errors import ExceptionReply, InvalidRequest

PLANT = """
[[unit]]
unit = 1

point = [
    { name = "level", address = "4x1", linear = { raw = [0, 27648], value = [0.0, 100.0] }, behaviour = { kind = "constant", value = 50.0 } },
    { name = "kelvin", address = "4x2", scale = 0.1, offset = -273.1, behaviour = { kind = "constant", value = 20.0 } },
    { name = "low", address = "4x3.0-3", behaviour = { kind = "constant", value = 9.0 } },
    { name = "high", address = "4x3.4-15", value = 5 },
    { name = "half", address = "4x4", type = "int8:high", behaviour = { kind = "constant", value = -3.0 } },
    { name = "other_half", address = "4x4", type = "uint8:low", value = 200 },
    { name = "energy", address = "4x5", type = "uint48", order = "EFCDAB", behaviour = { kind = "counter", rate = 1e9 } },
    { name = "setpoint", address = "4x10", scale = 0.5, offset = 10.0, minimum = 12.0, maximum = 20.0, value = 15.0 },
    { name = "word", address = "4x10", overlaps = true },
    { name = "sum", formula = "level + kelvin" },
    { name = "base", address = "4x20", value = 100 },
]

[[unit.group]]
name = "cell"
count = 3
stride = 2
point = [
    { name = "volt", address = "4x21", behaviour = { kind = "formula", formula = "base + 1" } },
    { name = "twice", address = "4x22", behaviour = { kind = "formula", formula = "volt * 2" } },
]
"""  # noqa: E501


@pytest.fixture
def simulation() -> Simulation:
    made = Simulation(parse_declaration(PLANT, "plant.toml"))
    made.tick(0.0)
    made.tick(2.0)
    return made


def test_what_behaviours_give_stands_in_the_registers_as_the_file_says(simulation: Simulation) -> None:
    device = simulation.units[1].device
    assert [device.read(f"4x{number}") for number in (1, 2)] == [13_824, 2931]
    assert device.read("4x3") == 5 << 4 | 9
    assert device.read("4x4") == 0xFD << 8 | 200
    assert device.read("4x5", "uint48", order="EFCDAB") == 2_000_000_000
    assert [device.read(f"4x{number}") for number in range(21, 27)] == [101, 202, 101, 202, 101, 202]


def test_values_are_in_the_unit_of_measure_and_formulas_see_them_so(simulation: Simulation) -> None:
    assert simulation.point("1/level").value == 50.0
    assert simulation.point("1/kelvin").value == 20.0
    assert simulation.point("1/kelvin").number == pytest.approx(20.0)
    assert simulation.point("1/half").value == -3
    assert simulation.point("1/cell.3.twice").value == 202
    with pytest.raises(InvalidRequest, match="no point"):
        simulation.point("1/sum")  # computed by those who read, and nowhere in the device


def test_a_write_beyond_the_range_is_refused_in_simulations_and_in_what_serve_serves(simulation: Simulation) -> None:
    plain = busway_device()
    for device in (simulation.units[1].device, plain):
        with (
            busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server,
            busway.connect(server.endpoints[0], timeout=5) as link,
        ):
            unit = link.unit(1)
            unit.write("4x10", 20)  # 20 · 0.5 + 10 = 20
            with pytest.raises(ExceptionReply) as refused:
                unit.write("4x10", 21)
            assert refused.value.code == 4
            assert unit.read("4x10") == 20


def busway_device() -> busway.Device:
    """The same point as `busway serve` makes it, without a simulation."""
    from busway.config.devices import build_device
    from busway.config.files.device import parse_device_file

    text = '[[unit]]\nunit = 1\n[[unit.point]]\nname = "setpoint"\naddress = "4x10"\nscale = 0.5\noffset = 10.0\n'
    return build_device(parse_device_file(text + "minimum = 12.0\nmaximum = 20.0\n", "x").unit[0])


def test_a_write_is_told_to_all_points_that_share_the_register(simulation: Simulation) -> None:
    told: list[str] = []
    simulation.watch(lambda changes: told.extend(change.key for change in changes))
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: simulation.units[1].device}) as server,
        busway.connect(server.endpoints[0], timeout=5) as link,
    ):
        link.unit(1).write("4x10", 12)
    assert sorted(told) == ["1/setpoint", "1/word"]
    assert simulation.point("1/setpoint").value == 16.0
    assert simulation.point("1/word").value == 12
