"""When points change: moments, what is left out by a program that cannot keep up, and where it may rest."""

import pytest

from busway.apps.simulator.builder import build_simulation
from busway.apps.simulator.engine import Engine
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulated import SimulatedPoint

UNIT = """\
[[unit]]
unit = {unit}
[[unit.point]]
name = "slow"
address = "3x1"
type = "float64"
behaviour = {{ kind = "counter", rate = 1, every = 2 }}
[[unit.point]]
name = "fast"
address = "3x5"
type = "float64"
behaviour = {{ kind = "counter", rate = 1, every = 0.5 }}
[[unit.point]]
name = "sum"
address = "3x9"
type = "float64"
behaviour = {{ kind = "formula", formula = "slow + fast", every = 0.5 }}
"""


class Running:
    """An engine, its points, and what it told."""

    def __init__(self, units: int = 1) -> None:
        text = "".join(UNIT.format(unit=unit) for unit in range(1, units + 1))
        built = build_simulation(parse_declaration(text, "x.toml").units, 0)
        self.points = built.points
        self.told: list[tuple[float, set[str]]] = []
        self.engine = Engine(built.driven, self._told)

    def _told(self, points: list[SimulatedPoint], time: float) -> None:
        self.told.append((time, {point.key for point in points}))

    def values(self) -> list[float]:
        return [point.value for point in self.points.values()]


def test_points_change_at_their_own_moments_and_those_of_one_moment_together() -> None:
    running = Running()
    assert running.engine.deadline() == 0.0
    assert running.engine.run(2.0)
    both = {"1/fast", "1/sum"}
    assert running.told == [(0.5, both), (1.0, both), (1.5, both), (2.0, {"1/slow", *both})]
    assert running.values() == [2.0, 2.0, 4.0]
    assert running.engine.deadline() == 2.5


def test_moments_that_were_missed_can_be_left_out() -> None:
    running = Running()
    running.engine.run(0.0)
    assert running.engine.left_out == running.engine.changes == 0
    assert running.engine.run(100.3, skip=True)
    # 199 moments of what changes every half second, and 49 of what does every other.
    assert running.engine.left_out == 199 + 49
    assert running.engine.changes == 3
    assert len(running.told) <= 4
    assert running.values() == [100.0, 100.0, 200.0]
    assert running.engine.deadline() == 100.5


def test_it_rests_between_units_and_goes_on_where_it_was() -> None:
    running = Running(units=3)
    pauses = iter([True, True, False])
    assert not running.engine.run(0.0, pause=lambda: next(pauses))
    assert not running.engine.run(0.0, pause=lambda: next(pauses))
    assert running.engine.run(0.0, pause=lambda: next(pauses))
    running.engine.run(0.5)
    assert [keys for _, keys in running.told] == [{f"{unit}/fast", f"{unit}/sum"} for unit in (1, 2, 3)]


def test_it_begins_at_a_later_time_with_what_was_kept() -> None:
    running = Running()
    running.engine.begin(101.2, {"1/slow": 7.0, "1/fast": 8.0})
    running.engine.run(101.2)
    assert running.values() == [7.0, 8.0, 15.0]
    assert running.engine.deadline() == 101.5
    running.engine.run(102.0)
    assert running.values() == [9.0, 9.0, 18.0]
    assert running.engine.state_of(running.points["1/slow"], 103.9) == pytest.approx(9.0)


def test_a_point_without_a_behaviour_is_neither_driven_nor_held() -> None:
    built = build_simulation(
        parse_declaration('[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\n', "x.toml").units, 0
    )
    engine = Engine(built.driven, lambda points, time: None)
    (point,) = built.points.values()
    engine.hold(point, 0.0)
    engine.release(point, 0.0)
    assert not engine.drives(point)
    assert not point.is_held
    assert engine.deadline() is None
    assert engine.run(100.0)
    assert engine.state_of(point, 1.0) is None
