"""`busway write`: what arrives at the device, and what is refused before anything is sent."""

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import busway
from busway import Device


def test_registers_are_written_and_shown(run: Callable[..., Any], url: str, device: Device) -> None:
    result = run("write", url, "4x10", "42", "0x2B")
    assert (result.code, result.out) == (0, "4x10  42  002a  written\n4x11  43  002b  written\n")
    assert device.holding_registers[9:11] == [42, 43]


def test_typed_values_in_an_order(run: Callable[..., Any], url: str, device: Device) -> None:
    assert run("write", url, "4x1", "1.5", "-2", "--type", "float32", "--order", "CDAB").code == 0
    assert device.read("4x1", "float32", order="CDAB", count=2) == [1.5, -2.0]


def test_a_negative_value_is_no_option(run: Callable[..., Any], url: str, device: Device) -> None:
    assert run("write", url, "4x1", "-5", "--type", "int16").code == 0
    assert device.read("4x1", "int16") == -5


def test_minus_infinity_is_no_option(run: Callable[..., Any], url: str, device: Device) -> None:
    assert run("write", url, "4x1", "-inf", "--type", "float32").code == 0
    assert device.read("4x1", "float32") == float("-inf")


def test_a_text_behind_two_dashes_is_no_option(run: Callable[..., Any], url: str, device: Device) -> None:
    assert run("write", url, "4x1", "--type", "string:4", "--", "-ab").code == 0
    assert list(device.holding_registers[0:2]) == [0x2D61, 0x6200]
    assert run("write", url, "4x1", "--type", "string:4", "-ab").code == 2


@pytest.mark.parametrize(
    ("text", "form", "shown"),
    [
        ("16777217", "float32", 16777216.0),
        ("2049", "float16", 2048.0),
        ("1e-50", "float32", 0.0),
        ("0.1", "float32", 0.1),
    ],
)
def test_what_is_shown_is_the_value_that_the_registers_hold(
    run: Callable[..., Any], url: str, text: str, form: str, shown: float
) -> None:
    result = run("write", url, "4x1", text, "--type", form, "--verify", "--json")
    assert (result.code, json.loads(result.out)["value"]) == (0, shown)


def test_coils_take_on_and_off(run: Callable[..., Any], url: str, device: Device) -> None:
    result = run("write", url, "0x1", "on", "off", "1", "--json")
    assert result.code == 0
    assert device.coils[0:3] == [True, False, True]
    assert len(result.out.splitlines()) == 3


