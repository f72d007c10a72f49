"""A simulation as a whole: time, values set by hand and by Modbus, and changes that are told."""

import asyncio
import math
import threading
from typing import Any

import pytest
from simulated_points import PLANT_UNIT

import busway
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulated import PointChanged
from busway.apps.simulator.simulation import Simulation
from busway.errors import ConfigError, InvalidRequest
from busway.faults.clock import FakeClock

PLANT = 'listen = ["tcp://127.0.0.1:0"]\n' + PLANT_UNIT


def simulated(text: str = PLANT, **options: Any) -> Simulation:
    return Simulation(parse_declaration(text, "plant.toml"), **options)


def test_units_and_points_are_found_by_number_and_key_and_say_what_they_are() -> None:
    simulation = simulated()
    assert simulation.units[1].name == "plant"
    assert list(simulation.units[1].points) == [key.removeprefix("1/") for key in simulation.points]
    point = simulation.points["1/voltage"]
    assert (point.unit, point.name, point.notation, point.address) == (1, "voltage", "3x1", 0)
    assert (point.type, point.order, point.scale, point.access) == ("float32", "ABCD", 1.0, "read")
    assert (point.unit_of_measure, point.description) == ("V", "Of the grid.")
    assert point.behaviour == "sine: mean 230, amplitude 4, period 60"
    assert (point.value, point.raw, point.changed_at, point.last_writer) == (230.0, "4366 0000", 0.0, "simulation")
    mode = simulation.points["1/mode"]
    assert (mode.value, mode.label, mode.behaviour, mode.access) == (1, "auto", "", "read-write")
    pump = simulation.points["1/pump"]
    assert (pump.value, pump.type, pump.raw) == (True, "bit", "1")
    assert simulation.points["1/label"].value == "abcd"
    with pytest.raises(InvalidRequest, match="there is no point '1/x'"):
        simulation.set("1/x", 1)


def test_values_follow_the_time_of_a_clock_and_nothing_else() -> None:
    simulation = simulated()
    assert simulation.deadline() is None
    simulation.tick(1000.0)
    assert simulation.deadline() == 1001.0
    simulation.tick(1015.4)
    assert simulation.time == pytest.approx(15.4)
    assert simulation.points["1/voltage"].value == pytest.approx(234.0)
    assert simulation.points["1/voltage"].changed_at == 15.0
    assert simulation.points["1/energy"].value == 30
    assert simulation.points["1/energy"].raw == "001E 0000"
    assert simulation.deadline() == 1016.0


def test_a_faster_simulation_reaches_the_same_values_sooner() -> None:
    fast = simulated(speed=60)
    fast.tick(0.0)
    fast.tick(1.0)
    slow = simulated()
    slow.tick(0.0)
    slow.tick(60.0)
    assert fast.time == slow.time == 60.0
    assert [each.value for each in fast.points.values()] == [each.value for each in slow.points.values()]
    assert fast.deadline() == pytest.approx(1 + 1 / 60)
    with pytest.raises(ConfigError, match="speed"):
        simulated(speed=0)


def test_the_same_seed_gives_the_same_values_another_seed_others() -> None:
    values = []
    for seed in (1, 1, 2):
        simulation = simulated(seed=seed)
        simulation.tick(0.0)
        simulation.tick(50.0)
        values.append(simulation.points["1/walk"].value)
    assert values[0] == values[1] != values[2]


def test_a_point_that_was_set_holds_until_it_is_released() -> None:
    simulation = simulated()
    simulation.tick(0.0)
    simulation.set("1/level", 3.5, "anna")
    simulation.tick(10.0)
    level = simulation.points["1/level"]
    assert (level.value, level.last_writer, level.is_held) == (3.5, "anna", True)
    simulation.release("1/level")
    assert level.value == 3.5
    simulation.tick(11.0)
    assert level.value == pytest.approx(0.44)
    assert (level.last_writer, level.is_held) == ("simulation", False)


