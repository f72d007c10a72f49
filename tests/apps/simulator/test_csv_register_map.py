"""Register maps in CSV: every way in which spreadsheets write them, and a place for everything that is wrong."""

from pathlib import Path

import pytest

from busway.apps.simulator.csv_register_map import COLUMNS, parse_register_map, read_register_map
from busway.apps.simulator.device_text import device_text
from busway.apps.simulator.includes import parse_declaration
from busway.config.devices import build_device
from busway.config.files.file_error import FileError
from busway.config.files.simulation import SimulatedUnitSection, SimulationFile
from busway.config.files.toml_source import read_source
from busway.errors import ConfigError


def problems_of(text: str | bytes) -> list[str]:
    with pytest.raises(FileError) as caught:
        parse_register_map(text, "map.csv")
    return str(caught.value).splitlines()


def test_every_column_gives_its_key() -> None:
    (point,) = parse_register_map(
        "name,address,table,type,order,scale,unit,access,min,max,enumeration,description,value\n"
        'speed,4x11,,int32,CDAB,0.1,rpm,rw,-10,10,,"as ordered, at most",2.5\n',
        "map.csv",
    )
    assert point.name == "speed"
    assert str(point.place) == "4x11"
    assert (point.type, point.order, point.scale) == ("int32", "CDAB", 0.1)
    assert (point.unit_of_measure, point.access, point.description) == ("rpm", "read-write", "as ordered, at most")
    assert (point.minimum, point.maximum, point.value) == (-10, 10, 2.5)


def test_the_columns_that_are_documented_are_those_that_are_read() -> None:
    header = ",".join(column.name for column in COLUMNS)
    (point,) = parse_register_map(f"{header}\nlevel,0,holding,,,,,,,,,,\n", "map.csv")
    assert str(point.place) == "4x1"


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_commas_semicolons_and_tabs_separate(delimiter: str) -> None:
    text = "name,address,type,description\nlevel,4x1,float32,\npump,0x1,,runs\n".replace(",", delimiter)
    assert [point.name for point in parse_register_map(text, "map.csv")] == ["level", "pump"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_text_comes_in_the_encodings_of_spreadsheets(encoding: str) -> None:
    (point,) = parse_register_map("name;address;unit\nWärme;3x1;°C\n".encode(encoding), "map.csv")
    assert (point.name, point.unit_of_measure) == ("Wärme", "°C")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_end_as_on_any_system_and_keep_their_numbers(end: str) -> None:
    text = end.join(["# from the manual", "", "name,address", "a,4x1", "", "b,nowhere", ""])
    (problem,) = problems_of(text)
    assert problem.startswith("map.csv:6: address: 'nowhere' is no address")


def test_a_number_may_have_a_decimal_comma_where_commas_do_not_separate() -> None:
    first, second = parse_register_map(
        "name;address;type;scale;value;max\na;3x1;;0,1;-0,5;\nb;3x2;float32;;2,5;7,25\n".replace("-", ""), "map.csv"
    )
    assert (first.scale, first.value) == (0.1, 0.5)
    assert (second.value, second.maximum) == (2.5, 7.25)


def test_names_of_numbers_are_read_and_may_be_the_value() -> None:
    (mode,) = parse_register_map("name,address,enumeration,value\nmode,4x1,0=off | 0x1=on; 2=auto,auto\n", "map.csv")
    assert mode.enumeration == {"off": 0, "on": 1, "auto": 2}
    assert mode.raw(mode.value) == 2


@pytest.mark.parametrize(
    ("table", "address", "place"),
    [
        ("holding", "16", "4x17"),
        ("Holding Registers", "16", "4x17"),
        ("input", "0", "3x1"),
        ("coil", "9", "0x10"),
        ("discrete", "1x3", "1x3"),
        ("holding", "40017", "40017"),
        ("", "%MW16", "%MW16"),
        ("input_register", "3.4", "3x4.4"),
    ],
)
def test_the_table_stands_in_the_address_or_in_a_column_of_its_own(table: str, address: str, place: str) -> None:
    (point,) = parse_register_map(f"name,address,table\na,{address},{table}\n", "map.csv")
    assert str(point.place) == place


@pytest.mark.parametrize("word", ["bool", "bit", "BOOLEAN", ""])
def test_a_bit_may_be_said_to_be_one(word: str) -> None:
    (point,) = parse_register_map(f"name,address,type,value\npump,0x1,{word},on\n", "map.csv")
    assert point.value is True


def test_a_cell_with_line_breaks_counts_its_lines() -> None:
    text = 'name,address,description\na,4x1,"one\ntwo\nthree"\nb,4x2000000,\n'
    (problem,) = problems_of(text)
    assert problem.startswith("map.csv:5: address: ")


def test_columns_marked_as_remarks_are_not_read() -> None:
    (point,) = parse_register_map("name,#,address,# seen\na,1,4x1,yesterday\n", "map.csv")
    assert point.name == "a"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "map.csv:1: there is no line with columns"),
        ("# only remarks\n\n", "map.csv:1: there is no line with columns"),
        ("name,address\n", "map.csv:1: there is no point"),
        ("name,adress\na,4x1\n", "map.csv:1: adress: there is no such column; is it address?"),
        ("name,address,colour\na,4x1,red\n", "map.csv:1: colour: there is no such column; there are name, address,"),
        ("address,type\n4x1,int16\n", "map.csv:1: name: this column is missing"),
        ("name,address,name\na,4x1,b\n", "map.csv:1: name: column 3 is name once more"),
        ("name,address\na,4x1,extra\n", "map.csv:2: 3 cells, but there are 2 columns"),
        ("name,address\na,\n", "map.csv:2: address: is empty"),
        ("name,address\n,4x1\n", "map.csv:2: name: is empty"),
        ("name,address\na,100\n", "map.csv:2: address: address '100' does not say which table"),
        ("name,address,table\na,100,shelf\n", "map.csv:2: table: there is no table 'shelf', but coil"),
        ("name,address,table\na,40001,input\n", "map.csv:2: address: address 40001 means holding register number 1"),
        ("name,address,type\na,4x1,integer\n", "map.csv:2: type: unknown type 'integer'"),
        ("name,address,order\na,4x1,XY\n", "map.csv:2: order: "),
        ("name,address,scale\na,4x1,ten\n", "map.csv:2: scale: must be a number, not 'ten'"),
        ("name,address,scale\na,4x1,0\n", "map.csv:2: scale: must be a number other than 0"),
        ("name,address,access\na,4x1,sometimes\n", "map.csv:2: access: must be read or read-write, not 'sometimes'"),
        ("name,address,access\na,3x1,rw\n", "map.csv:2: access: Modbus cannot write input registers"),
        ("name,address,min,max\na,4x1,5,1\n", "map.csv:2: max: must be at least the minimum, 5"),
        ("name,address,enumeration\na,4x1,off\n", "map.csv:2: enumeration: must be written 0=off | 1=on, not 'off'"),
        ("name,address,enumeration\na,4x1,0=x|1=x\n", "map.csv:2: enumeration: x is 0 already"),
        ("name,address,enumeration\na,4x1,0=x|0=y\n", "map.csv:2: enumeration: 0 is 'x' already"),
        ("name,address,value\na,4x1,70000\n", "map.csv:2: value: "),
        ("name,address,value,max\na,4x1,7,5\n", "map.csv:2: value: must be at most 5"),
        ("name,address,value\na,0x1,7\n", "map.csv:2: value: one bit is true or false, not '7'"),
        ("name,address,type,scale\na,4x1,string:4,0.1\n", "map.csv:2: scale: string:4 is no number"),
        ("name,address\na,4x1\na,4x2\n", "map.csv:3: name: 'a' is there already"),
        ("name,address,type\na,4x1,float32\nb,4x2,\n", "map.csv:3: address: 4x2 is taken by 'a'"),
        ('name,address\na,"4x1\n', "map.csv:2: is no CSV: "),
        ('name,address\na,"4x1"2\n', "map.csv:2: is no CSV: "),
    ],
)
def test_what_is_wrong_is_said_with_file_line_and_column(text: str, said: str) -> None:
    problems = problems_of(text)
    assert problems[0].startswith(said), problems


