"""Collector files: what they make, and all that is wrong with one at once, each with file, line and key."""

from ipaddress import ip_address
from pathlib import Path

import pytest

from busway.apps.collector.configuration import load_collector, parse_collector
from busway.apps.collector.knowledge import DeviceKnowledge, Knowledge, LearntHole
from busway.apps.collector.preview import preview
from busway.codes import Table
from busway.config.files.file_error import FileError

PLANT = """\
[collector]
store = "data"

[poll_class]
fast.period = 1.0
slow.period = 60.0

[[link]]
name = "hall"
url = "rtu:///dev/ttyUSB0?baud=9600"

[[link]]
name = "plc"
url = "tcp://127.0.0.1:1502"

[[device]]
name = "meter-7"
link = "hall"
unit = 7
profile = "meter"
poll_class = "fast"

[[device]]
name = "meter-8"
link = "hall"
unit = 8
profile = "meter"
poll_class = "slow"

[[device]]
name = "pump"
link = "plc"
profile = "pump.toml"
with = { base = 100 }
poll_class = "fast"

[[sink]]
name = "lines"
url = "file://samples.jsonl"
points = ["pump/*"]
"""
PUMP = """\
required = ["base"]

[[unit]]
read = { max_registers = 50, forbidden = ["4x120"], bridge = true }
point = [
    { name = "speed", address = "holding:${base}", scale = 0.1, unit_of_measure = "1/s" },
    { name = "hours", address = "holding:${base + 4}", type = "uint32", poll_class = "slow" },
    { name = "running", address = "coil:3" },
    { name = "double", formula = "2 * speed" },
]
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    (tmp_path / "pump.toml").write_text(PUMP)
    file = tmp_path / "plant.toml"
    file.write_text(PLANT)
    return file


def problems(file: Path, text: str) -> list[str]:
    with pytest.raises(FileError) as caught:
        parse_collector(text, str(file))
    return [str(each).removeprefix(str(file.parent) + "/") for each in caught.value.problems]


def test_a_file_makes_links_devices_and_points(plant: Path) -> None:
    made = load_collector(plant)
    assert list(made.links) == ["hall", "plc"]
    assert made.periods == {"fast": 1.0, "slow": 60.0}
    assert made.store == str(plant.parent / "data")
    pump = made.devices["pump"]
    assert (pump.link, pump.unit) == ("plc", 255)
    assert [point.name for point in pump.points] == ["speed", "hours", "running", "double"]
    assert {name: [point.name for point in each] for name, each in pump.items.items()} == {
        "fast": ["speed", "running"],
        "slow": ["hours"],
    }
    assert [point.start for point in pump.points][:2] == [100, 104]
    assert pump.rules.max_registers == 50
    assert [each.device for each in made.devices["meter-7"].descriptions()] == ["meter-7"] * len(
        made.devices["meter-7"].points
    )


def test_the_page_is_on_loopback_where_the_file_does_not_say(plant: Path) -> None:
    host, _, port = load_collector(plant).file.collector.page.rpartition(":")
    assert ip_address(host).is_loopback
    assert port == "8503"


def test_devices_of_one_profile_share_their_points(plant: Path) -> None:
    made = load_collector(plant)
    assert made.devices["meter-7"].points is made.devices["meter-8"].points


def test_a_line_costs_what_its_speed_says_and_a_network_is_learnt(plant: Path) -> None:
    made = load_collector(plant)
    assert made.devices["meter-7"].cost.base == pytest.approx(0.0329, abs=0.0001)
    assert made.devices["meter-7"].fixed
    assert not made.devices["pump"].fixed


def test_a_line_behind_a_gateway_has_the_costs_of_the_line(plant: Path) -> None:
    text = PLANT.replace('profile = "pump.toml"', 'profile = "pump.toml"\nline_baud = 9600')
    pump = parse_collector(text, str(plant)).devices["pump"]
    assert pump.fixed
    assert pump.cost.base == pytest.approx(0.0329, abs=0.0001)


def test_links_leave_repetitions_and_suspensions_to_the_schedule(plant: Path) -> None:
    link = load_collector(plant).links["hall"].settings
    assert link.parameters.retries == 0
    assert link.line is not None
    assert link.line.breaker.open_after == 0


def test_a_file_with_one_class_needs_no_names_of_classes(plant: Path) -> None:
    text = '[poll_class]\nall.period = 5\n[[link]]\nname = "a"\nurl = "tcp://127.0.0.1"\n'
    text += '[[device]]\nname = "m"\nlink = "a"\nunit = 1\nprofile = "meter"\n'
    made = parse_collector(text.replace("period = 5", "period = 5.0"), str(plant))
    assert list(made.devices["m"].items) == ["all"]


def test_all_that_is_wrong_is_said_at_once_with_file_line_and_key(plant: Path) -> None:
    text = PLANT.replace('link = "hall"\nunit = 7', 'link = "hal"\nunit = 700')
    text = text.replace("slow.period = 60.0", "slow.period = 0.0").replace('store = "data"', 'stroe = "data"')
    assert problems(plant, text) == [
        "plant.toml:2: collector.stroe: unknown key; is it store?",
        "plant.toml:6: poll_class.slow.period: must be 0.001…604800, not 0",
        "plant.toml:19: device[0].unit: must be 0…255, not 700",
    ]


def test_names_that_are_not_there_are_said_with_those_that_are(plant: Path) -> None:
    text = PLANT.replace('link = "plc"', 'link = "plz"').replace('poll_class = "slow"', 'poll_class = "slo"')
    text = text.replace('name = "meter-8"', 'name = "meter-7"')
    assert problems(plant, text) == [
        "plant.toml:24: device[1].name: 'meter-7' is there already: device[0]",
        "plant.toml:28: device[1].poll_class: there is no class 'slo', but fast, slow",
        "plant.toml:32: device[2].link: there is no link 'plz', but hall, plc",
    ]


def test_faults_of_profiles_are_said_with_their_own_lines(plant: Path) -> None:
    (plant.parent / "pump.toml").write_text(PUMP.replace("scale = 0.1", "scale = 0.0").replace("uint32", "uint33"))
    text = PLANT.replace('profile = "meter"\npoll_class = "slow"', 'profile = "metre"\npoll_class = "slow"')
    *of_the_profile, own = problems(plant, text)
    assert own.startswith("plant.toml:27: device[1].profile: ")
    assert "ready-made profiles are meter, inverter" in own
    assert [each.split(": ")[0] for each in of_the_profile] == ["pump.toml:6", "pump.toml:7"]


def test_a_point_of_several_numbers_is_refused_because_a_sample_has_one(plant: Path) -> None:
    pump = plant.with_name("pump.toml")
    pump.write_text('[[unit]]\n[[unit.point]]\nname = "three"\naddress = "4x1"\ntype = "custom:>hHl"\n')
    plant.write_text(plant.read_text().replace("with = { base = 100 }\n", ""))
    with pytest.raises(FileError, match="three has type custom:>hHl, several numbers in one value"):
        load_collector(plant)


def test_a_parameter_that_is_missing_is_named(plant: Path) -> None:
    (found,) = problems(plant, PLANT.replace("with = { base = 100 }\n", ""))
    assert found.startswith("plant.toml:33: device[2].profile: pump.toml: needs the parameter 'base'")


def test_a_class_of_a_point_that_is_not_there_is_said(plant: Path) -> None:
    text = PLANT.replace("slow.period = 60.0\n", "").replace('poll_class = "slow"', 'poll_class = "fast"')
    (found,) = problems(plant, text)
    assert "hours is in class 'slow', which is not there, but fast" in found


def test_a_unit_is_needed_on_a_line(plant: Path) -> None:
    (found,) = problems(plant, PLANT.replace("unit = 7\n", ""))
    assert "a unit is needed on a serial line" in found


def test_an_empty_file_says_what_is_missing(plant: Path) -> None:
    assert [each.split(": ", 1)[1] for each in problems(plant, "")] == [
        "link: is missing",
        "device: is missing",
        "poll_class: is missing",
    ]


def test_a_preview_shows_reads_loads_and_undeclared_registers_without_traffic(plant: Path) -> None:
    made = load_collector(plant)
    shown = preview(made, Knowledge())
    pump = [each for each in shown.reads if each.device == "pump"]
    assert [(each.poll_class, each.first, each.count, each.points) for each in pump] == [
        ("fast", "0x4", 1, 1),
        ("fast", "4x101", 1, 1),
        ("slow", "4x105", 2, 1),
    ]
    loads = {load.link: load for load in shown.loads}
    assert loads["hall"].load == pytest.approx(
        sum(each.seconds / made.periods[each.poll_class] for each in shown.reads if each.device.startswith("meter"))
    )
    assert ("pump", "would learn what a read and a register cost") in [
        (device, line.split(",")[0]) for device, line in shown.learnt
    ]


def test_a_preview_lists_what_a_bridge_would_touch_and_what_was_learnt(plant: Path) -> None:
    made = parse_collector(PLANT.replace('poll_class = "fast"', 'poll_class = "slow"'), str(plant))
    shown = preview(made, Knowledge())
    (bridge,) = [each for each in shown.reads if each.undeclared]
    assert (bridge.first, bridge.count, bridge.undeclared) == ("4x101", 6, ("4x102…4x104",))
    known = Knowledge()
    known.set("pump", DeviceKnowledge("pump.toml", "", None, (LearntHole(Table.HOLDING_REGISTERS, 100, 101, 2),)))
    shown = preview(made, known)
    assert [(device, point) for device, point, _ in shown.unreadable] == [("pump", "speed")]
    assert ("pump", "holding register 100: exception 02") in shown.learnt


def test_sinks_are_judged_with_their_lines_and_their_paths_are_those_of_the_file(plant: Path) -> None:
    made = load_collector(plant)
    assert list(made.sinks) == ["lines"]
    assert made.sinks["lines"][1].points == ("pump/*",)
    text = PLANT.replace("file://samples.jsonl", "fyle://samples.jsonl") + '[[sink]]\nname = "page"\n'
    text += 'url = "prometheus://127.0.0.1:0"\npoints = []\n'
    first, second = problems(plant, text)
    assert first.startswith("plant.toml:39: sink[0].url: ")
    assert second.startswith("plant.toml:44: sink[1].points: must be a list of patterns")


def test_names_that_would_be_one_in_topics_of_a_sink_are_refused(plant: Path) -> None:
    pytest.importorskip("aiomqtt")
    pytest.importorskip("google.protobuf")
    sink = '[[sink]]\nname = "scada"\nurl = "sparkplug+mqtt://broker"\ngroup = "plant"\nedge_node = "hall"\n'
    text = PLANT.replace('"meter-8"', '"meter#7"').replace('"meter-7"', '"meter+7"')
    parse_collector(text, str(plant))
    (found,) = problems(plant, text + sink)
    assert found == "plant.toml:43: sink[1].url: devices meter+7 and meter#7 would both be meter_7 there: rename one"
    parse_collector(text + sink + 'points = ["meter+7", "pump"]\n', str(plant))
    mqtt = '[[sink]]\nname = "broker"\nurl = "mqtt://broker"\n'
    (found,) = problems(plant, text + mqtt)
    assert "meter+7 and meter#7 would both be meter_7 there" in found
    points = PUMP.replace('"double"', '"a#b"').removesuffix("]\n") + '    { name = "a/b", formula = "1" },\n]\n'
    (plant.parent / "pump.toml").write_text(points)
    parse_collector(PLANT + mqtt + sink, str(plant))
    (found,) = problems(plant, PLANT + sink + mqtt + "per_point = true\n")
    assert "sink[2].url: points a#b and a/b of pump would both be a_b there" in found


@pytest.mark.parametrize(
    ("url", "device", "topic"),
    [
        ("mqtt://broker", "status", "busway/status"),
        ("mqtt://broker", "alarms", "busway/alarms"),
        ("nats://server", "alarms", "busway.alarms"),
    ],
)
def test_a_device_that_would_have_a_topic_of_the_sink_itself_is_refused(
    plant: Path, url: str, device: str, topic: str
) -> None:
    pytest.importorskip("aiomqtt")
    pytest.importorskip("nats")
    text = f'{PLANT}[[sink]]\nname = "broker"\nurl = "{url}"\n'
    parse_collector(text, str(plant))
    named = text.replace('"pump"', f'"{device}"')
    (found,) = problems(plant, named)
    assert f"sink[1].url: {device} would have {topic}, which is the sink's own" in found
    parse_collector(f'{named}points = ["meter-7"]\n', str(plant))
    parse_collector(named + ("per_point = true\n" if "mqtt" in url else 'subject = "s.{device}.x"\n'), str(plant))


def test_points_of_type_float32_without_a_scale_are_told_to_the_store(tmp_path: Path) -> None:
    points = """point = [
    { name = "plain", address = "4x1", type = "float32", unit_of_measure = "V" },
    { name = "scaled", address = "4x3", type = "float32", scale = 0.1 },
    { name = "wide", address = "4x5", type = "float64" },
    { name = "whole", address = "4x9", type = "uint16" },
    { name = "computed", formula = "plain * 2" },
    { name = "state", address = "0x1" },
]
"""
    (tmp_path / "profile.toml").write_text(f"[[unit]]\nunit = 1\n{points}")
    text = (
        '[poll_class]\nall.period = 1.0\n[[link]]\nname = "a"\nurl = "tcp://127.0.0.1"\n'
        '[[device]]\nname = "d"\nlink = "a"\nunit = 1\nprofile = "profile.toml"\n'
    )
    configuration = parse_collector(text, str(tmp_path / "plant.toml"))
    (device,) = configuration.devices.values()
    assert [each.point for each in device.descriptions() if each.is_float32] == ["plain"]
