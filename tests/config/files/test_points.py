"""The schema of points and groups: what it makes of them, and all that can be wrong, with file, line and key."""

import pytest

from busway.codes import Table
from busway.config.devices import build_device
from busway.config.files.device import UnitSection, item_range, parse_device_file
from busway.config.files.file_error import FileError
from busway.errors import InvalidRequest
from busway.points import AlarmRule, ItemRange, Point, ReportRule
from busway.points.decoder import decode_point

UNIT = "[[unit]]\nunit = 1\n"
POINT = UNIT + '[[unit.point]]\nname = "a"\naddress = "4x1"\n'


def unit_of(text: str) -> UnitSection:
    return parse_device_file(text, "x.toml").unit[0]


def points_of(text: str) -> dict[str, Point]:
    return {point.name: point for point in unit_of(text).described()}


def problems_of(text: str) -> list[str]:
    with pytest.raises(FileError) as caught:
        parse_device_file(text, "x.toml")
    return str(caught.value).splitlines()


def test_a_point_says_all_that_a_file_can_say() -> None:
    point = points_of(
        POINT
        + 'type = "int16"\nscale = 0.1\noffset = -4\ninvalid = [0x8000]\nvalid = [-40.0, inf]\nunit_of_measure = "V"\n'
        'poll_class = "fast"\nwas = "old"\nmeta = { room = "hall" }\nmaximum = 30.0\nrollover = true\n'
        'report = { when = "change", deadband = "2.5 %", max_silence = 60.0 }\n'
        'alarm = [{ kind = "HH", limit = 25.0, delay = 3.0, hysteresis = 1.0, acknowledge = true }]\n'
        'write = { function = 6, verify = "3x5", step = 0.5 }\n'
    )["a"]
    assert (point.table, point.start, point.type) == (Table.HOLDING_REGISTERS, 0, "int16")
    assert decode_point(point, b"\x00\x64").value == 6.0
    assert decode_point(point, b"\x80\x00").value is None
    assert point.reporting == ReportRule("change", None, 2.5, True, 60.0)
    assert point.alarms == (AlarmRule("HH", 25.0, 3.0, 1.0, True),)
    assert point.writing is not None
    assert (point.writing.function, str(point.writing.verify), point.writing.maximum) == (6, "3x5", 30.0)
    assert (point.was, point.meta, point.poll_class, point.rollover) == ("old", {"room": "hall"}, "fast", 3276.8)


@pytest.mark.parametrize(
    ("keys", "end"),
    [
        ('type = "uint16"', 65_536.0),
        ('type = "int16"', 32_768.0),
        ('type = "int32"', 2.0**31),
        ('type = "int64"', 2.0**63),
        ('type = "uint8:low"', 256.0),
        ('type = "int8:high"', 128.0),
        ('type = "bcd16"', 10_000.0),
    ],
)
def test_a_counter_begins_again_where_its_type_ends(keys: str, end: float) -> None:
    assert points_of(POINT + keys + "\nrollover = true\n")["a"].rollover == end


@pytest.mark.parametrize(("rollover", "is_scaled"), [("true", True), ("1000000", False), ("false", False)])
def test_where_a_type_ends_counts_the_scale_factor_and_a_given_number_does_not(rollover: str, is_scaled: bool) -> None:
    factor = '[[unit.point]]\nname = "sf"\naddress = "4x9"\ntype = "int16"\n'
    points = points_of(f'{POINT}scale_from = "sf"\nrollover = {rollover}\n{factor}')
    assert points["a"].rollover_is_scaled is is_scaled
    assert not points["sf"].rollover_is_scaled


def test_a_counter_in_a_field_of_bits_begins_again_where_the_field_ends() -> None:
    assert points_of(POINT.replace('"4x1"', '"4x1.4-7"') + "rollover = true\n")["a"].rollover == 16.0


def test_states_of_bits_enumerations_and_flags_can_be_alarms() -> None:
    state = "alarm = [{ kind = 'state', delay = 2, states = "
    (bit,) = points_of(UNIT + f"[[unit.point]]\nname='a'\naddress='0x1'\n{state}[false] }}]\n")["a"].alarms
    assert bit == AlarmRule("state", delay=2.0, states=("off",), numbers=frozenset({0}))
    (named,) = points_of(POINT + f"enumeration = {{ ok = 1, bad = 7 }}\n{state}['bad'] }}]\n")["a"].alarms
    assert (named.numbers, named.states) == (frozenset({7}), ("bad",))
    (flags,) = points_of(POINT + f"flags = {{ door = 0, fire = 3 }}\n{state}['fire', 'door'] }}]\n")["a"].alarms
    assert (flags.bits, flags.numbers) == (0b1001, frozenset())


