"""Descriptions of other programs → points: what each key becomes, and that nothing is dropped in silence."""

import json
from pathlib import Path
from typing import Any

import pytest

from busway.apps.importers.formats import import_file
from busway.apps.importers.home_assistant import read_home_assistant
from busway.apps.importers.imported import ImportedDevice
from busway.apps.importers.modpoll import read_modpoll
from busway.apps.importers.plain_yaml import LONGEST, parse_yaml
from busway.apps.importers.sunspec import read_sunspec
from busway.apps.importers.telegraf import read_telegraf
from busway.config.files.device import parse_device_file
from busway.errors import ConfigError
from busway.points import Point
from busway.points.decoder import decode_point

TELEGRAF = """
[agent]
interval = "10s"

[[inputs.modbus]]
name = "pump"
slave_id = 3
controller = "tcp://10.0.0.7:502"
busy_retries = 2
holding_registers = [
  { name = "level", byte_order = "CDAB", data_type = "FLOAT32-IEEE", scale = 1.0, address = [0, 1] },
  { name = "temp", byte_order = "AB", data_type = "FIXED", scale = 0.1, address = [8] },
  { name = "big", byte_order = "ABCD", data_type = "UFIXED", scale = 0.01, address = [10, 11] },
  { name = "odd", byte_order = "AB", data_type = "FLOAT31", address = [20] },
]
coils = [{ name = "run", address = [4] }]

  [[inputs.modbus.request]]
  slave_id = 4
  byte_order = "DCBA"
  register = "input"
  optimization = "shrink"
  fields = [
    { address = 1, name = "power", type = "INT32", scale = 0.5, output = "FLOAT64" },
    { address = 3, name = "low", type = "INT8L" },
    { address = 4, name = "gap", type = "INT16", omit = true },
    { address = 5, name = "flag", type = "BIT", bit = 3 },
    { address = 6, name = "text", type = "STRING", length = 4 },
    { address = 10, name = "flow", type = "FLOAT32", scale = 0.001 },
  ]

  [[inputs.modbus.metric]]
  slave_id = 5
  byte_order = "CDAB"
  measurement = "boiler"
  fields = [
    { register = "coil", address = 0, name = "door" },
    { address = 1, name = "heat", type = "FLOAT32" },
    { register = "input", address = 3, name = "gas", type = "UINT64" },
  ]

[[inputs.modbus]]
name = "old"
slave_id = 6
holding_registers = [{ name = "level", byte_order = "ABCD", data_type = "FLOAT32", scale = 0.1, address = [0, 1] }]
"""

HOME_ASSISTANT = """
# configuration.yaml
homeassistant:
  name: Home
modbus:
  - name: hub1   # the gateway
    type: tcp
    host: 10.0.0.7
    port: 502
    message_wait_milliseconds: 30
    sensors:
      - name: "Outside # north"
        unit_of_measurement: °C
        slave: 2
        address: 100
        input_type: input
        data_type: int16
        scale: 0.1
        offset: -4
        precision: 1
        nan_value: 0x8000
        state_class: measurement
      - name: Energy
        address: 0x10
        data_type: float32
        swap: word
        min_value: 0
      - name: Row
        address: 30
        data_type: uint32
        virtual_count: 2
      - name: Both
        address: 40
        data_type: custom
        count: 4
        structure: ">hHl"
    binary_sensors:
    - name: Door
      address: 7
      input_type: discrete_input
    - name: Bits
      address: 50
      input_type: holding
      slave_count: 17
    switches:
      - name: Fan
        address: 13
        write_type: holding
        command_on: 255
        command_off: 0
        verify:
          input_type: input
          address: 14
          state_on: 255
    climates:
      - name: Room
        address: 1
"""

BILLION_LAUGHS = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9) if n else 1}]\n" for n in range(10))

MODPOLL = """device,meter,5,,
poll,holding_register,100,10,BE_LE
ref,power,100,int32,r,W,0.1
ref,setpoint,102,float32,rw,°C
ref,name,104,string6,r
ref,status,107,bool16,r
ref,odd,108,int24,r
poll,coil,0,8,BE_BE
ref,relay,3,bool,rw
"""

