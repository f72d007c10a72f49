"""`busway read`: values on stdout, what is wrong on stderr, and nothing sent where the arguments are invalid."""

import json
import math
from collections.abc import Callable
from typing import Any

import pytest

from busway import Device


def test_values_are_aligned_lines_of_address_value_and_raw_hex(
    run: Callable[..., Any], url: str, device: Device
) -> None:
    device.holding_registers[9:12] = [7, 65535, 0x1234]
    result = run("read", url, "4x10", "--count", "3")
    assert result.code == 0
    assert result.out.splitlines() == ["4x10  7      0007", "4x11  65535  ffff", "4x12  4660   1234"]
    assert result.err == ""


def test_typed_values_take_several_registers_each(run: Callable[..., Any], url: str, device: Device) -> None:
    device.write("4x1", [3.1, -0.5], "float32", order="CDAB")
    result = run("read", url, "40001", "-n", "2", "--type", "float32", "--order", "CDAB")
    assert result.out.splitlines() == ["4x1  3.1   6666 4046", "4x3  -0.5  0000 bf00"]


def test_bits_are_on_and_off(run: Callable[..., Any], url: str, device: Device) -> None:
    device.coils[0] = True
    assert run("read", url, "0x1", "-n", "2").out.splitlines() == ["0x1  on   1", "0x2  off  0"]


def test_one_bit_of_a_register(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[4] = 0b1000
    assert run("read", url, "4x5.3", "4x5.2").out.splitlines() == ["4x5.3  on   0008", "4x5.2  off  0008"]


def test_json_is_one_object_per_line(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[0] = 42
    lines = run("read", url, "holding:0", "1x1", "--json").out.splitlines()
    assert [json.loads(line) for line in lines] == [
        {
            "address": "4x1",
            "table": "holding_registers",
            "offset": 0,
            "value": 42,
            "quality": "good",
            "reason": "",
            "type": "uint16",
            "raw": "002a",
        },
        {
            "address": "1x1",
            "table": "discrete_inputs",
            "offset": 0,
            "value": False,
            "quality": "good",
            "reason": "",
            "type": "bit",
            "raw": "00",
        },
    ]


def test_json_has_a_text_where_it_has_no_number(run: Callable[..., Any], url: str, device: Device) -> None:
    device.write("4x1", math.inf, "float32")
    assert json.loads(run("read", url, "4x1", "-t", "f32", "--json").out)["value"] == "inf"


def test_csv_has_one_header_line(run: Callable[..., Any], url: str, device: Device) -> None:
    device.write("4x1", "a,b", "string:4")
    assert run("read", url, "4x1", "-t", "string:4", "--csv").out == (
        'address,value,quality,reason,type,raw\n4x1,"a,b",good,,string:4,612c6200\n'
    )


@pytest.mark.parametrize("addresses", [["3x11"], ["4x1", "3x11"]])
def test_what_could_not_be_read_is_a_record_with_its_reason(
    run: Callable[..., Any], url: str, addresses: list[str]
) -> None:
    result = run("read", url, *addresses, "--json", "-t", "int32", "-n", "2")
    assert result.code == 4
    records = [json.loads(line) for line in result.out.splitlines()]
    assert [(each["address"], each["quality"]) for each in records][-2:] == [("3x11", "bad"), ("3x13", "bad")]
    assert records[-1] == {
        "address": "3x13", "table": "input_registers", "offset": 12, "value": None, "quality": "bad",
        "reason": "exception 02, illegal data address: an item in the range does not exist or may not be written",
        "type": "int32", "raw": "",
    }  # fmt: skip
    assert run("read", url, *addresses, "--csv").out.splitlines()[-1].startswith('3x11,,bad,"exception 02')
    assert "bad" not in run("read", url, *addresses).out  # it is said on stderr


def test_without_a_connection_each_value_is_a_record_of_that(run: Callable[..., Any], closed_port: str) -> None:
    result = run("read", closed_port, "4x1", "3x1", "--csv")
    assert result.code == 5
    assert result.out.splitlines()[1:] == ["4x1,,bad,no connection,uint16,", "3x1,,bad,no connection,uint16,"]


def test_an_address_that_the_device_refuses_does_not_hide_the_others(run: Callable[..., Any], url: str) -> None:
    result = run("read", url, "3x11", "4x1")
    assert result.code == 4
    assert result.out == "4x1  0  0000\n"
    assert "3x11" in result.err
    assert "exception 02" in result.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["4x1", "-n", "126"], ["4x1", "125", "--split"]),
        (["4x1", "-n", "63", "-t", "float32"], ["126 holding registers", "--count 62", "--split"]),
        (["0x1", "-n", "2001"], ["2000", "--split"]),
        (["4x1", "-n", "0"], ["--count", "1…65536", "'0'"]),
        (["4x1", "-n", "many"], ["--count", "'many'"]),
        (["4x0"], ["4x0", "1…65536"]),
        (["nonsense"], ["nonsense", "4x1"]),
        (["17"], ["'17'", "4x18"]),
        (["0x1F"], ["0x1F", "coil:0x1F"]),
        (["4x1", "-t", "float31"], ["float31", "float32"]),
        (["4x1", "-t", "float32", "--order", "XYZ"], ["XYZ"]),
        (["0x1", "-t", "int16"], ["0x1", "no type"]),
        (["4x1.3", "-t", "int16"], ["4x1.3", "no type"]),
        (["4x1", "-u", "256"], ["--unit", "0…255", "'256'"]),
        (["4x1", "--timeout", "soon"], ["--timeout", "'soon'"]),
        (["4x1", "--timeout", "0"], ["--timeout", "0.001"]),
        (["4x1", "--retries", "-1"], ["--retries", "'-1'"]),
        (["4x1", "--watch", "x"], ["--watch", "'x'"]),
        (["4x1", "--json", "--csv"], ["--csv", "--json"]),
        (["4x1", "--colour"], ["--colour"]),
        (["4x1", "-5"], ["-5"]),
        ([], ["ADDRESS"]),
    ],
)
def test_a_bad_argument_costs_one_sentence_that_names_it_and_nothing_is_sent(
    run: Callable[..., Any], closed_port: str, arguments: list[str], words: list[str]
) -> None:
    result = run("read", closed_port, *arguments)
    assert result.code == 2  # an attempt to connect would end as 5
    assert result.out == ""
    assert len(result.err.splitlines()) == 1
    for word in words:
        assert word in result.err