def test_a_point_resumes_by_itself_after_a_time_counted_from_its_last_write() -> None:
    simulation = simulated()
    simulation.tick(0.0)
    simulation.set("1/speed", 1.5)
    simulation.tick(3.0)
    simulation.set("1/speed", 2.5)
    simulation.tick(6.0)
    assert simulation.points["1/speed"].value == 2.5
    simulation.tick(9.0)
    assert simulation.points["1/speed"].value == 10.0


def test_a_release_that_was_due_does_not_end_a_later_hold() -> None:
    simulation = simulated()
    simulation.tick(0.0)
    simulation.set("1/speed", 1.5)
    simulation.tick(1.0)
    simulation.release("1/speed")
    simulation.set("1/speed", 2.5)
    simulation.tick(5.5)
    assert simulation.points["1/speed"].value == 2.5


def test_a_counter_goes_on_from_what_it_was_set_to() -> None:
    simulation = simulated()
    simulation.tick(0.0)
    simulation.tick(10.0)
    simulation.set("1/energy", 1000)
    simulation.tick(15.0)
    assert simulation.points["1/energy"].value == 1010


def test_the_range_of_a_point_that_is_set_counts_its_power_of_ten() -> None:
    simulation = simulated(
        "[[unit]]\nunit = 1\npoint = [\n"
        "{ name = 'watts', address = '4x1', scale_from = 'exponent', maximum = 10, value = 50 },\n"
        "{ name = 'exponent', address = '4x2', type = 'int16', value = -1 },\n]\n"
    )
    simulation.set("1/watts", 100)
    with pytest.raises(InvalidRequest, match=r"1/watts: must be at most 10, not 10\.1"):
        simulation.set("1/watts", 101)
    simulation.set("1/exponent", 0)
    with pytest.raises(InvalidRequest, match="1/watts: must be at most 10, not 50"):
        simulation.set("1/watts", 50)


def test_a_counter_whose_point_has_an_offset_counts_on_where_its_register_rolls_over() -> None:
    simulation = simulated(
        "[[unit]]\nunit = 1\n[[unit.point]]\nname = 'energy'\naddress = '4x1'\noffset = -1000\nvalue = 64000\n"
        "behaviour = { kind = 'counter', rate = 100 }\n"
    )
    simulation.tick(0.0)
    simulation.tick(5.0)
    assert simulation.points["1/energy"].raw == "FFDC"  # 64 500
    simulation.tick(6.0)
    assert (simulation.points["1/energy"].value, simulation.points["1/energy"].raw) == (-936, "0040")


def test_what_is_no_number_does_not_stay_in_a_counter() -> None:
    simulation = simulated(PLANT.replace('type = "uint32"\norder = "CDAB"', 'type = "float32"'))
    simulation.tick(0.0)
    simulation.set("1/energy", math.nan)
    assert math.isnan(simulation.points["1/energy"].value)
    simulation.tick(5.0)
    assert simulation.points["1/energy"].value == 10.0


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("1/level", 5.0, "1/level: must be 0…4, not 5.0"),
        ("1/level", "x", "1/level: "),
        ("1/speed", 0.05, "1/speed: 0.05 is no whole number of steps of 0.1"),
        ("1/mode", "on", "1/mode: there is no 'on'; there are off, auto"),
        ("1/mode", 2, "1/mode: must be off (0), auto (1), not 2"),
        ("1/pump", 1, "1/pump: one bit is true or false, not 1"),
        ("1/label", 5, "1/label: "),
    ],
)
def test_a_value_that_does_not_fit_is_refused_in_a_sentence(key: str, value: object, sentence: str) -> None:
    simulation = simulated()
    before = simulation.points[key].value
    with pytest.raises(InvalidRequest) as caught:
        simulation.set(key, value)
    assert str(caught.value).startswith(sentence)
    assert simulation.points[key].value == before
    assert simulation.points[key].last_writer == "simulation"


