"""`busway config`: what it says about a file that is right, and about one that is not."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from json_schema import faults

import busway

GOOD = """\
listen = ["tcp://0.0.0.0:5020"]

[server]
idle_timeout = 60

[policy]
default = "read-only"

[[link]]
name = "boiler"
url = "tcp://10.0.0.5"
timeout = 0.5

[[unit]]
unit = 3
name = "tank"
holding_registers = 100
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A good file."""
    path = tmp_path / "plant.toml"
    path.write_text(GOOD, encoding="utf-8")
    return path


@pytest.mark.clause("T33")
def test_check_says_what_it_understood_and_what_is_odd(run: Callable[..., Any], file: Path) -> None:
    result = run("config", "check", str(file))
    assert result.code == 0
    lines = [line.split(maxsplit=2) for line in result.out.splitlines()]
    assert lines[0][:2] == ["listener", "tcp://0.0.0.0:5020"]
    assert lines[-2] == ["link", "boiler", "tcp://10.0.0.5; timeout 0.5"]
    assert lines[-1] == ["unit", "3", "tank, 100 holding registers, 0 points"]
    assert ["policy", "read-only"] in lines
    (warning,) = result.err.splitlines()
    assert warning.startswith(f"{file}:1: listen[0]: warning: tcp://0.0.0.0:5020 listens on every interface")


@pytest.mark.clause("T33")
def test_check_says_everything_that_is_wrong_with_line_and_key(run: Callable[..., Any], file: Path) -> None:
    file.write_text(GOOD.replace("timeout = 0.5", 'timeout = "soon"').replace("unit = 3", "unit = 300"))
    result = run("config", "check", str(file))
    assert (result.code, result.out) == (2, "")
    assert [line.removeprefix(f"{file}:").split(": ")[:2] for line in result.err.splitlines()] == [
        ["12", "link[0].timeout"],
        ["15", "unit[0].unit"],
    ]


def test_check_opens_the_files_that_are_named(run: Callable[..., Any], file: Path) -> None:
    file.write_text(GOOD + '[security]\ncertificate = "none.pem"\n')
    result = run("config", "check", str(file))
    assert result.code == 2
    assert result.err.startswith(f"{file}:19: security.certificate: {file.parent / 'none.pem'} cannot be read: ")


def test_show_prints_every_value_that_holds_in_the_words_of_the_file(run: Callable[..., Any], file: Path) -> None:
    result = run("config", "show", str(file))
    assert (result.code, result.err) == (0, "")
    shown = tomllib.loads(result.out)
    assert shown["server"]["idle_timeout"] == 60.0
    assert shown["server"]["backlog"] == 1024
    assert shown["link"][0]["timeout"] == 0.5


WHOLE = """\
policy = "read-only"

[server]
preset = "strict"

[client]
supported_connections = 44

[audit]
path = "audit.jsonl"
on_failure = "refuse"

[metrics]
listen = "127.0.0.1:9502"

[control]
enabled = false

[[unit]]
unit = [1, 2]
description = "two\\nlines \\u007f \\"quoted\\""
identification = { "0x80" = "own", vendor_name = { hex = "01 02" } }

[[unit.point]]
name = "level"
address = "4x1"
scale = 0.1
meta = { since = 2026-01-01 }
alarm = [{ kind = "H", limit = 5 }]

[[unit.group]]
name = "string"
point = [{ name = "voltage", address = "4x2" }]
"""
RULES = """\

[policy]
default = "deny"
allow = ["127.0.0.0/8"]

[[policy.rule]]
functions = ["write"]
addresses = "4x1-4x10"
values = { min = 1, max = 5 }
"""
ODD = """\
[[listener]]
url = "tcp://127.0.0.1:0"
allow = []
secure = true

[[listener]]
url = "tcp://127.0.0.1:0"
deny = ["10.0.0.1"]
max_connections = 3

[[listener]]
url = "rtu:///dev/not-there?baud=9600"

[client]
preset = "passive"

[[link]]
name = "passive"
url = "tcp://10.0.0.5"

[[link]]
name = "strict"
url = "ascii:///dev/not-there-either"
preset = "strict"

[policy]
default = "allow"
allow = []
deny = ["::ffff:10.0.0.7", "fe80::1%eth0"]
secure = false

[[policy.rule]]
name = "a \\"name\\" \\u0007\\u007f [[policy.rule]]"
units = [0, "255", 1]
functions = ["8/1", 6, "write"]
rate = 1e-3

[[policy.rule]]
units = [0, "255", 1]
functions = ["8/1", 6, "write"]
action = "deny"

[[policy.rule]]
table = "holding"
addresses = [65535, "0-16"]
values = { max = -1, signed = true }
listeners = ["TCP://127.0.0.1:0", "rtu://"]