def test_all_that_is_wrong_is_said_at_once_in_the_order_of_the_lines() -> None:
    problems = problems_of("name,address,scale\na,4x1,x\nb,nowhere,1\nc,4x3,\nd,4x0,y\n")
    assert [problem.split(": ")[:2] for problem in problems] == [
        ["map.csv:2", "scale"],
        ["map.csv:3", "address"],
        ["map.csv:5", "scale"],
        ["map.csv:5", "address"],
    ]


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.csv: cannot be read: no such file"):
        read_register_map(tmp_path / "gone.csv")


@pytest.mark.parametrize(
    "damage", [b"\x00", b"\xff\xfe", b'"', b"\xc3", b",", b";", b"\n", b"\r", b"\t", b"=", b"\xef"]
)
def test_a_damaged_map_is_read_or_refused_with_its_name_and_never_anything_else(damage: bytes) -> None:
    good = b'name,address,type,scale,value,enumeration\na,4x1,int16,0.1,2.5,\nb,4x5,,,x,"0=x|1=y"\n'
    for place in range(len(good) + 1):
        for text in (good[:place] + damage + good[place:], good[:place] + damage + good[place + 1 :]):
            for problem in problems_in(text):
                assert problem.file == "map.csv"
                assert problem.line


def problems_in(text: bytes) -> tuple[ConfigError, ...]:
    try:
        parse_register_map(text, "map.csv")
    except FileError as error:
        return error.problems
    return ()


def test_points_of_a_map_make_a_device_file_that_gives_the_same_registers() -> None:
    points = parse_register_map(
        "name,address,type,order,scale,unit,access,value,enumeration\n"
        "level,3x1,float32,CDAB,,m,,2.5,\n"
        "total,3x3,uint64,,,Wh,,18446744073709551615,\n"
        "label,4x1,string:9:utf-8,,,,ro,Zähler 7,\n"
        "mode,4x10,,,,,,auto,0=off|2=auto\n"
        'quoted "name",4x11,int16,,0.01,,,-3.14,\n'.replace('quoted "name"', '"quoted ""name"""'),
        "map.csv",
    )
    unit = SimulatedUnitSection.model_validate({"unit": 7, "point": points})
    for compact in (False, True):
        text = device_text([unit], listen=["tcp://127.0.0.1:0"], remarks=["made of map.csv"], compact=compact)
        file = read_source(text, "again.toml").checked(SimulationFile)
        assert file.listen == ["tcp://127.0.0.1:0"]
        assert file.unit[0].unit == [7]
        before, after = build_device(unit), build_device(file.unit[0])
        for point in unit.point:
            assert after.read(point.place, point.form) == before.read(point.place, point.form)
        assert file.unit[0].point == unit.point


def test_a_remark_stays_a_remark_whatever_stands_in_it() -> None:
    (point,) = parse_register_map('name,address,description\n"a\n[[unit]]",4x1,"${t} costs $${2}"\n', "map.csv")
    unit = SimulatedUnitSection.model_validate({"unit": 1, "point": [point]})
    text = device_text([unit], remarks=[f"kept: {point.name}", "\n\x00"])
    (again,) = parse_declaration(text, "again.toml").units
    assert again.section.point == [point]