MODEL = {
    "id": 64001,
    "group": {
        "name": "plant",
        "label": "Plant",
        "points": [
            {"name": "ID", "type": "uint16", "size": 1},
            {"name": "L", "type": "uint16", "size": 1},
            {"name": "Mn", "type": "string", "size": 4, "label": "Maker"},
            {"name": "W", "type": "int16", "size": 1, "sf": "W_SF", "units": "W"},
            {"name": "W_SF", "type": "sunssf", "size": 1},
            {"name": "Tmp", "type": "int16", "size": 1, "sf": -1, "units": "C"},
            {"name": "St", "type": "enum16", "size": 1, "symbols": [{"name": "OFF", "value": 1}]},
            {"name": "Evt", "type": "bitfield32", "size": 2, "symbols": [{"name": "HOT", "value": 5}], "access": "RW"},
            {"name": "WH", "type": "acc32", "size": 2},
            {"name": "Pad", "type": "pad", "size": 1},
            {"name": "Odd", "type": "uint24", "size": 1},
        ],
        "groups": [
            {
                "name": "module",
                "count": 0,
                "points": [
                    {"name": "V", "type": "uint16", "size": 1, "sf": "V_SF"},
                    {"name": "V_SF", "type": "sunssf", "size": 1},
                    {"name": "P", "type": "int16", "size": 1, "sf": "W_SF"},
                ],
            }
        ],
    },
}


def points_of(found: ImportedDevice) -> dict[tuple[int, str], Point]:
    """The points of the device file that was made, by unit and name: read back from its text."""
    file = parse_device_file(found.text("source"), "made.toml")
    return {(section.unit[0], point.name): point for section in file.unit for point in section.described()}


def said(found: ImportedDevice) -> list[str]:
    return [str(each) for each in found.omissions]


def test_the_three_styles_of_telegraf_become_points() -> None:
    found = read_telegraf(TELEGRAF, "telegraf.conf")
    points = points_of(found)
    assert {(unit, name): (str(point.address), point.type, point.order) for (unit, name), point in points.items()} == {
        (3, "run"): ("0x5", "bit", ""),
        (3, "level"): ("4x1", "float32", "CDAB"),
        (3, "temp"): ("4x9", "int16", "AB"),
        (3, "big"): ("4x11", "uint32", "ABCD"),
        (4, "power"): ("3x2", "int32", "DCBA"),
        (4, "low"): ("3x4", "int8:low", "BA"),
        (4, "flag"): ("3x6.3", "bit", ""),
        (4, "text"): ("3x7", "string:8", "BA"),
        (4, "flow"): ("3x11", "float32", "DCBA"),
        (5, "door"): ("0x1", "bit", ""),
        (5, "heat"): ("4x2", "float32", "CDAB"),
        (5, "gas"): ("3x4", "uint64", "GHEFCDAB"),
        (6, "level"): ("4x1", "uint32", "ABCD"),  # in this style FLOAT32 is a whole number with a scale
    }
    assert points[3, "big"].conversion.scale == 0.01
    report = said(found)
    assert any("busy_retries" in each and each.startswith("line 9") for each in report)
    assert any("odd: has a type that there is not: 'FLOAT31'" in each for each in report)
    assert any(each.startswith("line 26: gap") for each in report)
    assert any("power.output" in each for each in report)
    assert any("optimization" in each for each in report)
    assert not any("agent" in each for each in report)


SHARED_UNIT = """
[[inputs.modbus]]
name = "east"
controller = "tcp://10.0.0.7:502"
coils = [{ name = "run", address = [4] }]
[[inputs.modbus]]
name = "west"
controller = "tcp://10.0.0.8:502"
coils = [{ name = "stop", address = [5] }]
[[inputs.modbus]]
controller = "tcp://10.0.0.7:502"
interval = "60s"
coils = [{ name = "door", address = [6] }]
"""


