"""Cloning: what is served, recorded and served again gives the same registers, and nothing is ever written."""

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

import busway
import busway.testing
from busway.apps.simulator.clone import Clone, clone_points, clone_tables, watch_points
from busway.apps.simulator.csv_register_map import parse_register_map
from busway.apps.simulator.device_text import device_text
from busway.codes import Table
from busway.config.devices import build_device
from busway.config.files.behaviours import CounterSection, RandomWalkSection
from busway.config.files.simulation import SimulatedPointSection, SimulationFile
from busway.config.files.toml_source import read_source
from busway.errors import ExceptionReply, LinkDown, NoReply
from busway.server.table_declaration import Cells
from busway.testing import known_device

WRITES = (5, 6, 15, 16, 21, 22, 23)

MAP = """\
name,address,type,order,scale,access,min,max,enumeration
level,3x1,float32,CDAB,,,,,
temperature,3x3,int16,,0.1,,,,
total,4x1,uint64,,,ro,,,
label,4x5,string:8,,,,,,
mode,4x20,,,,,,,0=off|1=on
limit,4x21,,,,,0,100,
alarm,4x22.3,,,,,,,
pump,0x1,,,,,,,
door,1x7,,,,,,,
"""


def example() -> busway.Device:
    device = busway.Device(
        holding_registers={0: [0] * 8, 19: [0] * 3},
        input_registers=3,
        coils=1,
        discrete_inputs={6: 1},
        identification={0: "Acme", 1: "T-1", 2: "2.0", 4: "tank", 0x80: b"\x01\xff"},
        server_id=b"acme\x00",
    )
    device.write("3x1", 2.75, "float32", order="CDAB")
    device.write("3x3", -45, "int16")
    device.write("4x1", 2**63 + 5, "uint64")
    device.write("4x5", "Tank 7", "string:8")
    device.write("4x20", 1)
    device.write("4x21", 55)
    device.write("4x22.3", True)
    device.write("0x1", True)
    return device


@contextmanager
def asked(device: busway.Device) -> Iterator[tuple[busway.BlockingUnit, list[int]]]:
    """The device as a client sees it, and the function codes that it was asked with."""
    seen: list[int] = []
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: watched(device, seen)}) as server,
        busway.connect(server.endpoints[0], timeout=5) as link,
    ):
        yield link.unit(1), seen


def watched(device: busway.Device, seen: list[int]) -> busway.Device:
    for table in Table:
        device.on_read(table, lambda access: seen.append(access.address))
        if table.is_writable:
            device.on_write(table, refuse)
    return device


def refuse(change: object) -> None:
    raise AssertionError(f"the device was written: {change}")


def built_again(clone: Clone, *, compact: bool = False) -> busway.Device:
    """The device of the file that was made of a clone."""
    text = device_text([clone.section], compact=compact)
    file = read_source(text, "clone.toml").checked(SimulationFile)
    return build_device(file.unit[0])


def content(device: busway.Device) -> dict[Table, dict[int, int]]:
    """Every item that a device has."""
    found: dict[Table, dict[int, int]] = {}
    for table in Table:
        view = getattr(device, table.value)
        found[table] = {
            at: int(view[at]) for run in view._address_map.runs for at in range(run.first, run.first + run.count)
        }
    return found


def points() -> list[SimulatedPointSection]:
    return parse_register_map(MAP, "map.csv")


def test_with_a_map_the_clone_gives_the_same_registers_as_the_device() -> None:
    device = example()
    with asked(device) as (unit, _):
        clone = clone_points(unit, points())
    assert clone.remarks == []
    assert content(built_again(clone)) == content(device)


def test_a_clone_of_a_clone_is_the_same_file() -> None:
    with asked(example()) as (unit, _):
        first = device_text([clone_points(unit, points()).section])
    with asked(build_device(read_source(first, "f").checked(SimulationFile).unit[0])) as (unit, _):
        assert device_text([clone_points(unit, points()).section]) == first


def test_values_are_in_their_units_of_measure_and_declarations_stay() -> None:
    with asked(example()) as (unit, _):
        section = clone_points(unit, points()).section
    values = {point.name: point.value for point in section.point}
    assert values == {
        "level": 2.75,
        "temperature": -4.5,
        "total": 2**63 + 5,
        "label": "Tank 7",
        "mode": 1,
        "limit": 55,
        "alarm": True,
        "pump": True,
        "door": True,
    }
    assert section.point[2].access == "read"
    assert section.point[4].enumeration == {"off": 0, "on": 1}


def test_each_point_is_read_once_and_nothing_is_written() -> None:
    with asked(example()) as (unit, seen):
        clone_points(unit, points())
    assert len(seen) == len(points())


