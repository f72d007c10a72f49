"""Device files: what they declare, and every way in which one can be wrong, with file, line and key."""

import random
import re
from dataclasses import fields
from pathlib import Path

import pytest
from damaged_texts import after_accidents

from busway.codes import Table
from busway.config.devices import build_units
from busway.config.files.device import (
    DeviceFile,
    ServerSection,
    parse_device_file,
)
from busway.config.files.file_error import FileError
from busway.errors import ConfigError
from busway.options.server import ListenerParameters, ServerParameters

GOOD = (Path(__file__).parent / "good.toml").read_text(encoding="utf-8")
REFERENCE = Path(__file__).parents[3] / "docs" / "reference" / "device-file.md"
MUTATIONS = 200

UNIT = "[[unit]]\nunit = 1\n"
POINT = UNIT + '[[unit.point]]\nname = "a"\n'


def problems_of(text: str) -> list[str]:
    """The sentences about a file that cannot be used."""
    with pytest.raises(FileError) as caught:
        parse_device_file(text, "x.toml")
    return str(caught.value).splitlines()


def test_a_good_file_says_what_it_declares() -> None:
    file = parse_device_file(GOOD, "good.toml")
    assert file.listen == ["tcp://127.0.0.1:0", "tcp://[::1]:0"]
    assert file.server.options()["max_transactions"] == 4
    boiler, other = file.unit
    assert (boiler.unit, boiler.name, other.unit) == ([1, 2], "boiler", [7])
    holding = boiler.table(Table.HOLDING_REGISTERS)
    assert holding is not None
    assert (holding.first, holding.size, holding.read_only) == (0, 100, [[10, 5], [20, 1]])
    assert boiler.objects() == {0: b"Acme", 1: b"B-2", 2: b"1.0", 0x80: b"\x01\x02"}
    assert boiler.server_id == b"boiler\xff"
    assert [point.name for point in boiler.points_in(Table.HOLDING_REGISTERS)] == ["temperature", "alarm"]
    pressure = boiler.point[1]
    assert (pressure.raw(1.25), pressure.physical(125)) == (125, 1.25)