def test_one_unit_number_at_two_controllers_of_telegraf_is_two_devices() -> None:
    found = read_telegraf(SHARED_UNIT, "telegraf.conf")
    assert sorted(points_of(found)) == [(1, "door"), (1, "run")]
    (stop, interval) = said(found)
    assert "stop: unit 1 is another device, at tcp://10.0.0.7:502: convert each from a file of its own" in stop
    assert "line 12: interval" in interval
    assert "# Telegraf's controller of west: tcp://10.0.0.8:502" in found.text("telegraf.conf")


def test_one_unit_number_at_two_hubs_of_home_assistant_is_two_devices() -> None:
    hub = "- name: {}\n  type: tcp\n  host: {}\n  sensors:\n    - {{name: {}, address: 1, slave: 2}}\n"
    text = hub.format("a", "10.0.0.7", "level") + hub.format("b", "10.0.0.8", "flow")
    found = read_home_assistant(text, "modbus.yaml")
    assert sorted(points_of(found)) == [(2, "level")]
    (flow,) = said(found)
    assert "flow: unit 2 is another device, at 10.0.0.7:502" in flow


def test_a_unit_of_home_assistant_in_quotes_is_that_unit_and_one_that_is_no_number_is_reported() -> None:
    sensor = "    - {{name: {}, address: 1, slave: {}}}\n"
    text = (
        "- type: serial\n  port: /dev/ttyUSB0\n  sensors:\n"
        + sensor.format("level", "'3'")
        + sensor.format("flow", "x")
    )
    found = read_home_assistant(text, "modbus.yaml")
    assert sorted(points_of(found)) == [(3, "level")]
    (flow,) = said(found)
    assert "flow: has a value that cannot be read" in flow
    assert "/dev/ttyUSB0" in found.text("modbus.yaml")


@pytest.mark.parametrize(
    ("field", "why"),
    [
        (
            '{ name = "x", address = [6, 8], data_type = "INT32" }',
            "has addresses that do not follow each other: [6, 8]",
        ),
        (
            '{ name = "x", address = [5, 4], data_type = "INT32" }',
            "has addresses that do not follow each other: [5, 4]",
        ),
        ('{ name = "x", address = [5], data_type = "INT32" }', "is of 2 registers as INT32: [5]"),
    ],
)
def test_registers_of_telegraf_that_are_not_those_of_the_type_are_reported_and_not_guessed(
    field: str, why: str
) -> None:
    kept = '{ name = "y", address = [1], data_type = "INT16" }'
    found = read_telegraf(f"[[inputs.modbus]]\nholding_registers = [\n{kept},\n{field},\n]\n", "telegraf.conf")
    assert sorted(points_of(found)) == [(1, "y")]
    assert [line.partition(": x: ")[2].strip() for line in said(found)] == [why]


def test_a_field_of_telegraf_in_a_table_that_there_is_not_is_reported_and_no_holding_register() -> None:
    fields = '{ register = "inputs", address = 0, name = "x" }, { register = "input", address = 1, name = "y" }'
    found = read_telegraf(f"[[inputs.modbus]]\n[[inputs.modbus.metric]]\nfields = [{fields}]\n", "telegraf.conf")
    assert sorted(points_of(found)) == [(1, "y")]
    (line,) = said(found)
    assert "x: has no address or register that is known" in line


def test_home_assistant_s_sensors_and_switches_become_points() -> None:
    found = read_home_assistant(HOME_ASSISTANT, "configuration.yaml")
    points = points_of(found)
    outside = points[2, "Outside # north"]
    assert (str(outside.address), outside.type, outside.unit_of_measure) == ("3x101", "int16", "°C")
    assert decode_point(outside, (274).to_bytes(2, "big")).value == 23.4
    assert decode_point(outside, b"\x80\x00").value is None
    assert outside.meta == {"state_class": "measurement", "precision": 1}
    assert (str(points[1, "Energy"].address), points[1, "Energy"].order) == ("4x17", "CDAB")
    assert [str(points[1, name].address) for name in ("Row", "Row_1", "Row_2")] == ["4x31", "4x33", "4x35"]
    assert decode_point(points[1, "Both"], bytes.fromhex("FFFF 0001 FFFFFFFE")).value == (-1, 1, -2)
    assert str(points[1, "Door"].address) == "1x8"
    # Home Assistant reads 18 registers, and takes the lowest bit of each (`result[index] & 1` of its SlaveSensor).
    assert [str(points[1, name].address) for name in ("Bits", "Bits_1", "Bits_17")] == ["4x51.0", "4x52.0", "4x68.0"]
    fan = points[1, "Fan"]
    assert fan.writing is not None
    assert (str(fan.writing.verify), fan.encode(True), fan.encode(False)) == ("input:14", b"\x00\xff", b"\x00\x00")
    report = said(found)
    assert "line 3: homeassistant: is not Modbus" in report
    assert "line 27: Energy.min_value: is Home Assistant's own" in report
    assert any("climates: is more than a point" in each for each in report)
    assert any("verify.state_on" in each for each in report)
    assert any("message_wait_milliseconds" in each for each in report)