def test_one_bit_of_a_register(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[0] = 0b0101
    assert run("write", url, "4x1.1", "on").out == "4x1.1  on  1  written\n"
    assert device.holding_registers[0] == 0b0111


def test_a_mask_changes_the_bits_it_names(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[4] = 0x12
    result = run("write", url, "4x5", "--mask", "0xF2", "0x25")
    assert (result.code, result.out) == (0, "4x5  AND 0x00F2 OR 0x0025  written\n")
    assert device.holding_registers[4] == 0x17  # the example of Application Protocol V1.1b3 §6.16


@pytest.mark.parametrize(("function", "code"), [("single", 6), ("multiple", 16), ("auto", 6)])
def test_the_function_can_be_chosen(
    run: Callable[..., Any], url: str, device: Device, function: str, code: int
) -> None:
    device.functions = [code]
    assert run("write", url, "4x1", "3", "--function", function).code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["4x1", "65536"], ["65536", "0…65535"]),
        (["4x1", "-5"], ["-5", "--type int16"]),
        (["4x1", "3.5"], ["3.5", "uint16"]),
        (["4x1", "1e39", "-t", "float32"], ["1e39", "float32"]),
        (["4x1", "70000", "-t", "int16"], ["70000", "int16"]),
        (["4x1", "abc"], ["abc", "uint16"]),
        (["4x1", "toolong", "-t", "string:4"], ["toolong", "string:4"]),
        (["0x1", "2"], ["'2'", "on"]),
        (["0x1", "on", "-t", "int16"], ["0x1", "no type"]),
        (["4x1.3", "on", "off"], ["4x1.3", "one bit"]),
        (["3x1", "5"], ["3x1", "input registers are read-only"]),
        (["1x1", "on"], ["1x1", "discrete inputs are read-only"]),
        (["4x1"], ["4x1", "no value"]),
        (["4x1", "1", "2", "--function", "single"], ["4x1", "2"]),
        (["4x1", "1", "--function", "both"], ["--function", "'both'"]),
        (["4x1", *["1"] * 124], ["4x1", "123"]),
        (["4x65536", "1", "2"], ["beyond"]),
        (["4x1", "--mask", "1", "70000"], ["--mask", "'70000'"]),
        (["4x1", "5", "--mask", "1", "2"], ["--mask", "'5'"]),
        (["0x1", "--mask", "1", "2"], ["--mask", "0x1"]),
        (["4x1", "1", "--tpye", "int16"], ["--tpye"]),
        (["4x1", "--mask", "1"], ["--mask"]),
        ([], ["ADDRESS"]),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is_sent(
    run: Callable[..., Any], closed_port: str, arguments: list[str], words: list[str]
) -> None:
    result = run("write", closed_port, *arguments)
    assert result.code == 2
    assert result.out == ""
    assert len(result.err.splitlines()) == 1
    for word in words:
        assert word in result.err


@pytest.mark.parametrize("arguments", [["4x1.3", "on"], ["4x1", "--mask", "0xFFF0", "0x0005"]])
def test_a_function_that_would_not_be_sent_is_refused(
    run: Callable[..., Any], url: str, device: Device, arguments: list[str]
) -> None:
    result = run("write", url, *arguments, "--function", "single")
    assert result.code == 2
    assert "--function: has no effect" in result.err
    assert device.holding_registers[0] == 0


def test_a_refusal_ends_as_4(run: Callable[..., Any], url: str) -> None:
    result = run("write", url, "4x1001", "1")
    assert result.code == 4
    assert result.out == ""


def test_a_write_without_an_answer_ends_as_3_and_is_not_repeated(
    run: Callable[..., Any], peer: Callable[..., str]
) -> None:
    requests: list[bytes] = []

    def keep_silent(request: bytes) -> bytes:
        requests.append(request)
        return b""

    result = run("write", peer(keep_silent), "4x1", "1", "--timeout", "50ms", "--retries", "3")
    assert result.code == 3
    assert len(requests) == 1


def test_json_and_csv_say_that_a_value_was_written(run: Callable[..., Any], url: str) -> None:
    told = json.loads(run("write", url, "4x1", "7", "--json").out)
    assert (told["value"], told["written"], "verified" in told) == (7, True, False)
    assert run("write", url, "4x1", "7", "--csv").out == "address,value,type,raw,outcome\n4x1,7,uint16,0007,written\n"
    assert "written" not in run("read", url, "4x1", "--json").out
    assert run("read", url, "4x1", "--csv").out == "address,value,quality,reason,type,raw\n4x1,7,good,,uint16,0007\n"


WRITES = [
    ["4x1", "42", "43"],
    ["4x1", "1.1", "nan", "--type", "float32", "--order", "CDAB"],
    ["4x1", "abc", "--type", "string:4"],
    ["4x1", "0b101", "--type", "bits"],
    ["0x1", "on", "off", "on"],
    ["4x1.3", "on"],
    ["4x1", "--mask", "0xFFF0", "0x0005"],
]


@pytest.mark.parametrize("arguments", WRITES)
def test_what_was_written_is_read_back(run: Callable[..., Any], url: str, arguments: list[str]) -> None:
    result = run("write", url, *arguments, "--verify")
    assert (result.code, result.err) == (0, "")
    assert all(line.endswith("written, read back") for line in result.out.splitlines())
    told = [json.loads(line) for line in run("write", url, *arguments, "--verify", "--json").out.splitlines()]
    assert all(each["written"] and each["verified"] and "holds" not in each for each in told)


@pytest.fixture
def stubborn() -> Iterator[str]:
    """Where a device is served that takes every write and holds zeros again when it is read."""
    device = Device(holding_registers=1000, coils=1000)

    @device.on_write("holding_registers", when="after")
    def forget(change: Any) -> None:
        device.holding_registers[0:10] = [0] * 10

    @device.on_write("coils", when="after")
    def switch_off(change: Any) -> None:
        device.coils[0:10] = [False] * 10

    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        yield server.endpoints[0]


@pytest.mark.parametrize("arguments", WRITES)
def test_a_device_that_holds_something_else_ends_as_7(
    run: Callable[..., Any], stubborn: str, arguments: list[str]
) -> None:
    result = run("write", stubborn, *arguments, "--verify")
    assert result.code == 7
    assert "written, but the device holds" in result.out
    assert "written, but the device holds" in result.err
    told = [json.loads(line) for line in run("write", stubborn, *arguments, "--verify", "--json").out.splitlines()]
    assert any(each["verified"] is False and "holds" in each for each in told)


@pytest.mark.parametrize("arguments", WRITES)
def test_a_write_that_is_not_read_back_says_that_it_was_written(
    run: Callable[..., Any], url: str, device: Device, arguments: list[str]
) -> None:
    device.functions = [5, 6, 15, 16, 22]  # it can be written and not read
    result = run("write", url, *arguments, "--verify")
    assert result.code == 7
    assert all(line.endswith("  written, not read back") for line in result.out.splitlines())
    assert "it was written, but could not be read back" in result.err
    told = [json.loads(line) for line in run("write", url, *arguments, "--verify", "--json").out.splitlines()]
    assert all(each["written"] and each["verified"] is False and "holds" not in each for each in told)
    assert run("write", url, *arguments, "--verify", "--csv").out.splitlines()[1].endswith('"written, not read back"')


def test_a_broadcast_cannot_be_verified(run: Callable[..., Any], closed_port: str) -> None:
    line = closed_port.replace("tcp://", "rtu+tcp://")
    result = run("write", line, "4x1", "1", "--unit", "0", "--verify")
    assert (result.code, result.out) == (2, "")
    assert "broadcast" in result.err