def test_what_the_device_says_of_itself_is_recorded() -> None:
    with asked(example()) as (unit, _):
        again = built_again(clone_points(unit, points()))
    with asked(again) as (unit, _):
        objects = unit.read_device_identification("extended")
        assert unit.report_server_id() == b"acme\x00"
    assert objects == {0: b"Acme", 1: b"T-1", 2: b"2.0", 4: b"tank", 0x80: b"\x01\xff"}


@pytest.mark.parametrize(
    ("kind", "raw"),
    [
        ("float32", bytes.fromhex("7fc00001")),
        ("float32", bytes.fromhex("ff800000")),
        ("float32", bytes.fromhex("80000000")),
        ("float64", struct.pack(">d", math.pi)),
        ("bcd32", bytes.fromhex("0012abcd")),
        ("string:4", b"\xff\xfe\x00a"),
        ("string:4", b"a\x00b\x00"),
        ("bits", b"\xa5\x5a"),
        ("int32", b"\xff\xff\xff\xff"),
    ],
)
@pytest.mark.parametrize("scale", ["", "0.1", "3"])
def test_any_registers_come_back_as_they_were_whatever_their_type_makes_of_them(
    kind: str, raw: bytes, scale: str
) -> None:
    scale = scale if kind.startswith(("float", "int", "bcd")) else ""
    registers = [int.from_bytes(raw[at : at + 2], "big") for at in range(0, len(raw), 2)]
    device = busway.Device(holding_registers=registers)
    with asked(device) as (unit, _):
        clone = clone_points(unit, parse_register_map(f"name,address,type,scale\na,4x1,{kind},{scale}\n", "map.csv"))
    assert content(built_again(clone)) == content(device)


def test_a_value_outside_its_range_or_names_widens_them() -> None:
    text = "name,address,min,max,enumeration\nlow,4x1,10,20,\nhigh,4x2,10,20,\nmode,4x3,,,0=off|1=on\n"
    device = busway.Device(holding_registers=[5, 50, 7])
    with asked(device) as (unit, _):
        clone = clone_points(unit, parse_register_map(text, "map.csv"))
    low, high, mode = clone.section.point
    assert (low.minimum, low.maximum) == (5, 20)
    assert (high.minimum, high.maximum) == (10, 50)
    assert mode.enumeration == {"off": 0, "on": 1, "value 7": 7}
    assert content(built_again(clone)) == content(device)


def test_the_range_of_a_value_with_a_power_of_ten_stays() -> None:
    device = busway.Device(holding_registers=[50, 0xFFFF])
    watts = {"name": "watts", "address": "4x1", "scale_from": "exponent", "minimum": 1, "maximum": 10}
    exponent = {"name": "exponent", "address": "4x2", "type": "int16"}
    with asked(device) as (unit, _):
        clone = clone_points(unit, [SimulatedPointSection.model_validate(each) for each in (watts, exponent)])
        learnt = watch_points(unit, clone, [1.0])
    for each in (clone, learnt):
        found = each.section.point[0]
        assert (found.value, found.minimum, found.maximum) == (50, 1, 10)
        assert content(built_again(each)) == content(device)


def test_bits_beside_those_with_a_name_are_kept() -> None:
    device = busway.Device(holding_registers=[0b1010_0000_0000_1001])
    with asked(device) as (unit, seen):
        clone = clone_points(unit, parse_register_map("name,address\na,4x1.0\nb,4x1.1\n", "map.csv"))
    assert [point.name for point in clone.section.point] == ["a", "b", "4x1.3", "4x1.13", "4x1.15"]
    assert content(built_again(clone)) == content(device)
    assert len(seen) == 1


def test_a_point_that_the_device_refuses_is_left_out_and_said() -> None:
    text = "name,address\nthere,4x1\ngone,4x100\n"
    with asked(busway.Device(holding_registers=10)) as (unit, _):
        clone = clone_points(unit, parse_register_map(text, "map.csv"))
    assert [point.name for point in clone.section.point] == ["there"]
    (remark,) = clone.remarks
    assert remark.startswith("left out: point gone at 4x100: the device answered with exception 02")


def test_a_device_that_refuses_every_point_is_an_error_that_names_the_first() -> None:
    with asked(busway.Device()) as (unit, _), pytest.raises(ExceptionReply, match="point level at 3x1: "):
        clone_points(unit, points())


def test_a_device_that_is_silent_is_an_error_that_names_the_point() -> None:
    with busway.testing.faulty_server(known_device(), "late", delay=30) as server:
        server.faults.remove(next(iter(server.faults)))
        server.add("late", delay=30, addresses=range(20, 21))
        with busway.connect(server.endpoint, timeout=0.05, retries=0) as link:
            text = "name,address\na,4x1\nb,4x21\n"
            with pytest.raises(NoReply, match="point b at 4x21: "):
                clone_points(link.unit(1), parse_register_map(text, "map.csv"))