def test_a_group_is_written_once_and_stands_at_each_of_its_places() -> None:
    points = points_of(
        UNIT
        + 'read = { poll_class = "slow" }\n'
        + 'point = [{ name = "n", address = "4x1" }, { name = "sf", address = "4x2", type = "int16" }]\n'
        + '[[unit.group]]\nname = "module"\ncount = 2\ncount_from = "n"\nstride = 20\natomic = true\n'
        + 'point = [{ name = "v", address = "4x11", scale_from = "sf" }, { name = "on", address = "4x12.3" },\n'
        + '    { name = "mode", address = "4x13.4-7" }, { name = "p", formula = "v * n" }]\n'
        + '[[unit.group.group]]\nname = "string"\ncount = 2\nstride = 3\n'
        + 'point = [{ name = "sf", address = "4x21", type = "int16" },\n'
        + '    { name = "a", address = "4x22", scale_from = "sf" }]'
    )
    assert [str(points[f"module.{index}.v"].address) for index in (1, 2)] == ["4x11", "4x31"]
    assert str(points["module.2.on"].address) == "4x32.3"
    assert points["module.2.mode"].type == "field:4-7"
    assert points["module.2.v"].conversion.scale_from == "sf"
    assert points["module.2.p"].formula == "point('module.2.v') * point('n')"
    inner = points["module.2.string.2.a"]
    assert (str(inner.address), inner.conversion.scale_from) == ("4x45", "module.2.string.2.sf")
    assert (inner.exists, inner.group, inner.poll_class) == ((("n", 2),), "module.2", "slow")
    assert (points["n"].exists, points["n"].group) == ((), None)


def test_how_a_unit_lets_itself_be_read() -> None:
    rules = unit_of(
        UNIT + 'read = { max_registers = 50, readable = ["4x1-4x100", "holding:0x200-holding:0x20F"],'
        ' forbidden = ["3x5"], exact = ["0x1-0x16"], bridge = true, one_point = true, pause = 0.01 }\n'
    ).read.rules()
    assert (rules.max_registers, rules.bridge, rules.one_point, rules.pause) == (50, True, True, 0.01)
    assert rules.readable == {Table.HOLDING_REGISTERS: [ItemRange(0, 100), ItemRange(0x200, 0x210)]}
    assert rules.forbidden == {Table.INPUT_REGISTERS: [ItemRange(4, 5)]}
    assert rules.exact == {Table.COILS: [ItemRange(0, 16)]}


@pytest.mark.parametrize("text", ["4x1-3x5", "4x9-4x1", "4x1.3", "4x1-9", "", "4x1-"])
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(InvalidRequest):
        item_range(text)