@pytest.mark.parametrize("kind", ["data_type: string\n        count: 8", "data_type: custom\n        structure: '>16'"])
def test_home_assistant_s_texts_and_structures_are_not_repeated_and_that_is_reported(kind: str) -> None:
    text = f"sensors:\n      - name: Maker\n        address: 10\n        {kind}\n        virtual_count: 1\n"
    found = read_home_assistant(text, "x")
    assert [point.keys["name"] for point in found.points[1]] == ["Maker"]
    assert any("Maker.virtual_count: is not carried over for this type" in each for each in said(found))


@pytest.mark.parametrize("key", ["virtual_count", "slave_count"])
@pytest.mark.parametrize(
    ("kind", "count", "most"),
    [
        ("sensors", 70_000, 124),
        ("sensors", 125, 124),
        ("sensors", -1, 124),
        ("sensors", 62, 61),
        ("binary_sensors", 70_000, 1999),
        ("binary_sensors", 2000, 1999),
        ("binary_sensors", -1, 1999),
    ],
)
def test_a_row_of_home_assistant_that_no_request_can_read_is_left_out_and_its_key_is_named(
    key: str, kind: str, count: int, most: int
) -> None:
    row = f"name: Row\n    data_type: {'uint32' if most == 61 else 'uint16'}\n    address: 10\n    {key}"
    assert len(read_home_assistant(f"{kind}:\n  - {row}: {most}\n", "x").points[1]) == most + 1
    found = read_home_assistant(f"{kind}:\n  - {row}: {count}\n", "x")
    assert found.points == {}
    assert f"line 2: Row: has a value that cannot be read: {key} is 0…{most}, not {count}" in said(found)


def test_modpoll_s_references_become_points() -> None:
    found = read_modpoll(MODPOLL, "meter.csv")
    points = points_of(found)
    power = points[5, "power"]
    assert (str(power.address), power.type, power.order, power.conversion.scale) == ("4x101", "int32", "CDAB", 0.1)
    assert power.writing is None
    assert points[5, "setpoint"].writing is not None
    assert points[5, "name"].type == "string:6"
    assert [str(points[5, f"status.{bit}"].address) for bit in (0, 15)] == ["4x108.0", "4x108.15"]
    assert str(points[5, "relay"].address) == "0x4"
    assert any(each.startswith("line 7: odd") for each in said(found))


def test_coils_of_modpoll_are_addressed_by_bytes_from_the_first_of_their_poll() -> None:
    """As in modpoll's own example, whose comment calls the second one the coils 9 to 12."""
    lines = [
        "device,modsim01,1", "poll,coil,100,12,BE_BE", "ref,low,100,bool8,rw", "ref,high,101,bool8,rw",
        "ref,none,102,bool8,rw", "ref,own,103,bool,rw", "poll,discrete_input,0,16,BE_BE", "ref,all,0,bool16,r",
    ]  # fmt: skip
    found = read_modpoll("\n".join(lines), "modsim.csv")
    points = {name: str(point.address) for (_, name), point in points_of(found).items()}
    assert [points[f"low.{bit}"] for bit in (0, 7)] == ["0x101", "0x108"]
    assert [points[f"high.{bit}"] for bit in (0, 3)] == ["0x109", "0x112"]
    assert "high.4" not in points
    assert [points[f"all.{bit}"] for bit in (0, 15)] == ["1x1", "1x16"]
    assert points["own"] == "0x104"
    assert [line for line in said(found) if ": poll," not in line] == [
        "line 5: none: is outside of what its poll reads",
        "line 6: own.bool: eight bits in modpoll; taken as coil:103 alone",
    ]


