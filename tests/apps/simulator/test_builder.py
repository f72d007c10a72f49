"""Formulas and what they need: names, orders, circles."""

import pytest

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.config.files.file_error import FileError


def simulated(*units: str) -> Simulation:
    text = "".join(f"[[unit]]\nunit = {number}\n{unit}" for number, unit in enumerate(units, 1))
    return Simulation(parse_declaration(text, "x.toml"))


def point(name: str, offset: int, behaviour: str = "", **keys: object) -> str:
    lines = [f'[[unit.point]]\nname = "{name}"\naddress = "holding:{offset}"']
    lines += [f"{key} = {value!r}" for key, value in ({"type": "float32"} | keys).items()]
    if behaviour:
        lines.append(f"behaviour = {{ {behaviour} }}")
    return "\n".join(lines) + "\n"


def formula(text: str) -> str:
    return f"kind = 'formula', formula = '{text}'"


def test_formulas_are_computed_after_what_they_need_whatever_the_order_in_the_file() -> None:
    simulation = simulated(
        point("c", 0, formula("b + 1")) + point("b", 2, formula("a + 1")) + point("a", 4, formula("t"))
    )
    simulation.tick(0.0)
    simulation.tick(5.0)
    assert [simulation.points[f"1/{name}"].value for name in "abc"] == [5, 6, 7]


def test_formulas_cross_units_in_both_directions_at_one_moment() -> None:
    simulation = simulated(
        point("a", 0, formula("t")) + point("c", 2, formula('point("2/b") + 1')),
        point("b", 0, formula('point("1/a") * 10')),
    )
    simulation.tick(0.0)
    simulation.tick(3.0)
    assert simulation.points["2/b"].value == 30
    assert simulation.points["1/c"].value == 31


def test_a_formula_reads_points_of_another_pace_as_they_are_at_the_moment() -> None:
    simulation = simulated(
        point("slow", 0, formula("fast") + ", every = 2.0") + point("fast", 2, formula("t") + ", every = 0.5")
    )
    simulation.tick(0.0)
    simulation.tick(3.0)
    assert simulation.points["1/fast"].value == 3.0
    assert simulation.points["1/slow"].value == 2.0


@pytest.mark.parametrize(
    ("units", "line", "sentence"),
    [
        ([point("a", 0, formula("a"))], 7, "depends on itself: a → a"),
        ([point("a", 0, formula("b")) + point("b", 2, formula("a"))], 7, "depends on itself: a → b → a"),
        (
            [point("a", 0, formula('point("2/b")')), point("b", 0, formula('point("1/a")'))],
            7,
            "depends on itself: 1/a → 2/b → 1/a",
        ),
        ([point("a", 0, formula("x + 1"))], 7, "there is no point 'x'; there are a"),
        ([point("a", 0, formula('point("7/x")'))], 7, "there is no point '7/x'"),
        ([point("a", 0, "kind = 'counter', rate = 'x'")], 7, "behaviour.rate: there is no point 'x'"),
        ([point("a", 0, "kind = 'lag', target = '1 +', time_constant = 1")], 7, "behaviour.target: '1 +' is no"),
        ([point("a", 0, formula("b")) + point("b", 2, type="string:4")], 7, "'b' holds no number, but string:4"),
        ([point("a", 0, "kind = 'replay', file = 'none.csv'")], 7, "behaviour.file: none.csv: cannot be opened"),
    ],
)
def test_what_cannot_be_computed_is_refused_at_its_line(units: list[str], line: int, sentence: str) -> None:
    with pytest.raises(FileError) as caught:
        simulated(*units)
    assert caught.value.line == line
    assert sentence in str(caught.value)


def test_a_circle_through_a_counter_and_a_lag_is_none() -> None:
    simulation = simulated(
        point("level", 0, "kind = 'counter', rate = 'inflow - 1'", value=5.0)
        + point("inflow", 2, "kind = 'lag', target = '0 if level > 4 else 2', time_constant = 0.1", value=1.0)
    )
    simulation.tick(0.0)
    simulation.tick(60.0)
    assert 2 < simulation.points["1/level"].value < 7


def test_one_bit_follows_a_formula_and_can_be_an_input() -> None:
    simulation = simulated(
        '[[unit.point]]\nname = "on"\naddress = "0x1"\nbehaviour = { kind = "formula", formula = "t >= 2" }\n'
        '[[unit.point]]\nname = "bit"\naddress = "4x1.9"\nbehaviour = { kind = "formula", formula = "on" }\n'
        '[[unit.point]]\nname = "low"\naddress = "4x1.0"\nbehaviour = { kind = "formula", formula = "not on" }\n'
    )
    simulation.tick(0.0)
    device = simulation.units[1].device
    assert (device.coils[0], device.holding_registers[0]) == (False, 0x0001)
    simulation.tick(2.0)
    assert (device.coils[0], device.holding_registers[0]) == (True, 0x0200)
