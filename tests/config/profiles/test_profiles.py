"""Profiles of real devices: each is played and read, and stands where its manual says.

A profile that is played and read by itself proves only that it can be played. What it says is checked against a second
statement of the same facts, registers in the notation of the manuals, and against the bytes of the examples that
manuals have. Such examples were found for the Eastron SDM630 (phase 1 voltage), the Danfoss VLT FC series (parameters
3-03 and 1-24, the status word) and couplers of WAGO's system 750; the other manuals, those of `WITHOUT_EXAMPLE`, have
none, or none that was found.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

import busway
from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.cli.read_points import PointReader
from busway.config.profiles import DEVICES, ready_made
from busway.config.profiles.loading import load_profile
from busway.errors import ConfigError
from busway.points import Quality
from busway.points.decoder import decode_point
from busway.values import parse_address

REAL = tuple(DEVICES)[5:]


@contextmanager
def played(name: str, unit: int = 7) -> Iterator[tuple[Simulation, str]]:
    """A device at its fifth second, and where it is served."""
    simulation = Simulation(parse_declaration(f'[[include]]\nfile = "device:{name}"\nunits = "{unit}"\n', "test.toml"))
    simulation.tick(5.0)
    devices = {number: each.device for number, each in simulation.units.items()}
    with busway.serve_in_thread("tcp://127.0.0.1:0", units=devices) as server:
        yield simulation, server.endpoints[0]


@pytest.mark.parametrize("name", DEVICES)
def test_a_profile_is_played_and_every_point_of_it_is_read(name: str) -> None:
    section = load_profile(f"device:{name}", unit=7)
    with played(name) as (simulation, url), busway.connect(url, timeout=5) as link:
        records = {record.point.name: record for record in PointReader(link.unit(7), section, []).read()}
    assert records.keys() == {point.name for point in section.described()}
    for key, point in simulation.points.items():
        record = records[key.partition("/")[2]]
        if record.reading.quality is Quality.GOOD:
            assert record.reading.value == point.value, key
            assert record.raw.hex(" ", 2).upper() == point.raw or len(record.raw) == 1 or point.type == "bit", key


@pytest.mark.parametrize("name", REAL)
def test_a_profile_of_a_real_device_names_its_source_and_all_its_points_have_values(name: str) -> None:
    text = ready_made(name).text
    assert "\n# Source: " in text
    with played(name) as (_, url), busway.connect(url, timeout=5) as link:
        for record in PointReader(link.unit(7), load_profile(f"device:{name}", unit=7), []).read():
            assert record.reading.quality is Quality.GOOD, record
            assert record.point.description


FACTS = [
    # Register numbers of the 3X list that distributors publish (30001 is the first input register).
    ("sdm630", "voltage_l1", "30001", "float32", "ABCD", 1),
    ("sdm630", "current_l1", "30007", "float32", "ABCD", 1),
    ("sdm630", "power_l1", "30013", "float32", "ABCD", 1),
    ("sdm630", "power", "30053", "float32", "ABCD", 1),
    ("sdm630", "frequency", "30071", "float32", "ABCD", 1),
    ("sdm630", "energy_import", "30073", "float32", "ABCD", 1),
    ("sdm630", "energy_export", "30075", "float32", "ABCD", 1),
    ("sdm630", "energy", "30343", "float32", "ABCD", 1),
    ("sdm120", "voltage", "30001", "float32", "ABCD", 1),
    ("sdm120", "power", "30013", "float32", "ABCD", 1),
    ("sdm120", "frequency", "30071", "float32", "ABCD", 1),
    ("sdm120", "energy", "30343", "float32", "ABCD", 1),
    # Register numbers of the user manual, counted from 1.
    ("iem3155", "current_l1", "holding:2999", "float32", "ABCD", 1),
    ("iem3155", "voltage_l1", "holding:3027", "float32", "ABCD", 1),
    ("iem3155", "power", "holding:3059", "float32", "ABCD", 1),
    ("iem3155", "frequency", "holding:3109", "float32", "ABCD", 1),
    ("iem3155", "energy_import", "holding:3203", "int64", "ABCD", 1),
    ("abb_b23", "voltage_l1", "holding:23296", "uint32", "ABCD", 0.1),
    ("abb_b23", "current_l1", "holding:23308", "uint32", "ABCD", 0.01),
    ("abb_b23", "power", "holding:23316", "int32", "ABCD", 0.01),
    ("abb_b23", "frequency", "holding:23340", "uint16", "AB", 0.01),
    ("abb_b23", "energy_import", "holding:20480", "uint64", "ABCD", 0.01),
    ("umg96rm", "voltage_l1", "holding:19000", "float32", "ABCD", 1),
    ("umg96rm", "current_l3", "holding:19016", "float32", "ABCD", 1),
    ("umg96rm", "power", "holding:19026", "float32", "ABCD", 1),
    ("umg96rm", "apparent_power", "holding:19034", "float32", "ABCD", 1),
    ("umg96rm", "frequency", "holding:19050", "float32", "ABCD", 1),
    ("umg96rm", "energy_import", "holding:19068", "float32", "ABCD", 1),
    ("umg96rm", "energy_export", "holding:19076", "float32", "ABCD", 1),
    ("umg96rm", "current_thd_l3", "holding:19120", "float32", "ABCD", 1),
    ("em24", "power", "300041", "int32", "CDAB", 0.1),
    ("em24", "energy_import", "300067", "int32", "CDAB", 0.1),
    ("em340", "power", "300041", "int32", "CDAB", 0.1),
    ("em340", "frequency", "300052", "int16", "AB", 0.1),
    ("em340", "energy_import", "300053", "int32", "CDAB", 0.1),
    ("pac2200", "voltage_l1", "input:1", "float32", "ABCD", 1),
    ("pac2200", "power", "input:65", "float32", "ABCD", 1),
    ("pac2200", "energy_import", "input:801", "float64", "ABCDEFGH", 1),
    ("dtsu666", "voltage_l1", "holding:0x2006", "float32", "ABCD", 0.1),
    ("dtsu666", "power", "holding:0x2012", "float32", "ABCD", 0.1),
    ("dtsu666", "energy_import", "holding:0x101E", "float32", "ABCD", 1),
    ("wago879", "voltage_l1", "holding:0x5002", "float32", "ABCD", 1),
    ("wago879", "power", "holding:0x5012", "float32", "ABCD", 1),
    ("sma", "power", "holding:30775", "int32", "ABCD", 1),
    ("sma", "frequency", "holding:30803", "uint32", "ABCD", 0.01),
    ("sma", "dc_current", "holding:30769", "int32", "ABCD", 0.001),
    ("sma", "dc_voltage", "holding:30771", "int32", "ABCD", 0.01),
    ("sma", "temperature", "holding:30953", "int32", "ABCD", 0.1),
    ("sma", "energy_total", "holding:30513", "uint64", "ABCDEFGH", 1),
    ("sun2000", "active_power", "holding:32080", "int32", "ABCD", 0.001),
    ("sun2000", "energy_total", "holding:32106", "uint32", "ABCD", 0.01),
    ("sun2000", "energy_day", "holding:32114", "uint32", "ABCD", 0.01),
    ("vlt_fc", "maximum_reference", "403030", "int32", "ABCD", 0.001),
    ("vlt_fc", "running", "000044", "bit", "", 1),
    # MODBUS Register Mapping: %IW0 from 0x0000, %QW0 read from 0x0200; bits alike.
    ("wago750", "analog_input_1", "holding:0x0001", "int16", "AB", 1),
    ("wago750", "analog_output_0", "holding:0x0200", "int16", "AB", 1),
    ("wago750", "input_7", "discrete:7", "bit", "", 1),
    ("wago750", "output_0", "coil:0x0200", "bit", "", 1),
    ("wago750", "digital_input_bits", "holding:0x1025", "uint16", "AB", 1),
    ("wago750", "item", "holding:0x2012", "uint16", "AB", 1),
    # First and last of what a base module has, by the numbers of the table, counted from 1.
    ("logo8", "i1", "100001", "bit", "", 1),
    ("logo8", "i8", "100008", "bit", "", 1),
    ("logo8", "q1", "008193", "bit", "", 1),
    ("logo8", "m1", "008257", "bit", "", 1),
    ("logo8", "ai4", "300004", "int16", "AB", 1),
    ("logo8", "vw0", "400001", "int16", "AB", 1),
    ("logo8", "vw14", "400008", "int16", "AB", 1),
    ("logo8", "aq1", "400513", "int16", "AB", 1),
    ("logo8", "am1", "400529", "int16", "AB", 1),
]


@pytest.mark.parametrize(("profile", "name", "register", "type", "order", "scale"), FACTS)
def test_a_point_stands_where_its_manual_says(
    profile: str, name: str, register: str, type: str, order: str, scale: float
) -> None:
    points = {point.name: point for point in load_profile(f"device:{profile}", unit=1).described()}
    place, point = parse_address(register), points[name]
    assert (point.table, point.start, point.type) == (place.table, place.offset, type)
    assert point.order.startswith(order)
    assert point.conversion.scale == scale


WITHOUT_EXAMPLE = {
    *("abb_b23", "dtsu666", "em24", "em340", "iem3155", "logo8"),
    *("pac2200", "sdm120", "sma", "sun2000", "umg96rm", "wago879"),
}
"""Profiles whose manual gives no bytes of a value, as far as found."""


def test_each_profile_of_a_real_device_has_facts_of_its_manual_and_its_bytes_where_there_are_any() -> None:
    """Another profile brings rows of `FACTS`, and an example, or its name in `WITHOUT_EXAMPLE`."""
    assert {profile for profile, *_ in FACTS} == set(REAL)
    assert {profile for profile, *_ in EXAMPLES} | {"wago750"} == set(REAL) - WITHOUT_EXAMPLE


MAPS = {
    # Every parameter of the table of input registers of the Modbus protocol V1.8, as numbers of the 3X list.
    "sdm630": (
        *range(30001, 30044, 2),
        *(30047, 30049, 30053, 30057, 30061, 30063, 30067),
        *range(30071, 30088, 2),
        *range(30101, 30108, 2),
        *range(30201, 30208, 2),
        30225,
        *range(30235, 30246, 2),
        *(30249, 30251),
        *range(30259, 30270, 2),
        *range(30335, 30382, 2),
    ),
    # As owners of the meter list them beside their programs; of its first fourteen, mbmd and SDM_Energy_Meter too.
    "sdm120": (
        *range(30001, 30038, 6),
        *range(30071, 30080, 2),
        *range(30085, 30096, 2),
        *(30259, 30265, 30343, 30345),
    ),
}


@pytest.mark.parametrize("profile", MAPS)
def test_a_meter_has_each_register_of_its_manual_and_no_other(profile: str) -> None:
    points = load_profile(f"device:{profile}", unit=1).described()
    assert {(each.table, each.start) for each in points} == {
        (place.table, place.offset) for place in map(parse_address, map(str, MAPS[profile]))
    }
    assert {(each.type, each.order[:4], each.conversion.scale) for each in points} == {("float32", "ABCD", 1)}


EXAMPLES = [
    # SDM630 protocol document: request 01 04 00 00 00 02 71 CB, reply 01 04 04 43 66 33 34 1B 38: 230.2 V.
    ("sdm630", "voltage_l1", "04 0000 0002", "04 04 4366 3334", 230.2),
    # VLT design guides, "Read Holding Registers": 3-03 Maximum Reference, 0016E360 = 1 500 000 = 1500 RPM.
    ("vlt_fc", "maximum_reference", "03 0BD5 0002", "03 04 0016 E360", 1500.0),
    # The same, "Preset Multiple Registers": 1-24 = 738 (7.38 A), registers 04D7 and after, 0000 02E2.
    ("vlt_fc", "motor_current_setting", "03 04D7 0002", "03 04 0000 02E2", 7.38),
]


@pytest.mark.parametrize(("profile", "name", "request_pdu", "reply_pdu", "value"), EXAMPLES)
def test_the_bytes_of_a_manual_s_example_travel_and_mean_its_value(
    profile: str, name: str, request_pdu: str, reply_pdu: str, value: float
) -> None:
    request, reply = bytes.fromhex(request_pdu), bytes.fromhex(reply_pdu)
    points = {point.name: point for point in load_profile(f"device:{profile}", unit=1).described()}
    meant = decode_point(points[name], reply[2:]).value
    assert meant == pytest.approx(value, rel=1e-6)
    with played(profile) as (simulation, url):
        simulation.point(f"7/{name}").put(meant)
        host, port = url.removeprefix("tcp://").rsplit(":", 1)
        with socket.create_connection((host, int(port)), timeout=60) as wire:
            wire.sendall(bytes.fromhex("0001 0000 0006 07") + request)  # MBAP: transaction, protocol, length, unit
            received = b""
            while len(received) < 7 + len(reply):
                received += wire.recv(256)
    assert received[7:] == reply


def test_the_status_word_of_a_drive_is_that_of_its_manual_s_example() -> None:
    """FC 360 design guide, "Read Coils": 01 01 00 20 00 10 is answered by 07 06, STW = 0607 hex."""
    points = {point.name: point for point in load_profile("device:vlt_fc", unit=1).described()}
    status = {point.start - 32: name for name, point in points.items() if point.start in range(32, 48)}
    on = {name for bit, name in status.items() if 0x0607 >> bit & 1}
    assert on == {"control_ready", "drive_ready", "not_coasted", "auto_mode", "in_frequency_range"}
    assert status.keys() == set(range(16))
    with played("vlt_fc") as (_, url), busway.connect(url, timeout=5) as link:
        bits = link.unit(7).read_coils(32, count=16)
    assert sum(on << place for place, on in enumerate(bits)) == 0x0607


def test_a_coupler_answers_the_examples_of_its_manual() -> None:
    """WAGO 750: functions 02 and 03 from 0, eight inputs as 12 hex, and two registers; 06 to the second output."""
    with played("wago750") as (simulation, url):
        for place in range(8):
            simulation.point(f"7/input_{place}").put(bool(0x12 >> place & 1))
        simulation.point("7/analog_input_0").put(0x1234)
        simulation.point("7/analog_input_1").put(0x2345)
        asked = {
            "02 0000 0008": "02 01 12",
            "03 0000 0002": "03 04 1234 2345",
            "06 0201 1234": "06 0201 1234",  # "the second output register"; the manual writes it as 0001, read at 0201
            "03 0201 0001": "03 02 1234",
        }
        host, port = url.removeprefix("tcp://").rsplit(":", 1)
        with socket.create_connection((host, int(port)), timeout=60) as wire:
            for request, reply in asked.items():
                pdu = bytes.fromhex(request)
                wire.sendall(bytes.fromhex("0000 0000 0006 07") + pdu)  # MBAP: transaction, protocol, length, unit
                received = b""
                while len(received) < 7 + len(bytes.fromhex(reply)):
                    received += wire.recv(256)
                assert received[7:] == bytes.fromhex(reply), request


def test_a_coupler_has_the_constants_of_its_manual_for_testing_the_order_of_bytes() -> None:
    with played("wago750") as (_, url), busway.connect(url, timeout=60) as link:
        constants = link.unit(7).read_holding_registers(0x2000, count=9)
        assert list(constants) == [0x0000, 0xFFFF, 0x1234, 0xAAAA, 0x5555, 0x7FFF, 0x8000, 0x3FFF, 0x4000]
        assert list(link.unit(7).read_holding_registers(0x2011, count=2)) == [0x02EE, 0x0155], "750, 341"
        assert list(link.unit(7).read_holding_registers(0x1022, count=4)) == [32, 32, 8, 8]
        with pytest.raises(busway.ModbusError):
            link.unit(7).read_holding_registers(0x0100, count=1)  # "Illegal data address"


def test_a_logic_module_takes_writes_where_programs_of_owners_write() -> None:
    with played("logo8") as (simulation, url), busway.connect(url, timeout=60) as link:
        link.unit(7).write_single_coil(8192, True)  # Q1
        link.unit(7).write_single_coil(8255 + 3, True)  # M3
        link.unit(7).write_single_register(527 + 2, 321)  # AM2
        found = {name: simulation.point(f"7/{name}").value for name in ("q1", "q2", "m2", "m3", "am1", "am2")}
    assert found == {"q1": True, "q2": False, "m2": False, "m3": True, "am1": 0, "am2": 321}


def test_what_a_device_says_of_values_that_it_has_not_is_no_value() -> None:
    abb = {point.name: point for point in load_profile("device:abb_b23", unit=1).described()}
    assert decode_point(abb["voltage_l3"], b"\xff" * 4).value is None
    assert decode_point(abb["power"], b"\x7f\xff\xff\xff").value is None
    sma = {point.name: point for point in load_profile("device:sma", unit=1).described()}
    assert decode_point(sma["power"], bytes.fromhex("80000000")).value is None
    assert decode_point(sma["health"], bytes.fromhex("00FFFFFD")).value is None
    assert decode_point(sma["energy_day"], b"\xff" * 8).value is None
    assert sma["health"].label(decode_point(sma["health"], bytes.fromhex("00000133")).value) == "ok"
    sun2000 = {point.name: point for point in load_profile("device:sun2000", unit=1).described()}
    assert decode_point(sun2000["active_power"], b"\x7f\xff\xff\xff").value is None
    assert decode_point(sun2000["temperature"], b"\x7f\xff").value is None
    assert decode_point(sun2000["energy_total"], b"\xff" * 4).value is None
    assert decode_point(sun2000["frequency"], b"\xff\xff").value is None


def test_a_profile_takes_parameters_and_refuses_others(tmp_path: object) -> None:
    section = load_profile("device:meter", unit=3, parameters={"voltage": 120.0})
    assert section.unit == [3]
    with pytest.raises(ConfigError, match="no such parameter in it; there are voltage"):
        load_profile("device:meter", unit=3, parameters={"volts": 120.0})
    with pytest.raises(ConfigError, match="there is no such device, but meter"):
        load_profile("device:toaster", unit=3)