def test_names_and_what_modbus_cannot_write_can_be_set_by_hand() -> None:
    simulation = simulated()
    simulation.set("1/mode", "off")
    assert simulation.points["1/mode"].value == 0
    simulation.set("1/voltage", 100.0)
    simulation.tick(0.0)
    simulation.tick(5.0)
    assert simulation.points["1/voltage"].value == 100.0
    simulation.set("1/label", "xy")
    assert simulation.points["1/label"].value == "xy"


def test_changes_are_told_together_with_who_made_them(caplog: pytest.LogCaptureFixture) -> None:
    simulation = simulated()
    told: list[list[tuple[str, Any, float, str]]] = []

    def watcher(changes: list[PointChanged]) -> None:
        told.append([(each.key, each.value, each.at, each.who) for each in changes])

    def broken(changes: list[PointChanged]) -> None:
        raise RuntimeError("a watcher that fails")

    simulation.watch(broken)
    end = simulation.watch(watcher)
    simulation.tick(0.0)
    simulation.tick(1.0)
    simulation.set("1/mode", "off", "page")
    (moment, by_hand) = told
    assert {key for key, *_ in moment} == {"1/voltage", "1/energy", "1/level", "1/walk"}
    assert {(at, who) for _, _, at, who in moment} == {(1.0, "simulation")}
    assert by_hand == [("1/mode", 0, 1.0, "page")]
    assert "a watcher of points failed" in caplog.text
    end()
    simulation.tick(2.0)
    assert len(told) == 2


async def test_modbus_writes_are_judged_held_and_told() -> None:
    clock = FakeClock()
    simulation = simulated(clock=clock)
    told: list[PointChanged] = []
    simulation.watch(told.extend)
    async with simulation.running() as running, busway.open(running.server.endpoints[0]) as link:
        unit = link.unit(1)
        await unit.write("4x3", 2.5, "float32")
        assert (told[-1].key, told[-1].value) == ("1/level", 2.5)
        assert told[-1].who.startswith("127.0.0.1:")
        for write in (
            unit.write("4x3", 4.5, "float32"),
            unit.write("4x3", math.nan, "float32"),
            unit.write("4x6", 2),
            unit.write("4x5", 501),
            # The first of two registers of a float32: 2.5 becomes 10.0.
            unit.write_single_register(2, 0x4120),
            # One of several points that are written at once does not fit.
            unit.write_multiple_registers(4, [100, 2]),
        ):
            with pytest.raises(busway.ExceptionReply) as caught:
                await write
            assert caught.value.code == 4
        assert await unit.read("4x3", "float32") == 2.5
        assert simulation.points["1/speed"].value == 10.0
        clock.advance(30.0)
        assert await unit.read("4x3", "float32") == 2.5
        assert await unit.read("4x1", "uint32", order="CDAB") == 60
        await unit.write_single_coil(0, False)
        assert simulation.points["1/pump"].value is False
        assert simulation.points["1/pump"].last_writer.startswith("127.0.0.1:")
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.read_input_registers(2, count=2)
        assert caught.value.code == 2
    with pytest.raises(ConfigError, match="does not run"):
        _ = simulation.server


async def test_points_move_by_the_clock_of_the_loop() -> None:
    simulation = simulated(PLANT.replace("period = 60 }", "period = 60, every = 0.01 }"))
    moved = asyncio.Event()
    simulation.watch(lambda changes: moved.set())
    async with simulation.running():
        await asyncio.wait_for(moved.wait(), 60)
        first = simulation.time
    assert first > 0
    assert simulation.time >= first
    assert simulation.deadline() is None
    async with simulation.running():
        moved.clear()
        await asyncio.wait_for(moved.wait(), 60)
        assert simulation.time > first


