"""`busway points convert`: a device file on stdout, the report on stderr, and no file written over."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from busway.config.files.device import parse_device_file

TELEGRAF = """
[[inputs.modbus]]
slave_id = 3
holding_registers = [
  { name = "level", byte_order = "CDAB", data_type = "FLOAT32-IEEE", address = [0, 1] },
  { name = "odd", data_type = "FLOAT31", address = [20] },
]
"""


@pytest.fixture
def telegraf(tmp_path: Path) -> Path:
    file = tmp_path / "telegraf.toml"
    file.write_text(TELEGRAF, encoding="utf-8")
    return file


def test_convert_says_that_a_file_is_not_there(run: Callable[..., Any], tmp_path: Path) -> None:
    result = run("points", "convert", str(tmp_path / "nofile"))
    assert result.code == 2
    assert "cannot be read: no such file or directory" in result.err


def test_the_device_file_goes_to_stdout_and_the_report_to_stderr(run: Callable[..., Any], telegraf: Path) -> None:
    result = run("points", "convert", str(telegraf))
    assert result.code == 0
    assert [point.name for point in parse_device_file(result.out, "x").unit[0].point] == ["level"]
    assert "not carried over: line 6: odd: has a type that there is not: 'FLOAT31'" in result.err


def test_a_file_that_is_there_is_not_written_over(run: Callable[..., Any], telegraf: Path, tmp_path: Path) -> None:
    out = tmp_path / "meter.toml"
    assert run("points", "convert", str(telegraf), "--out", str(out)).code == 0
    before = out.read_text(encoding="utf-8")
    refused = run("points", "convert", str(telegraf), "--out", str(out))
    assert (refused.code, out.read_text(encoding="utf-8")) == (2, before)
    assert "--force" in refused.err
    assert run("points", "convert", str(telegraf), "--out", str(out), "--force").code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["import", "x"], ["convert", "'import'"]),
        (["convert"], ["needs a file"]),
        (["convert", "nothing.toml"], ["nothing.toml", "no such file"]),
        (["convert", __file__], ["--from", "telegraf"]),
        (["convert", "x.toml", "--from", "excel"], ["excel", "sunspec"]),
        (["convert", "x.json", "--count", "NPt"], ["--count", "NAME=N"]),
        (["convert", "x.json", "--count", "NPt=0"], ["--count NPt", "1…10000"]),
        (["convert", "x.json", "--address", "-1"], ["--address"]),
    ],
)
def test_wrong_use_costs_one_sentence(run: Callable[..., Any], arguments: list[str], words: list[str]) -> None:
    result = run("points", *arguments)
    assert result.code == 2
    assert all(word in result.err for word in words), result.err
