"""`busway read --points`: points of all types by name, and failures as records."""

import csv
import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.config.devices import build_device
from busway.config.files.device import parse_device_file
from busway.pdu.device_interface import Refusal

PLANT = """
[[unit]]
unit = 1

point = [
    { name = "level", address = "4x1", type = "float32", order = "CDAB", unit_of_measure = "m", value = 3.1 },
    { name = "outside", address = "3x1", type = "int16", scale = 0.1, valid = [-4.0, 85.0], value = -4.5 },
    { name = "broken", address = "3x2", type = "int16", invalid = [0x8000], value = -32768 },
    { name = "pump", address = "0x1", value = true },
    { name = "mode", address = "4x3", enumeration = { off = 0, auto = 1 }, value = "auto" },
    { name = "nibble", address = "4x4.4-7", value = 9 },
    { name = "double", formula = "level * 2", unit_of_measure = "m" },
    { name = "power", address = "4x5", type = "int16", scale_from = "power_scale", unit_of_measure = "W", value = 123 },
    { name = "power_scale", address = "3x9", type = "int16", value = -1 },
    { name = "strings", address = "4x20", value = 2 },
]

[[unit.group]]
name = "string"
count = 3
count_from = "strings"
stride = 2
point = [{ name = "volt", address = "4x21", scale = 0.1, value = 400.0 }]
"""


@pytest.fixture
def plant(tmp_path: Path) -> str:
    file = tmp_path / "plant.toml"
    file.write_text(PLANT, encoding="utf-8")
    return str(file)


@pytest.fixture
def device() -> busway.Device:
    return build_device(parse_device_file(PLANT, "plant.toml").unit[0])


@pytest.fixture
def url(device: busway.Device) -> Iterator[str]:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device, 7: device}) as server:
        yield server.endpoints[0]


def records(result: Any) -> dict[str, dict[str, Any]]:
    return {line["point"]: line for line in map(json.loads, result.out.splitlines())}


def test_mixed_types_come_in_one_command_with_unit_of_measure_type_and_quality(
    run: Callable[..., Any], url: str, plant: str
) -> None:
    result = run("read", url, "--points", plant, "--json")
    assert result.code == 0
    found = records(result)
    assert found["level"] == {
        "unit": 1,
        "point": "level",
        "value": 3.1,
        "unit_of_measure": "m",
        "quality": "good",
        "reason": "",
        "address": "4x1",
        "type": "float32",
        "raw": "66664046",
    }
    assert (found["outside"]["value"], found["outside"]["quality"]) == (-4.5, "uncertain")
    assert (found["broken"]["value"], found["broken"]["reason"]) == (None, "no value")
    assert (found["pump"]["value"], found["pump"]["type"], found["pump"]["raw"]) == (True, "bit", "01")
    assert (found["mode"]["value"], found["mode"]["label"]) == (1, "auto")
    assert (found["nibble"]["value"], found["nibble"]["address"]) == (9, "4x4.4-7")
    assert found["double"]["value"] == pytest.approx(6.2)
    assert found["power"]["value"] == 12.3, "its scale factor comes with another read"


def test_a_group_has_as_many_members_as_the_device_says(run: Callable[..., Any], url: str, plant: str) -> None:
    found = records(run("read", url, "--points", plant, "--json", "string.*"))
    assert {name: each["value"] for name, each in found.items()} == {"string.1.volt": 400.0, "string.2.volt": 400.0}


def test_csv_has_a_column_for_each_field_and_a_header_line(run: Callable[..., Any], url: str, plant: str) -> None:
    rows = list(csv.DictReader(io.StringIO(run("read", url, "--points", plant, "level", "broken", "--csv").out)))
    assert rows[0] == {
        "point": "level", "value": "3.1", "unit_of_measure": "m", "quality": "good", "reason": "", "label": "",
        "address": "4x1", "type": "float32", "raw": "66664046",
    }  # fmt: skip
    assert (rows[1]["value"], rows[1]["quality"], rows[1]["raw"]) == ("", "bad", "8000")


def test_lines_show_what_is_not_good(run: Callable[..., Any], url: str, plant: str) -> None:
    lines = run("read", url, "--points", plant, "outside", "mode").out.splitlines()
    assert lines[0].split() == ["outside", "-4.5", "uncertain:", "out", "of", "range", "3x1", "ffd3"]
    assert lines[1].split() == ["mode", "1", "auto", "4x3", "0001"]


def test_one_bad_register_is_a_record_and_spoils_no_other(
    run: Callable[..., Any], url: str, plant: str, device: busway.Device
) -> None:
    def refuse(access: Any) -> None:
        raise Refusal(2, "no")

    device.on_read("holding_registers", refuse, address=2, count=1)
    result = run("read", url, "--points", plant, "--json")
    found = records(result)
    assert result.code == 4
    assert (found["mode"]["quality"], found["mode"]["value"]) == ("bad", None)
    assert found["mode"]["reason"].startswith("exception 02")
    assert (found["level"]["value"], found["nibble"]["value"]) == (3.1, 9)


