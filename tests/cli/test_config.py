"""`busway config`: what it says about a file that is right, and about one that is not."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from json_schema import faults

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