def test_bits_and_texts_of_modpoll_s_registers_are_those_that_it_reads() -> None:
    lines = [
        "device,a,1", "poll,holding_register,0x10,10,LE_LE", "ref,byte,16,bool8,r", "ref,alarm,0x11:15,bool,r",
        "ref,text,18,string4,r", "ref,number,20,uint32,r", "ref,odd,21:3,uint16,r",
        "poll,holding_register,0,10,BE_BE", "ref,bit,1:3,bool,r", "ref,flag,2,bool,r",
    ]  # fmt: skip
    found = read_modpoll("\n".join(lines), "a.csv")
    points = {name: point for (_, name), point in points_of(found).items()}
    assert {name for name in points if name.startswith("byte")} == {f"byte.{bit}" for bit in range(8, 16)}
    assert str(points["byte.8"].address) == "4x17.8"
    assert str(points["alarm"].address) == "4x18.7"  # bytes exchanged
    assert (points["text"].order, points["number"].order) == ("AB", "DCBA")
    assert [str(points[name].address) for name in ("bit", "flag")] == ["4x2.3", "4x3.0"]
    told = [line for line in said(found) if ": poll," not in line]
    assert [line.partition(":")[0] for line in told] == ["line 7", "line 10"]
    assert "flag.bool: eight bits in modpoll; taken as holding:2.0 alone" in told[1]


def test_a_reference_of_modpoll_below_an_invalid_device_or_poll_is_left_out_and_not_put_elsewhere() -> None:
    lines = [
        "device,a,1", "poll,holding_register,0,10,BE_BE", "ref,x,0,uint16,r",
        "device,b,two", "ref,y,1,uint16,r", "poll,holding_register,0,10,BE_BE", "ref,z,2,uint16,r",
        "device,c,3", "ref,u,3,uint16,r", "poll,input_register,0,10,BE_BE", "ref,v,4,uint16,r",
        "poll,coil", "ref,w,5,uint16,r",
    ]  # fmt: skip
    found = read_modpoll("\n".join(lines), "plant.csv")
    assert {place: str(point.address) for place, point in points_of(found).items()} == {
        (1, "x"): "4x1",
        (3, "v"): "3x5",
    }
    left_out = [each.what for each in found.omissions if "has no unit, no table or no address" in each.why]
    assert left_out == ["y", "z", "u", "w"]
    assert "line 4: device,b,two: is no line of modpoll that is known" in said(found)
    assert "line 12: poll,coil: is no line of modpoll that is known" in said(found)


def test_a_sunspec_model_becomes_points_and_groups() -> None:
    found = read_sunspec(json.dumps(MODEL), "model.json", first=40070)
    points = {name: point for (_, name), point in points_of(found).items()}
    assert [points[name].start for name in ("ID", "L", "Mn", "W", "W_SF", "Tmp", "St", "Evt", "WH")] == [
        40070, 40071, 40072, 40076, 40077, 40078, 40079, 40080, 40082,
    ]  # fmt: skip
    assert decode_point(points["Tmp"], (215).to_bytes(2, "big")).value == 21.5
    assert decode_point(points["W"], b"\x80\x00").value is None
    assert points["St"].label(1) == "OFF"
    assert points["Evt"].label(32) == "HOT"
    assert (points["Evt"].writing is None, points["W"].writing is None) == (False, True)
    assert points["WH"].rollover == 2.0**32
    third = points["module.3.V"]
    assert third.start == points["module.1.V"].start + 6
    assert third.exists == (("module_count", 3),)
    assert (third.conversion.scale_from, points["module.3.P"].conversion.scale_from) == ("module.3.V_SF", "W_SF")
    assert any("Odd" in each and "uint24" in each for each in said(found))


def test_the_count_by_length_is_that_of_the_registers_behind_the_head() -> None:
    points = {name: point for (_, name), point in points_of(read_sunspec(json.dumps(MODEL), "m.json")).items()}
    behind_head = points["module.1.V"].start - points["L"].start - 1
    assert points["module_count"].formula == f"(L - {behind_head}) // 3"