def test_a_file_of_one_unit_is_enough() -> None:
    file = parse_device_file(UNIT, "x.toml")
    assert file.listen == ["tcp://127.0.0.1:5020"]
    assert file.server.options() == {}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "x.toml:1: unit: is missing"),
        ("a = \n", "x.toml:1: invalid value (column 5)"),
        ("a = 1\na = 2\n", "x.toml:2: cannot overwrite a value"),
        ('a = "', "x.toml:1: unterminated string (at the end of the file)"),
        ("unit = 3\n", "x.toml:1: unit: must be a list, not 3"),
        ("unit = []\n", "x.toml:1: unit: "),
        ('listen = ["nowhere"]\n' + UNIT, "x.toml:1: listen[0]: 'nowhere' is no endpoint"),
        ("listen = []\n" + UNIT, "x.toml:1: listen: "),
        (UNIT + "[server]\nmax_transactions = 17\n", "x.toml:4: server.max_transactions: must be 1…16, not 17"),
        (UNIT + "[server]\nbacklog = 0\n", "x.toml:4: server.backlog: must be 1…65535, not 0"),
        (UNIT + '[server]\nscope = "all"\n', "x.toml:4: server.scope: must be 'connection' or 'server', not 'all'"),
        (UNIT + "[server]\nkeepalive = 1\n", "x.toml:4: server.keepalive: must be true or false, not 1"),
        (UNIT + "[sever]\n", "x.toml:3: sever: unknown key; is it server?"),
        (UNIT + "[collector]\n", "x.toml:3: collector: unknown key here; this is a collector file"),
        (UNIT + "[[unit]]\nunit = 1\n", "x.toml:4: unit[1].unit: unit 1 is there already: unit[0]"),
        ('[server]\nunit_policy = "any"\n' + UNIT + "[[unit]]\nunit = 2\n", "x.toml:2: server.unit_policy: any needs"),
        ("[[unit]]\n", "x.toml:1: unit[0].unit: is missing"),
        ("[[unit]]\nunit = 256\n", "x.toml:2: unit[0].unit: must be at most 255, not 256"),
        ("[[unit]]\nunit = true\n", "x.toml:2: unit[0].unit: must be a whole number, not True"),
        ("[[unit]]\nunit = [1,\n 1.5]\n", "x.toml:3: unit[0].unit[1]: must be a whole number, not 1.5"),
        (UNIT + "coils = -1\n", "x.toml:3: unit[0].coils.count: must be at least 0, not -1"),
        (UNIT + "coils = 65537\n", "x.toml:3: unit[0].coils.count: must be at most 65536, not 65537"),
        (UNIT + 'coils = "all"\n', "x.toml:3: unit[0].coils: must be a number of items, a list of values, or a table"),
        (UNIT + "coils = [2]\n", "x.toml:3: unit[0].coils[0]: must be true or false, not 2"),
        (UNIT + "holding_registers = [1, 70000]\n", "x.toml:3: unit[0].holding_registers[1]: a register holds"),
        (UNIT + "coils = { first = 65535, count = 2 }\n", "x.toml:3: unit[0].coils: offsets are 0…65535"),
        (UNIT + "coils = { count = 1, values = [1, 1] }\n", "x.toml:3: unit[0].coils.values: 2 values for 1 item"),
        (UNIT + "coils = { count = 9, read_only = [[8, 2]] }\n", "x.toml:3: unit[0].coils.read_only[0]: "),
        (UNIT + "coils = { count = 9, read_only = [[8]] }\n", "x.toml:3: unit[0].coils.read_only[0]: "),
        (
            UNIT + "coils = { size = 9 }\n",
            "x.toml:3: unit[0].coils.size: unknown key; the keys allowed here are first, count",
        ),
        (UNIT + "exception_status = 256\n", "x.toml:3: unit[0].exception_status: must be 0…255, not 256"),
        (UNIT + "functions = [0]\n", "x.toml:3: unit[0].functions[0]: must be at least 1, not 0"),
        (UNIT + "server_id = 5\n", 'x.toml:3: unit[0].server_id: must be a text or { hex = "…" }, not 5'),
        (UNIT + 'server_id = { hex = "0" }\n', "x.toml:3: unit[0].server_id: '0' is not hexadecimal"),
        (
            UNIT + 'identification = { vendor = "x" }\n',
            "x.toml:3: unit[0].identification.vendor: there is no such object",
        ),
        (
            UNIT + f'identification = {{ revision = "{"x" * 245}" }}\n',
            "x.toml:3: unit[0].identification.revision: an obj",
        ),
        (UNIT + '[[unit.fifo]]\naddress = "0x1"\n', "x.toml:4: unit[0].fifo[0].address: address 0x1 means coil"),
        (UNIT + "[[unit.file]]\nnumber = 0\n", "x.toml:4: unit[0].file[0].number: must be 1…65535, not 0"),
        (UNIT + "[[unit.file]]\nnumber = 1\ncount = 10001\n", "x.toml:3: unit[0].file[0]: offsets are 0…9999"),
        (POINT, "x.toml:3: unit[0].point[0].address: is missing"),
        (POINT + 'address = "17"\n', "x.toml:5: unit[0].point[0].address: address '17' does not say which table"),
        (
            POINT + 'address = "4x0"\n',
            "x.toml:5: unit[0].point[0].address: address 4x0: there is no holding register 0",
        ),
        (POINT + 'address = "4x1"\ntype = "float"\n', "x.toml:6: unit[0].point[0].type: unknown type 'float'"),
        (
            POINT + 'address = "4x1"\ntype = "bit:3"\n',
            "x.toml:6: unit[0].point[0].type: one bit is written with its addr",
        ),
        (
            POINT + 'address = "0x1"\ntype = "int16"\n',
            "x.toml:6: unit[0].point[0].type: 0x1 is one bit and has no type",
        ),
        (POINT + 'address = "4x1"\norder = "AC"\n', "x.toml:6: unit[0].point[0].order: "),
        (POINT + 'address = "4x1"\nvalue = 65536\n', "x.toml:6: unit[0].point[0].value: 65536 does not fit uint16"),
        (POINT + 'address = "4x1"\nvalue = 1.5\n', "x.toml:6: unit[0].point[0].value: 1.5 does not fit uint16"),
        (POINT + 'address = "4x1"\nscale = 0.1\nvalue = 1.25\n', "x.toml:7: unit[0].point[0].value: 1.25 is no whole"),
        (
            POINT + 'address = "4x1"\nscale = 0.1\nvalue = 1e300\n',
            "x.toml:7: unit[0].point[0].value: 1e+300 is no whole",
        ),
        (POINT + 'address = "4x1"\nscale = 0\n', "x.toml:6: unit[0].point[0].scale: must be a number other than 0"),
        (POINT + 'address = "4x1"\nscale = nan\n', "x.toml:6: unit[0].point[0].scale: must be a number other than 0"),
        (POINT + 'address = "4x1"\ntype = "string:4"\nscale = 2\n', "x.toml:7: unit[0].point[0].scale: string:4 is no"),
        (POINT + 'address = "0x1"\nvalue = 1\n', "x.toml:6: unit[0].point[0].value: one bit is true or false, not 1"),
        (
            POINT + 'address = "3x1"\naccess = "read-write"\n',
            "x.toml:6: unit[0].point[0].access: Modbus cannot write input registers",
        ),
        (POINT + 'address = "4x1.3"\naccess = "read"\n', "x.toml:6: unit[0].point[0].access: 4x1.3 can be written as"),
        (
            POINT + 'address = "4x65536"\ntype = "int32"\n',
            "x.toml:5: unit[0].point[0].address: 2 registers from 4x65536",
        ),
        (POINT + 'address = "4x1"\nunits = "m"\n', "x.toml:6: unit[0].point[0].units: unknown key"),
    ],
)
def test_what_is_wrong_is_said_with_line_and_key(text: str, sentence: str) -> None:
    (found,) = problems_of(text)
    assert found.startswith(sentence)