def test_a_point_that_the_file_lets_no_request_fetch_is_wrong_use_and_spoils_no_other(
    run: Callable[..., Any], url: str, tmp_path: Path
) -> None:
    file = tmp_path / "plant.toml"
    rules = 'unit = 1\nread = { readable = ["4x1-4x10"] }\n'
    file.write_text(
        f'[[unit]]\n{rules}point = [{{ name = "mode", address = "4x3" }}, {{ name = "aside", address = "4x20" }}]\n'
    )
    result = run("read", url, "--points", str(file), "--json")
    found = records(result)
    assert (found["mode"]["value"], found["aside"]["value"]) == (1, None)
    assert found["aside"]["reason"] == "wrong configuration"
    assert result.code == 2
    assert run("read", url, "--points", str(file), "mode").code == 0


def test_a_device_that_is_not_there_leaves_records_with_the_reason(
    run: Callable[..., Any], closed_port: str, plant: str
) -> None:
    result = run("read", closed_port, "--points", plant, "--json", "level", "double", "--timeout", "1s")
    found = records(result)
    assert result.code == 5
    assert found["level"]["reason"] == "no connection"
    assert found["double"]["reason"] == "computed from a point without value"


def test_a_description_of_one_unit_serves_a_device_with_another_number(
    run: Callable[..., Any], url: str, plant: str
) -> None:
    found = records(run("read", url, "--points", plant, "--unit", "7", "level", "--json"))
    assert (found["level"]["unit"], found["level"]["value"]) == (7, 3.1)


def test_a_description_without_a_number_serves_the_unit_that_is_asked_for(
    run: Callable[..., Any], url: str, tmp_path: Path
) -> None:
    file = tmp_path / "tank.toml"
    file.write_text('[[unit]]\n[[unit.point]]\nname = "level"\naddress = "4x1"\ntype = "float32"\norder = "CDAB"\n')
    found = records(run("read", url, "--points", str(file), "-u", "7", "--json"))
    assert (found["level"]["unit"], found["level"]["value"]) == (7, 3.1)
    without = run("read", url, "--points", str(file))
    assert (without.code, without.out) == (2, "")
    assert f"{file}:1: unit[0].unit: is missing; or say it by --unit" in without.err


def test_a_ready_made_device_and_a_register_map_are_files_too(
    run: Callable[..., Any], url: str, tmp_path: Path
) -> None:
    table = tmp_path / "map.csv"
    table.write_text("name,address,type,order,unit\nlevel,4x1,float32,CDAB,m\n", encoding="utf-8")
    assert run("read", url, "--unit", "1", "--points", str(table)).out.split()[:3] == ["level", "3.1", "m"]
    result = run("read", url, "--points", "device:io", "di.1", "--json")
    assert result.code in (0, 2, 4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nope"], ["nope", "no such point", "level"]),
        (["--count", "3"], ["--count", "--points"]),
        (["--type", "int16"], ["--type", "--points"]),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_sent(
    run: Callable[..., Any], closed_port: str, plant: str, arguments: list[str], words: list[str]
) -> None:
    result = run("read", closed_port, "--points", plant, *arguments)
    assert result.code == 2
    assert all(word in result.err for word in words), result.err


def test_all_that_is_wrong_with_the_file_is_said(run: Callable[..., Any], closed_port: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text('[[unit]]\nunit = 1\npoint = [{ name = "a" }, { name = "b", address = "9x1" }]\n', encoding="utf-8")
    result = run("read", closed_port, "--points", str(file))
    assert result.code == 2
    assert "bad.toml:3: unit[0].point[0].address: is missing" in result.err
    assert "unit[0].point[1].address" in result.err


def test_the_example_of_the_how_to_prints_what_the_page_says(run: Callable[..., Any], tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "read-points.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (printed,) = re.findall(r"```\n(voltage .*?)```", page, re.DOTALL)
    file = tmp_path / "meter.toml"
    file.write_text(example, encoding="utf-8")
    served = build_device(parse_device_file(example, "meter.toml").unit[0])
    served.write("3x1", 265.4, "float32")
    served.write("3x201", -32768, "int16")
    served.write("4x10", 1)
    served.write("0x1", True)
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: served}) as server:
        assert run("read", server.endpoints[0], "--points", str(file)).out == printed


def test_watching_reads_again_with_the_time_and_ends_quietly_with_an_interrupt(url: str, plant: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "busway", "read", url, "--points", plant, "level", "--watch", "10ms", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    with process:
        first, second = (json.loads(process.stdout.readline()) for _ in range(2))
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        assert (process.returncode, said) == (0, "")
    assert first["value"] == second["value"] == 3.1
    assert first["time"] < second["time"]


def test_neither_addresses_nor_points_is_refused(run: Callable[..., Any], closed_port: str) -> None:
    result = run("read", closed_port)
    assert result.code == 2
    assert "--points" in result.err