def test_a_group_with_something_behind_it_needs_its_count() -> None:
    model = json.loads(json.dumps(MODEL))
    model["group"]["groups"].append({"name": "tail", "points": [{"name": "X", "type": "uint16", "size": 1}]})
    with pytest.raises(ConfigError, match=r"group module has as many places as L says.*--count module=N"):
        read_sunspec(json.dumps(model), "model.json")
    points = {name: p for (_, name), p in points_of(read_sunspec(json.dumps(model), "m", counts={"module": 2})).items()}
    assert points["tail.X"].start == points["module.2.P"].start + 1


@pytest.mark.parametrize("count", [0, -1])
def test_a_group_that_would_be_there_less_than_once_is_refused(count: int) -> None:
    with pytest.raises(
        ConfigError, match=f"--count module: a repeated group is there at least once, not {count} times"
    ):
        read_sunspec(json.dumps(MODEL), "model.json", counts={"module": count})


def test_a_repeated_group_without_registers_is_refused_with_its_name_and_file() -> None:
    model = json.loads(json.dumps(MODEL))
    model["group"]["groups"] = [{"name": "module", "count": 0, "points": []}]
    with pytest.raises(
        ConfigError, match=r"model\.json: group module is there as often as L says, and has no registers"
    ):
        read_sunspec(json.dumps(model), "model.json")


@pytest.mark.parametrize("exponent", [500, 11, -11])
def test_a_scale_factor_that_sunspec_does_not_have_is_refused_with_its_point(exponent: int) -> None:
    model = json.loads(json.dumps(MODEL))
    model["group"]["points"].append({"name": "W", "type": "int16", "size": 1, "sf": exponent})
    with pytest.raises(ConfigError, match=rf"model\.json: .*W\.sf is -10…10, not {exponent}"):
        read_sunspec(json.dumps(model), "model.json")


def test_a_point_whose_scale_factor_is_missing_is_left_out_and_reported_by_name() -> None:
    model = json.loads(json.dumps(MODEL))
    model["group"]["points"][4]["name"] = "Other"  # it was W_SF
    found = read_sunspec(json.dumps(model), "model.json")
    assert not {"W", "module.1.P"} & {name for _, name in points_of(found)}
    assert {(1, "WH"), (1, "module.1.V")} <= points_of(found).keys()
    assert [each for each in said(found) if "'W_SF'" in each] == [
        "W: W: has a scale factor (sf) that the model does not have: 'W_SF'",
        "P: P: has a scale factor (sf) that the model does not have: 'W_SF'",
    ]


def test_asking_again_for_the_sections_reports_what_is_left_out_once() -> None:
    found = ImportedDevice()
    found.omit("line 1", "x", "is not Modbus")
    found.add(1, {"name": "good", "address": "4x1"}, "line 2")
    found.add(1, {"name": "bad", "address": "nowhere"}, "line 3")
    found.sections()
    first = said(found)
    found.sections()
    found.text("x")
    assert said(found) == first
    assert len(first) == 2


def test_points_on_top_of_each_other_are_kept_and_doubled_names_numbered() -> None:
    found = ImportedDevice()
    found.add(1, {"name": "a", "address": "4x1", "type": "uint32"})
    found.add(1, {"name": "a", "address": "4x2"})
    found.add(1, {"name": "b", "address": "4x99999"}, "line 9")
    points = points_of(found)
    assert {name for _, name in points} == {"a", "a_2"}
    assert said(found)[0].startswith("line 9: b: address 4x99999")