@pytest.mark.parametrize("url", ["plc.local", "tcp://", "http://x", "tcp://host:99999", "tcp://127.0.0.1?speed=3"])
def test_a_bad_url_costs_one_sentence_that_names_it(run: Callable[..., Any], url: str) -> None:
    result = run("read", url, "4x1", "--timeout", "50ms", "--retries", "0")
    assert result.code in (2, 5)  # a name without an address ends as 5
    assert len(result.err.splitlines()) == 1
    assert url.split("?")[0] in result.err


def test_split_takes_several_requests(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[0:300] = list(range(300))
    result = run("read", url, "4x1", "-n", "300", "--split", "--csv")
    assert result.code == 0
    assert [line.split(",")[1] for line in result.out.splitlines()[1:]] == [str(number) for number in range(300)]


def test_split_reads_bits_over_the_limit_of_one_request(run: Callable[..., Any], url: str, device: Device) -> None:
    device.coils[2100] = True
    lines = run("read", url, "0x1", "-n", "2500", "--split").out.splitlines()
    assert len(lines) == 2500
    assert [line for line in lines if " on " in line] == ["0x2101  on   1"]


def test_the_unit_is_asked_that_is_named(run: Callable[..., Any], url: str) -> None:
    assert run("read", url, "4x1", "--unit", "1").code == 0
    result = run("read", url, "4x1", "--unit", "9")
    assert result.code == 4
    assert "unit 9" in result.err


def test_no_reply_ends_as_3(run: Callable[..., Any], peer: Callable[..., str]) -> None:
    result = run("read", peer(lambda request: b""), "4x1", "--timeout", "50ms", "--retries", "0")
    assert result.code == 3
    assert len(result.err.splitlines()) == 1


def test_no_connection_ends_as_5(run: Callable[..., Any], closed_port: str) -> None:
    result = run("read", closed_port, "4x1")
    assert result.code == 5
    assert closed_port in result.err


def test_a_broken_reply_ends_as_6(run: Callable[..., Any], peer: Callable[..., str]) -> None:
    # byte count 2, and four bytes follow
    answer = bytes.fromhex("0000 0007 ff 03 02 00 01 00 02")
    result = run("read", peer(lambda request: request[:2] + answer), "4x1", "--retries", "0")
    assert result.code == 6
    assert "broken" in result.err


@pytest.mark.parametrize(
    ("flag", "shown"), [("-v", "ReadHoldingRegisters"), ("-vv", "03 00 00 00 01"), ("-vvv", "12 bytes")]
)
def test_traffic_is_shown_on_stderr(run: Callable[..., Any], url: str, flag: str, shown: str) -> None:
    result = run("read", url, "4x1", flag)
    assert result.code == 0
    assert shown in result.err
    assert result.out == "4x1  0  0000\n"


@pytest.mark.parametrize("url", ["rtu:///dev/null", "tcp://127.0.0.1?unit=1"])
def test_a_unit_is_named_as_the_command_line_names_it(run: Callable[..., Any], url: str) -> None:
    result = run("read", url, "4x1")
    assert result.code == 2
    assert "--unit 1" in result.err
    assert "link.unit" not in result.err


@pytest.mark.parametrize("empty", ["tcp://", "tcp://:5020", "rtu+tcp://:4001"])
def test_a_url_without_a_host_is_refused(run: Callable[..., Any], empty: str) -> None:
    result = run("read", empty, "4x1")
    assert result.code == 2
    assert "the host is missing, as in" in result.err


@pytest.mark.parametrize("arguments", [["4x1"], ["4x1", "--type", "int16"], ["4x1.3"], ["0x1"]])
def test_an_order_without_effect_is_refused(run: Callable[..., Any], url: str, arguments: list[str]) -> None:
    result = run("read", url, *arguments, "--order", "CDAB")
    assert result.code == 2
    assert "--order: " in result.err


def test_an_order_that_swaps_the_bytes_of_one_register_is_taken(run: Callable[..., Any], url: str) -> None:
    assert run("read", url, "4x1", "--order", "BADC").code == 0