async def test_a_hold_from_another_thread_ends_in_time() -> None:
    released = asyncio.Event()
    text = PLANT.replace("resume_after = 5", "resume_after = 0.02, every = 0.05")
    simulation = simulated(text)
    speed = simulation.points["1/speed"]
    async with simulation.running():
        loop = asyncio.get_running_loop()
        simulation.watch(
            lambda changes: (
                released.set() if any(each.point is speed and each.who == "simulation" for each in changes) else None
            )
        )
        thread = threading.Thread(target=lambda: simulation.set("1/speed", 1.5))
        thread.start()
        await loop.run_in_executor(None, thread.join)
        await asyncio.wait_for(released.wait(), 60)
    assert speed.value == 10.0


def test_holes_between_points_are_refused_or_read_and_never_written() -> None:
    text = (
        '[[unit]]\nunit = 1\nholes = {{ holding_registers = {} }}\n[[unit.point]]\nname = "a"\naddress = "4x1"\n'
        '[[unit.point]]\nname = "b"\naddress = "4x5"\nvalue = 9\n'
    )
    simulation = simulated(text.format("7"))
    served = busway.serve_in_thread("tcp://127.0.0.1:0", units={1: simulation.units[1].device})
    with served as server, busway.connect(server.endpoints[0]) as link:
        unit = link.unit(1)
        assert unit.read_holding_registers(0, count=5) == [0, 7, 7, 7, 9]
        for address, count in ((2, 1), (0, 5)):
            with pytest.raises(busway.ExceptionReply) as caught:
                unit.write_multiple_registers(address, [1] * count)
            assert caught.value.code == 2
        with pytest.raises(busway.ExceptionReply):
            unit.read_holding_registers(5, count=1)
    assert simulated(text.format('"refuse"')).units[1].device.holding_registers.ranges == ((0, 1), (4, 1))


def test_a_day_passes_without_drift() -> None:
    text = (
        '[[unit]]\nunit = 1\n[[unit.point]]\nname = "sine"\naddress = "3x1"\ntype = "float64"\n'
        'behaviour = { kind = "sine", mean = 50, amplitude = 10, period = 7, every = 10 }\n'
        '[[unit.point]]\nname = "count"\naddress = "3x5"\ntype = "float64"\n'
        'behaviour = { kind = "counter", rate = 0.1, every = 7.7 }\n'
        '[[unit.point]]\nname = "pulses"\naddress = "3x9"\ntype = "uint16"\n'
        'behaviour = { kind = "counter", rate = 3, every = 1 }\n'
        '[[unit.point]]\nname = "sum"\naddress = "3x10"\ntype = "float64"\n'
        'behaviour = { kind = "counter", rate = "half", every = 10 }\n'
        '[[unit.point]]\nname = "half"\naddress = "3x14"\ntype = "float64"\n'
        'behaviour = { kind = "constant", value = 0.5, every = 86400 }\n'
    )
    clock = FakeClock(12_345.678)
    simulation = simulated(text, clock=clock)
    moments: list[float] = []

    def seen(changes: list[PointChanged]) -> None:
        moments.extend(each.at for each in changes if each.point.name == "pulses")

    simulation.watch(seen)
    hours = 24
    for hour in range(1, hours + 1):
        simulation.tick(clock.now() + 3600.0 * hour)
        time = 3600 * hour
        sine = 50 + 10 * math.sin(2 * math.pi * (time % 7) / 7)
        assert simulation.points["1/sine"].value == pytest.approx(sine, abs=1e-9)
        # Its last moment was the last whole multiple of 7.7 s.
        last = time * 10 // 77 * 7.7
        assert simulation.points["1/count"].value == pytest.approx(0.1 * last, rel=1e-12)
        assert simulation.points["1/pulses"].value == 3 * time % 65_536
        assert simulation.points["1/sum"].value == 0.5 * time
    assert moments == [float(second) for second in range(1, 3600 * hours + 1)]