def test_nothing_that_could_be_carried_over_is_refused() -> None:
    found = ImportedDevice()
    found.add(1, {"name": "a", "address": "9x1"}, "line 3")
    with pytest.raises(ConfigError, match="no point in it that could be carried over: line 3: a"):
        found.text("x")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("modbus: !include hubs.yaml", "x:1: !include is not read here"),
        ("a: 1\nb: !!python/name:os.system x", "x:2: python/name:os.system is not read here"),
        ("a: &x {b: 1}\nc:\n  <<: *x", "x:3: a key is a text; write out what << merges"),
        ("a: 1\n? [1]\n: 2", "x:2: a key is a text"),
        ("a: 1\n   b: 2", "x:2: mapping values are not allowed here"),
        ("a: 1\na: 2", "x:2: a is there twice"),
        ("\ta: 1", "x:1: found character '\\t' that cannot start any token"),
        ("a: 'open", "x:1: found unexpected end of stream"),
        ("a: *b", "x:1: found undefined alias 'b'"),
        ("a: 1\n--- \nb: 2", "x:2: but found another document"),
        ("- " * 1000 + "x", "x:1: is nested too deeply"),
        ("a: \x00", "x:1: is no YAML"),
        ("x" * (LONGEST + 1), "x: has 1000001 characters"),
        ("a: 1\nb: !!int foo", "x:2: 'foo' cannot be read as int"),
        ("a: !!int ''", "x:1: '' cannot be read as int"),
        ("a: !!bool x", "x:1: 'x' cannot be read as bool"),
        ("a: !!float x", "x:1: 'x' cannot be read as float"),
        (f"a: {'1:' * 300}1.5", "x:1: '1:1:1"),  # of base 60, beyond what a float holds
        (f"a: 1\nb: {'1:' * 5000}1", "x:2: is a number of 10001 characters, and 1000 are the limit"),
        (BILLION_LAUGHS, "x:1: comes to more than 100000 values"),
    ],
)
def test_yaml_that_is_not_understood_is_refused_with_its_line(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "x")
    assert str(caught.value).startswith(sentence)


def test_plain_yaml_is_read_as_yaml_has_it() -> None:
    text = "a:\n- b: 1\n  c: 'it''s' # no\n-\n  d: on\n  e:\n- &x 0x1F\nf: -1.5e+3\n"
    text += 'g: "x # y"\nh: [1, 2026-03-01]\ni: 7.0\nj: *x\n'
    document = parse_yaml(text, "x")
    assert document.data == {
        "a": [{"b": 1, "c": "it's"}, {"d": True, "e": None}, 31],
        "f": -1500.0,
        "g": "x # y",
        "h": [1, "2026-03-01"],
        "i": 7.0,
        "j": 31,
    }
    assert (document.line(("a", 0, "c")), document.line(("a", 1, "d")), document.line(("g",))) == (3, 5, 9)
    assert parse_yaml("", "x").data is None


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.toml", TELEGRAF, "level"),
        ("a.conf", TELEGRAF, "level"),
        ("a.yml", HOME_ASSISTANT, "Energy"),
        ("a.json", json.dumps(MODEL), "W_SF"),
        ("a.csv", MODPOLL, "setpoint"),
        ("b.csv", "name,address,type\nvolt,3x1,uint16\n", "volt"),
    ],
)
def test_a_file_is_known_by_its_name_and_first_lines(tmp_path: Path, name: str, text: str, expected: str) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert expected in {point for _, point in points_of(import_file(str(path)))}


@pytest.mark.parametrize("text", ["", "{}", "[]", "{", '{"group": 3}', "[" * 100_000, "\x00", "a: b", "ref,,,"])
@pytest.mark.parametrize("format", ["telegraf", "home-assistant", "modpoll", "sunspec", "csv"])
def test_nonsense_is_refused_with_a_sentence_and_never_a_crash(tmp_path: Path, format: str, text: str) -> None:
    path = tmp_path / "x"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError):
        import_file(str(path), format=format).text("x")


REGISTER_MAP = """\
name,address,type,scale,unit,remark by the seller
voltage,3x1,float32,,V,
current,3x3,float32,,A,new
odd,3x5,float31,,,
factor,3x7,int16,x10,,
,3x9,,,,
nowhere,99999,,,,
wide,3x11,,,,,,too,many
again,3x1,uint16,,,
"""


