"""From a device file to devices: memory, values, what is read-only, and what a server of it answers."""

from pathlib import Path

import pytest

import busway
from busway.apps.service.configuration import parse_configuration
from busway.apps.simulator.points import Points
from busway.config.devices import build_device, build_units
from busway.config.files.device import parse_device_file

GOOD = (Path(__file__).parents[1] / "config" / "files" / "good.toml").read_text(encoding="utf-8")


def test_each_unit_has_a_memory_of_its_own() -> None:
    units = build_units(parse_device_file(GOOD, "good.toml"))
    assert sorted(units) == [1, 2, 7]
    units[1].holding_registers[0] = 99
    assert units[2].holding_registers[0] == 1


def test_points_hold_their_first_values() -> None:
    boiler = build_units(parse_device_file(GOOD, "good.toml"))[1]
    assert boiler.read("4x51", "float32", order="CDAB") == 21.5
    assert boiler.input_registers[0] == 125
    assert boiler.coils[0] is True
    assert boiler.holding_registers[59] == 0b1000


def test_a_table_that_is_not_declared_has_the_items_of_its_points() -> None:
    label = build_units(parse_device_file(GOOD, "good.toml"))[7]
    assert label.holding_registers.ranges == ((16, 4),)
    assert label.read("holding:16", "string:8") == "pump"
    assert label.coils.ranges == ()


def test_points_have_values_in_their_unit_of_measure() -> None:
    (boiler, _) = parse_device_file(GOOD, "good.toml").unit
    device = build_device(boiler)
    points = Points(device, boiler.point)
    assert points["pressure"] == 1.25
    points["pressure"] = -0.5
    assert device.read("3x1", "int16") == -50
    points["alarm"] = False
    assert device.holding_registers[59] == 0
    assert list(points) == ["temperature", "pressure", "burner", "alarm"]


def test_a_point_of_some_bits_keeps_the_others_of_its_register() -> None:
    text = '[[unit]]\nunit = [1]\n[[unit.point]]\nname = "mode"\naddress = "4x1.4-7"\n'
    (unit,) = parse_device_file(text, "x.toml").unit
    device = build_device(unit)
    device.holding_registers[0] = 0xF00F
    points = Points(device, unit.point)
    points["mode"] = 5
    assert points["mode"] == 5
    assert device.holding_registers[0] == 0xF05F


def test_a_point_takes_no_value_that_does_not_fit() -> None:
    (boiler, _) = parse_device_file(GOOD, "good.toml").unit
    points = Points(build_device(boiler), boiler.point)
    with pytest.raises(busway.InvalidRequest, match=r"1\.255 is no whole number of steps"):
        points["pressure"] = 1.255
    with pytest.raises(busway.InvalidRequest, match="int16"):
        points["pressure"] = 1000
    with pytest.raises(busway.InvalidRequest, match="true or false"):
        points["burner"] = 1
    with pytest.raises(busway.InvalidRequest, match="there is no point 'steam'"):
        points["steam"] = 1
    assert points["pressure"] == 1.25


async def test_a_served_file_answers_as_it_declares() -> None:
    configuration = parse_configuration(GOOD, "good.toml")
    async with (
        configuration.serve(["tcp://127.0.0.1:0"]) as server,
        busway.open(server.endpoints[0], timeout=10, retries=0) as link,
    ):
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=3) == [1, 2, 3]
        assert await unit.report_server_id() == b"boiler\xff"
        assert await unit.read_file_record(4, 1, count=2) == [0x0DFE, 0x0020]
        assert await unit.read_fifo_queue(1246) == [0x01B8, 0x1284]
        assert (await unit.read_device_identification("extended"))[0x80] == b"\x01\x02"
        for address in (10, 14, 20, 50, 51):  # ranges in read_only, and a point with access = "read"
            with pytest.raises(busway.ExceptionReply, match="exception 02"):
                await unit.write_single_register(address, 1)
        await unit.write_single_register(9, 1)
        with pytest.raises(busway.ExceptionReply, match="exception 01"):  # not among the functions
            await unit.read_exception_status()
        with pytest.raises(busway.NoReply):  # unlisted = "silence"
            await link.unit(9).read_holding_registers(0, count=1, timeout=0.1)


SCALED = """
[[unit]]
unit = 1
point = [
    { name = "watts", address = "4x1", scale_from = "scale", minimum = 1, maximum = 10, value = 50 },
    { name = "scale", address = "4x2", type = "int16", value = -1 },
    { name = "volts", address = "4x3", scale_from = "volt_scale", maximum = 300, value = 230 },
    { name = "volt_scale", address = "3x1", type = "int16" },
]
"""


async def test_a_range_counts_the_power_of_ten_that_the_registers_hold() -> None:
    configuration = parse_configuration(SCALED, "x.toml")
    async with (
        configuration.serve(["tcp://127.0.0.1:0"]) as server,
        busway.open(server.endpoints[0], shared=False) as link,
    ):
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=3) == [50, 0xFFFF, 230]
        await unit.write_single_register(0, 100)  # 10.0
        for value in (101, 9):
            with pytest.raises(busway.ExceptionReply, match="exception 04"):
                await unit.write_single_register(0, value)
        with pytest.raises(busway.ExceptionReply, match="exception 04"):
            await unit.write_single_register(1, 0)  # which makes it 100
        with pytest.raises(busway.ExceptionReply, match="exception 04"):
            await unit.write_single_register(1, 11)  # no exponent
        await unit.write_multiple_registers(0, [1, 1])  # 10
        await unit.write_single_register(2, 300)  # its exponent, in another table, is 0
        with pytest.raises(busway.ExceptionReply, match="exception 04"):
            await unit.write_single_register(2, 301)
        assert await unit.read_holding_registers(0, count=3) == [1, 1, 300]


def test_a_point_set_by_name_obeys_its_range_with_the_power_of_ten() -> None:
    (unit,) = parse_device_file(SCALED, "x.toml").unit
    device = build_device(unit)
    points = Points(device, unit.point)
    points["watts"] = 100
    with pytest.raises(busway.InvalidRequest, match=r"must be 1…10, not 10\.1"):
        points["watts"] = 101
    device.holding_registers[1] = 0x8000
    with pytest.raises(busway.InvalidRequest, match="its scale, scale, is -32768, no exponent"):
        points["watts"] = 5
    assert device.holding_registers[0] == 100
