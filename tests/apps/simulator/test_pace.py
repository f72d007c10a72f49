"""Time that is faster, slower, or stands still: nothing jumps, and nothing is lost."""

import pytest

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.errors import ConfigError
from busway.testing import FakeClock

COUNTER = """\
[[unit]]
unit = 1
[[unit.point]]
name = "pulses"
address = "3x1"
type = "uint32"
behaviour = { kind = "counter", rate = 10 }
[[unit.point]]
name = "limit"
address = "4x1"
"""


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def simulation(clock):
    return Simulation(parse_declaration(COUNTER, "counter.toml"), clock=clock)


async def test_another_speed_holds_from_now_on_and_nothing_jumps(simulation, clock):
    async with simulation.running("tcp://127.0.0.1:0"):
        clock.advance(10)
        assert simulation.points["1/pulses"].value == 100
        simulation.change_speed(60)
        assert simulation.time == 10
        clock.advance(1)
        assert simulation.time == 70
        assert simulation.points["1/pulses"].value == 700
        simulation.change_speed(0.5)
        clock.advance(10)
        assert simulation.time == 75


async def test_time_that_is_paused_stands_still_and_goes_on_where_it_stood(simulation, clock):
    async with simulation.running("tcp://127.0.0.1:0"):
        clock.advance(10)
        simulation.pause()
        assert simulation.is_paused
        assert simulation.deadline() is None
        clock.advance(1000)
        assert simulation.time == 10
        assert simulation.points["1/pulses"].value == 100
        simulation.set("1/limit", 7)
        assert simulation.points["1/limit"].changed_at == 10
        simulation.pause()
        simulation.resume()
        simulation.resume()
        clock.advance(5)
        assert simulation.time == 15
        assert simulation.points["1/pulses"].value == 150


async def test_the_speed_may_change_while_time_stands_still(simulation, clock):
    async with simulation.running("tcp://127.0.0.1:0"):
        clock.advance(10)
        simulation.pause()
        simulation.change_speed(2)
        clock.advance(10)
        simulation.resume()
        clock.advance(10)
        assert simulation.time == 30


def test_without_a_clock_time_goes_on_from_the_next_tick():
    simulation = Simulation(parse_declaration(COUNTER, "counter.toml"))
    simulation.tick(100)
    simulation.tick(110)
    simulation.change_speed(10)
    simulation.tick(500)
    assert simulation.time == 10
    simulation.tick(501)
    assert simulation.time == 20


def test_before_it_runs_a_clock_moves_nothing_by_itself(simulation, clock):
    simulation.change_speed(2)
    simulation.pause()
    simulation.resume()
    clock.advance(10)
    assert simulation.points["1/pulses"].value == 0


@pytest.mark.parametrize("speed", [0, -1, float("inf"), float("nan")])
def test_a_speed_that_cannot_be_is_refused(simulation, speed):
    with pytest.raises(ConfigError, match="speed"):
        simulation.change_speed(speed)
    assert simulation.speed == 1