def test_a_register_map_as_manuals_have_it_becomes_points_and_what_cannot_be_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "meter.csv"
    path.write_text(REGISTER_MAP, encoding="utf-8")
    found = import_file(str(path))
    points = points_of(found)
    assert {name: (str(point.address), point.type) for (_, name), point in points.items()} == {
        "voltage": ("3x1", "float32"),
        "current": ("3x3", "float32"),
        "again": ("3x1", "uint16"),
    }
    assert points[1, "voltage"].unit_of_measure == "V"
    report = sorted(said(found))
    assert [each.rpartition(": ")[0] or each for each in report[:1]] == ["line 1: remark by the seller"]
    assert [each.split(": ")[:2] for each in report[1:]] == [
        ["line 4", "odd"],
        ["line 5", "factor.scale"],
        ["line 6", "name"],
        ["line 7", "nowhere.address"],
        ["line 8", "a row"],
    ]


@pytest.mark.parametrize("header", ["name,type", "name,address,name", "voltage"])
def test_a_register_map_without_its_columns_is_refused(tmp_path: Path, header: str) -> None:
    path = tmp_path / "meter.csv"
    path.write_text(f"{header}\nvoltage,3x1,uint16\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"meter\.csv:1: "):
        import_file(str(path))


def test_a_report_is_in_the_order_of_the_file() -> None:
    """It was in that of a set, which differs from run to run."""
    keys = ["delay", "timeout", "retries", "close_comm_on_error", "message_wait_milliseconds", "climates"]
    text = "modbus:\n  - name: hub\n    sensors:\n      - name: a\n        address: 1\n"
    text += "".join(f"    {key}: 1\n" for key in keys)
    assert [each.what for each in read_home_assistant(text, "x").omissions] == keys


def test_the_report_stands_in_the_file_too() -> None:
    text = read_telegraf(TELEGRAF, "telegraf.conf").text("telegraf.conf")
    assert text.startswith("# Converted from telegraf.conf by busway points convert.")
    assert "# Not carried over:" in text
    assert "FLOAT31" in text


def test_a_hostile_name_ends_no_comment_and_no_text() -> None:
    found = ImportedDevice()
    keys: dict[str, Any] = {"name": 'x"]\n[[unit]]\nunit = 9\n#', "address": "4x1"}
    found.add(1, keys, "line\n[[unit]]\nunit = 8\n")
    found.omit("line\nunit = 7", "a\nb = 1", "c")
    file = parse_device_file(found.text("s\n[[unit]]"), "x")
    assert [(section.unit, [point.name for point in section.point]) for section in file.unit] == [([1], [keys["name"]])]


WRONG_VALUES = {
    "hub.yaml": """\
modbus:
  - sensors:
      - name: scaled
        address: 1
        scale: tenth
      - name: several
        address: 2
        virtual_count: many
      - name: absent
        address: 3
        nan_value: zz
      - name: good
        address: 5
    switches:
      - name: switch
        address: 1
        command_on: yes please
""",
    "telegraf.toml": """\
[[inputs.modbus]]
holding_registers = [{ name = "scaled", address = [1], scale = "tenth" }, { name = "good", address = [5] }]
[[inputs.modbus]]
slave_id = "first"
coils = [{ name = "unit", address = [1] }]
""",
}


@pytest.mark.parametrize("name", WRONG_VALUES)
def test_a_point_with_a_value_that_cannot_be_read_is_reported_and_the_others_are_kept(
    name: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_text(WRONG_VALUES[name], encoding="utf-8")
    found = import_file(str(file))
    text = found.text(name)
    assert 'name = "good", address = "holding:5"' in text
    reported = {each.what for each in found.omissions if "has a value that cannot be read" in each.why}
    wanted = {"scaled", "several", "absent", "switch"} if name == "hub.yaml" else {"scaled", "unit"}
    assert reported == wanted
    assert all(each.where.startswith("line ") for each in found.omissions)


@pytest.mark.parametrize(
    "points",
    ['[{"name": "ID", "type": "uint16", "size": "x"}]', "[5]", '[{"name": "a", "type": "uint16", "symbols": 7}]'],
)
def test_a_sunspec_model_with_a_value_that_cannot_be_read_is_refused(points: str, tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    file.write_text(f'{{"id": 1, "group": {{"name": "g", "points": {points}}}}}', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"model\.json: is no SunSpec model: it has a value that cannot be read"):
        import_file(str(file))