[[unit]]
unit = 1
holding_registers = 10
"""


@pytest.mark.parametrize("text", [ODD, WHOLE, WHOLE.replace('policy = "read-only"', "") + RULES, GOOD])
def test_show_prints_a_file_that_means_the_same(run: Callable[..., Any], tmp_path: Path, text: str) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text(text, encoding="utf-8")
    shown = run("config", "show", str(first))
    assert (shown.code, shown.err) == (0, "")
    second.write_text(shown.out, encoding="utf-8")
    one, other = busway.load_configuration(first), busway.load_configuration(second)
    assert other.access == one.access
    assert (other.audit, other.file.audit_parameters) == (one.audit, one.file.audit_parameters)
    assert other.file.metrics_address == one.file.metrics_address
    assert other.file.control_parameters == one.file.control_parameters
    assert other.file.client.supported_connections == one.file.client.supported_connections
    assert other.file.unit == one.file.unit
    assert [each.access for each in other.listeners] == [each.access for each in one.listeners]
    assert [each.limits for each in other.listeners] == [each.limits for each in one.listeners]
    assert [one.links[name].settings.differs(link.settings) for name, link in other.links.items()] == [""] * len(
        one.links
    )
    assert tomllib.loads(shown.out)["unit"] == tomllib.loads(text)["unit"]
    assert run("config", "show", str(second)).out == shown.out


@pytest.mark.clause("T33")
@pytest.mark.parametrize(("arguments", "permitted"), [((), True), (("--device",), False), (("--gateway",), True)])
def test_the_schema_is_json_and_judges_files(
    run: Callable[..., Any], arguments: tuple[str, ...], permitted: bool
) -> None:
    result = run("config", "schema", *arguments)
    assert (result.code, result.err) == (0, "")
    assert (faults(json.loads(result.out), tomllib.loads(GOOD)) == []) is permitted


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check"], "check needs a file"),
        (["show"], "show needs a file"),
        (["schema", "x.toml"], "schema takes no file"),
        (["check", "x.toml", "--device"], "--device: is for schema"),
        (["explain"], "must be check, show, schema or options, not 'explain'"),
        (["check", "nothing.toml"], "nothing.toml: cannot be read: no such file"),
    ],
)
def test_wrong_use_costs_one_sentence(run: Callable[..., Any], arguments: list[str], words: str) -> None:
    result = run("config", *arguments)
    assert (result.code, result.out) == (2, "")
    (sentence,) = result.err.splitlines()
    assert words in sentence


def test_a_file_that_is_nested_too_deeply_is_refused_as_other_wrong_ones(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    wrong = tmp_path / "deep.toml"
    wrong.write_text(f"a = {'[' * 5000}")
    result = run("config", "check", str(wrong))
    assert (result.code, result.out) == (2, "")
    assert f"{wrong}:1: it is nested too deeply" in result.err


METER = '[[unit]]\n[[unit.point]]\nname = "level"\naddress = "4x1"\ntype = "uint16"\n'
COLLECTOR = """\
[poll_class]
all.period = 0.1
[[link]]
name = "a"
url = "tcp://127.0.0.1:9"
[[device]]
name = "meter-7"
link = "a"
profile = "meter.toml"
[[sink]]
name = "broker"
url = "mqtt://127.0.0.1:9"
"""
GATEWAY = 'listen = ["tcp://127.0.0.1:5020"]\n[[link]]\nname = "line"\nurl = "tcp://10.0.0.5"\n'
WAVE = 'behaviour = { kind = "sine", amplitude = 5, period = 60 }\n'
SIMULATION = GOOD + '[[unit.point]]\nname = "level"\naddress = "4x1"\ntype = "uint16"\n' + WAVE


@pytest.mark.parametrize(
    ("text", "rows", "shown_by"),
    [
        (
            COLLECTOR,
            [
                ["collector", "store"],
                ["link", "a", "tcp://127.0.0.1:9"],
                ["device", "meter-7", "link a; unit 255; 1 point"],
                ["sink", "broker", "mqtt"],
            ],
            "busway collect plan",
        ),
        (GATEWAY, [["listener", "tcp://127.0.0.1:5020"], ["link", "line", "tcp://10.0.0.5"]], "busway gateway check"),
        (SIMULATION, [["unit", "3:", "tank:"]], "busway simulate"),
    ],
)
def test_check_knows_files_of_other_programs_and_show_names_their_command(
    run: Callable[..., Any], tmp_path: Path, text: str, rows: list[list[str]], shown_by: str
) -> None:
    (tmp_path / "meter.toml").write_text(METER)
    file = tmp_path / "plant.toml"
    file.write_text(text)
    result = run("config", "check", str(file))
    assert result.code == 0, result.err
    lines = [line.split(maxsplit=2) for line in result.out.splitlines()]
    for row in rows:
        assert any(line[: len(row)] == row or (line[2:] and line[2].startswith(row[-1])) for line in lines), lines
    shown = run("config", "show", str(file))
    assert (shown.code, shown.out) == (2, "")
    assert shown_by in shown.err


def test_check_says_what_is_wrong_with_a_collector_file(run: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(COLLECTOR.replace('link = "a"', 'link = "b"').replace("meter.toml", "none.toml"))
    result = run("config", "check", str(file))
    assert (result.code, result.out) == (2, "")
    assert f"{file}:8: device[0].link: there is no link 'b', but a" in result.err
    assert "unknown" not in result.err