def test_all_that_is_wrong_is_said_at_once_in_the_order_of_the_lines() -> None:
    text = POINT + 'address = "0x1"\ntype = "int16"\n[[unit]]\nunit = 2\ncoil = 3\n[server]\nbacklog = "x"\n'
    assert [sentence.split(": ")[0] for sentence in problems_of(text)] == ["x.toml:6", "x.toml:9", "x.toml:11"]


def test_points_must_not_share_registers() -> None:
    text = UNIT + "".join(
        f'[[unit.point]]\nname = "{name}"\naddress = "{address}"\n{rest}'
        for name, address, rest in (("a", "4x1", 'type = "int32"\n'), ("b", "4x2", ""), ("c", "4x2.5", ""))
    )
    found = problems_of(text)
    assert [sentence.split(": ", 2)[1] for sentence in found] == [
        "unit[0].point[1].address",
        "unit[0].point[2].address",
    ]
    assert found[0].endswith("4x2 is taken by 'a'")


def test_points_on_different_bits_share_a_register() -> None:
    text = UNIT + "".join(f'[[unit.point]]\nname = "{bit}"\naddress = "4x1.{bit}"\n' for bit in (0, 15))
    assert len(parse_device_file(text, "x.toml").unit[0].point) == 2


def test_a_point_must_lie_in_its_declared_table() -> None:
    (found,) = problems_of(
        UNIT + 'holding_registers = 2\n[[unit.point]]\nname = "a"\naddress = "4x2"\ntype = "int32"\n'
    )
    assert found == "x.toml:6: unit[0].point[0].address: 4x2 does not lie in the declared holding registers, 0…1"


def test_two_points_of_one_name_are_refused() -> None:
    (found,) = problems_of(POINT + 'address = "4x1"\n[[unit.point]]\nname = "a"\naddress = "4x2"\n')
    assert found == "x.toml:7: unit[0].point[1].name: 'a' is there already: point[0]"


def test_what_the_reader_cannot_take_is_said_with_a_line() -> None:
    assert problems_of("a = 1\nb = " + "[" * 5000 + "]" * 5000)[0].startswith("x.toml:2: it is nested too deeply")
    (found,) = problems_of("a = [1, [2]]\nb = " + "9" * 5000)
    assert found == "x.toml:2: a whole number of 5000 digits stands there; no value has so many"


def test_the_section_server_has_the_options_of_a_server() -> None:
    known = set(ServerSection.model_fields) - {"unit_policy", "unlisted"}
    for kind in (ServerParameters, ListenerParameters):
        assert {field.name for field in fields(kind)} <= known


@pytest.mark.parametrize("seed", range(MUTATIONS))
def test_a_mutated_file_is_right_or_wrong_at_a_line_but_never_a_surprise(seed: int) -> None:
    text = after_accidents(GOOD, random.Random(seed))
    problems: tuple[ConfigError, ...] = ()
    try:
        file = parse_device_file(text, "x.toml")
    except FileError as error:
        problems = error.problems
    else:
        assert isinstance(file, DeviceFile)
        build_units(file)
    for problem in problems:
        assert problem.file == "x.toml"
        assert problem.line is not None
        assert 1 <= problem.line <= text.count("\n") + 1
        assert "\n" not in str(problem)


def test_the_example_of_the_reference_is_right_and_its_mistakes_are_reported_as_it_says() -> None:
    page = REFERENCE.read_text(encoding="utf-8")
    example, points = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(parse_device_file(points, "points.toml").unit[0].described()) == 6 + 12 * 3
    assert [point.name for point in parse_device_file(example, "tank.toml").unit[0].point] == [
        "level",
        "temperature",
        "pump",
    ]
    wrong = example.replace('"float32"', '"float"').replace('address = "3x1"', 'adress = "3x1"')
    with pytest.raises(FileError) as caught:
        parse_device_file(wrong, "tank.toml")
    for sentence in re.findall(r"^tank\.toml:.*$", page, re.MULTILINE):
        assert sentence.removesuffix("…") in str(caught.value)