def test_a_device_that_is_not_there_is_an_error_at_once() -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: example()}) as server:
        (endpoint,) = server.endpoints
    with busway.connect(endpoint) as link, pytest.raises(LinkDown):
        clone_points(link.unit(1), points())


@pytest.mark.parametrize(
    "make",
    [
        lambda: busway.Device(holding_registers=list(range(300)), coils=[True, False, True]),
        lambda: busway.Device(holding_registers=Cells(100, 20, [0, 7])),
        lambda: busway.Device(holding_registers={0: [1, 2], 130: [3] * 40, 260: 9}, input_registers={500: [1, 0]}),
        lambda: busway.Device(coils={0: 1, 10: [1, 0, 1], 1990: [1] * 20}, discrete_inputs=2500),
        lambda: busway.Device(input_registers=[0] * 200),
        known_device,
    ],
)
@pytest.mark.parametrize("compact", [False, True])
def test_without_a_map_the_tables_are_found_with_their_holes(make: Callable[[], busway.Device], compact: bool) -> None:
    device = make()
    with asked(device) as (unit, _):
        clone = clone_tables(unit, ranges=(range(3000),))
    assert content(built_again(clone, compact=compact)) == content(device)


def test_single_items_off_the_beaten_track_need_a_thorough_search() -> None:
    device = busway.Device(holding_registers={3: 7, 1004: 8, 1007: 9}, functions=[3])
    ranges = (range(10), range(1000, 1020))
    lines: list[str] = []
    with asked(device) as (unit, _):
        thorough = clone_tables(unit, ranges=ranges, thorough=True, progress=lines.append)
        assert content(built_again(thorough)) == content(device)
        assert "3 holding registers" in lines
        with pytest.raises(ExceptionReply, match="nothing to clone, everything was refused"):
            clone_tables(unit, ranges=ranges)


def test_a_table_that_is_not_offered_costs_one_request_and_is_said() -> None:
    device = busway.Device(holding_registers=[1, 2, 3], functions=[3])
    lines: list[str] = []
    with busway.testing.faulty_server(device) as server, busway.connect(server.endpoint) as link:
        clone = clone_tables(link.unit(1), ranges=(range(1000),), progress=lines.append)
        asked_by = [request.function for request in server.requests]
    assert [asked_by.count(function) for function in (1, 2, 4)] == [1, 1, 1]
    assert "coils are not offered" in clone.remarks
    assert content(built_again(clone)) == content(device)
    assert "3 holding registers; in 7 refused blocks only every tenth item was tried" in lines


def test_a_device_without_anything_is_said_to_have_nothing() -> None:
    with (
        asked(busway.Device()) as (unit, _),
        pytest.raises(ExceptionReply, match="nothing to clone, everything was refused"),
    ):
        clone_tables(unit, ranges=(range(100),))


def test_nothing_but_reading_functions_is_ever_sent() -> None:
    with busway.testing.faulty_server(example()) as server, busway.connect(server.endpoint) as link:
        clone_points(link.unit(1), points())
        clone_tables(link.unit(1), ranges=(range(300),))
        assert {request.function for request in server.requests}.isdisjoint(WRITES)


def test_numbers_that_change_while_they_are_watched_are_given_behaviours() -> None:
    text = (
        "name,address,type,scale,min,max,enumeration\n"
        "total,4x1,uint32,,,,\nlevel,4x3,float32,,0,3,\nfixed,4x5,,0.1,,,\nmode,4x6,,,,,0=off|1=on\nrun,0x1,,,,,\n"
    )
    device = busway.Device(holding_registers=6, coils=1)
    device.write("4x3", 2.0, "float32")
    with asked(device) as (unit, _):
        clone = clone_points(unit, parse_register_map(text, "map.csv"))

        def moments() -> Iterator[float]:
            for second in (1, 2, 3, 4):
                device.write("4x1", 10 * second, "uint32")
                device.write("4x3", 2.0 + second * (-1) ** second, "float32")
                device.write("4x6", second % 2)
                device.write("0x1", second % 2 == 0)
                yield float(second)

        learnt = watch_points(unit, clone, moments())
    total, level, fixed, mode, run = learnt.section.point
    assert total.behaviour == CounterSection(kind="counter", rate=10.0)
    assert level.behaviour == RandomWalkSection(kind="random-walk", step=7.0, low=-1.0, high=6.0, every=1.0)
    assert (level.value, level.minimum, level.maximum) == (2.0, -1.0, 6.0)
    assert fixed.behaviour is mode.behaviour is run.behaviour is None
    built_again(learnt)


def test_a_point_that_fails_while_it_is_watched_is_named() -> None:
    device = busway.Device(holding_registers=2)
    with asked(device) as (unit, _):
        clone = clone_points(unit, parse_register_map("name,address\na,4x1\nb,4x2\n", "map.csv"))
        device.functions = [6]
        with pytest.raises(ExceptionReply, match="point a at 4x1: "):
            watch_points(unit, clone, [1.0])