def test_fields_halves_and_overlaps_are_served_with_their_first_values() -> None:
    device = build_device(
        unit_of(
            UNIT
            + 'point = [{ name = "a", address = "4x1.4-7", value = 9 },\n'
            + '  { name = "b", address = "4x1.0", value = true },\n'
            + '  { name = "c", address = "4x1.8-15", type = "int16", value = -2 },\n'
            + '  { name = "word", address = "4x1", overlaps = true },\n'
            + '  { name = "h", address = "4x2", type = "uint8:high", value = 7 },\n'
            + '  { name = "l", address = "4x2", type = "int8:low", value = -1 },\n'
            + '  { name = "big", address = "4x3", type = "uint48", order = "CDABEF", value = 0x010203040506 }]\n'
        )
    )
    assert [hex(device.read(f"4x{number}")) for number in (1, 2, 3, 4, 5)] == [
        "0xfe91",
        "0x7ff",
        "0x304",
        "0x102",
        "0x506",
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (POINT + 'offset = "1"\n', "x.toml:6: unit[0].point[0].offset: must be a number, not '1'"),
        (POINT + "linear = { raw = [1, 1], value = [0, 1] }\n", "x.toml:6: unit[0].point[0].linear.raw: has the same"),
        (POINT + "scale = 2\nlinear = { raw = [0, 1], value = [0, 1] }\n", "unit[0].point[0].linear: stands instead"),
        (POINT + "invalid = [-1]\n", "x.toml:6: unit[0].point[0].invalid[0]: -1 is never read: it does not fit uint16"),
        (POINT + "type = 'int16'\ninvalid = [65536]\n", "unit[0].point[0].invalid[0]: 65536 is never read"),
        (POINT + "valid = [1]\n", "x.toml:6: unit[0].point[0].valid: must have at least 2 elements, not [1]"),
        (POINT + "rollover = 'x'\n", "unit[0].point[0].rollover: must be true or false, or a number, not 'x'"),
        (POINT + "invalid = ['x']\n", "unit[0].point[0].invalid[0]: must be a number, not 'x'"),
        (POINT + "enumeration = { int = 'x' }\n", "unit[0].point[0].enumeration.int: must be a whole number, not 'x'"),
        (POINT + "invalid = [0.5]\n", "x.toml:6: unit[0].point[0].invalid[0]: must be a whole number"),
        (POINT + "valid = [2, 1]\n", "x.toml:6: unit[0].point[0].valid: must be [low, high]"),
        (POINT + "flags = { x = 16 }\n", "x.toml:6: unit[0].point[0].flags.x: uint16 has bits 0…15, not 16"),
        (POINT + "flags = { x = 1 }\nscale = 2\n", "x.toml:6: unit[0].point[0].flags: names of bits go with whole"),
        (POINT + "scale_from = 'b'\n", "x.toml:6: unit[0].point[0].scale_from: there is no point 'b'"),
        (POINT + "formula = 'b'\n", "x.toml:5: unit[0].point[0].address: 'a' is computed and has no address"),
        (
            UNIT + "[[unit.point]]\nname='a'\nformula='a + 1'\n",
            "x.toml:5: unit[0].point[0].formula: depends on itself: a",
        ),
        (UNIT + "[[unit.point]]\nname='a'\nformula='b + '\n", "x.toml:5: unit[0].point[0].formula: 'b + ' is no expr"),
        (UNIT + "[[unit.point]]\nname='a'\nformula='b'\n", "x.toml:5: unit[0].point[0].formula: there is no point 'b'"),
        (
            UNIT + "point = [{ name = 't', address = '4x1' }, { name = 'a', formula = 't + 1' }]\n",
            'unit[0].point[1].formula: t is no point here; the point of that name is point("t")',
        ),
        (POINT + "write = { on = 1 }\n", "x.toml:6: unit[0].point[0].write.off: is missing: a switch has both"),
        (POINT + "write = { function = 5 }\n", "point[0].write.function: function 5 does not write holding registers"),
        (
            POINT + "type = 'float32'\nwrite = { function = 6 }\n",
            "write.function: float32 has 2 registers; 6 writes one",
        ),
        (
            UNIT + "[[unit.point]]\nname='a'\naddress='0x1'\nwrite={ function = 16 }\n",
            "unit[0].point[0].write.function: function 16 does not write coils",
        ),
        (POINT + "write = { on = 70000, off = 0 }\n", "unit[0].point[0].write.on: 70000 does not fit uint16"),
        (POINT + "write = { on = 1, off = 1 }\n", "unit[0].point[0].write.off: is 1, as on"),
        (POINT + "write = { verify = 'x' }\n", "x.toml:6: unit[0].point[0].write.verify: "),
        (POINT + "access = 'read'\nwrite = { function = 6 }\n", "unit[0].point[0].write: 'a' is only read"),
        (POINT + "report = 'often'\n", "x.toml:6: unit[0].point[0].report.when: must be 'every', 'change' or"),
        (POINT + "report = { when = 'change_or_period' }\n", "x.toml:6: unit[0].point[0].report.period: is missing"),
        (
            POINT + "report = { when = 'change', deadband = '1' }\n",
            "point[0].report.deadband: must be a number, or perc",
        ),
        (
            POINT + "alarm = [{ kind = 'H', limit = 1 }, { kind = 'H', limit = 2 }]\n",
            "alarm[1].kind: H is there already",
        ),
        (POINT + "alarm = [{ kind = 'H' }]\n", "point[0].alarm[0].limit: is missing: H needs it"),
        (POINT + "alarm = [{ kind = 'state', limit = 1 }]\n", "point[0].alarm[0].states: is missing: state needs it"),
        (POINT + "alarm = [{ kind = 'H', limit = 1, states = ['x'] }]\n", "alarm[0].states: does not go with H"),
        (
            POINT + "alarm = [{ kind = 'state', states = ['x'] }]\n",
            "alarm[0]: 'a' has no states: it is no bit, and has",
        ),
        (
            POINT + "flags = { x = 1 }\nalarm = [{ kind = 'state', states = ['x', 'z'] }]\n",
            "alarm[0].states[1]: there is no state 'z'; there are x",
        ),
        (
            UNIT + "[[unit.point]]\nname='a'\naddress='0x1'\nalarm = [{ kind = 'state', states = ['on'] }]\n",
            "alarm[0].states[0]: there is no state 'on'; there are true, false",
        ),
        (POINT + "rollover = true\ntype = 'float32'\n", "unit[0].point[0].rollover: 'a' holds no whole number"),
        (
            UNIT + "[[unit.point]]\nname='a'\naddress='0x1'\nvalid=[0,1]\n",
            "point[0].valid: 0x1 is one bit and has no val",
        ),
        (UNIT + "[[unit.point]]\nname='a'\naddress='4x1.9-4'\n", "x.toml:5: unit[0].point[0].address: "),
        (UNIT + "[[unit.point]]\nname='a'\naddress='4x1.4-7'\nvalue=16\n", "point[0].value: 16 does not fit field:4-7"),
        (
            UNIT + "[[unit.point]]\nname='a'\naddress='4x1.4-7'\ntype='float32'\n",
            "bits of a register are int16 or uint16",
        ),
        (UNIT + "read = { forbidden = ['4x'] }\n", "x.toml:3: unit[0].read.forbidden[0]: "),
        (UNIT + "read = { max_registers = 126 }\n", "x.toml:3: unit[0].read.max_registers: must be 1…125, not 126"),
        (UNIT + "[[unit.group]]\nname='g'\ncount=2\npoint=[{name='a',address='4x1'}]\n", "group[0].stride: is missing"),
        (UNIT + "[[unit.group]]\nname='g'\n", "x.toml:3: unit[0].group[0].point: is missing"),
        (
            UNIT + "[[unit.group]]\nname='g'\ncount=2\nstride=1\npoint=[{name='a',address='4x1',type='int32'}]\n",
            "x.toml:7: unit[0].group[0].point[0].address: 4x2 is taken by 'g.1.a'",
        ),
        (
            UNIT + "[[unit.group]]\nname='g'\ncount=2\ncount_from='n'\nstride=1\npoint=[{name='a',address='4x1'}]\n",
            "x.toml:6: unit[0].group[0].count_from: there is no point 'n'",
        ),
        (
            UNIT + "[[unit.group]]\nname='g'\ncount=2\nstride=60000\npoint=[{name='a',address='4x60001'}]\n",
            "x.toml:3: unit[0].group: its places do not fit: offset 120000 is outside 0…65535",
        ),
        (
            UNIT
            + "[[unit.group]]\nname='g'\ncount=9999\nstride=1\n"
            + "point=[{name='a',address='4x1'},{name='b',address='3x1'}]\n",
            "x.toml:3: unit[0].group: groups come to more than 10000 points",
        ),
    ],
)
def test_what_cannot_be_is_said_with_its_line_and_key(text: str, sentence: str) -> None:
    problems = problems_of(text)
    assert len(problems) == 1, problems
    assert sentence in problems[0]


def test_all_that_is_wrong_is_said_at_once_also_beside_other_faults_of_the_same_point() -> None:
    problems = problems_of(
        UNIT
        + '[[unit.point]]\nname = "a"\naddress = "4x1"\nscale = "x"\ntype = "flaot32"\naccess = "write"\n'
        + '[[unit.point]]\nname = "b"\nadress = "4x9"\nvalid = [3.0, 1.0]\n'
        + '[[unit.group]]\nname = "g"\ncount = 3\npoint = [{ name = "c", address = "5x1" }]\n'
    )
    assert [problem.split(": ")[:2] for problem in problems] == [
        ["x.toml:6", "unit[0].point[0].scale"],
        ["x.toml:7", "unit[0].point[0].type"],
        ["x.toml:8", "unit[0].point[0].access"],
        ["x.toml:11", "unit[0].point[1].adress"],
        ["x.toml:12", "unit[0].point[1].valid"],
        ["x.toml:13", "unit[0].group[0].stride"],
        ["x.toml:16", "unit[0].group[0].point[0].address"],
    ]
