"""`busway write`: what arrives at the device, and what is refused before anything is sent."""

from collections.abc import Callable
from typing import Any

import pytest

from busway import Device


def test_registers_are_written_and_shown(run: Callable[..., Any], url: str, device: Device) -> None:
    result = run("write", url, "4x10", "42", "0x2B")
    assert (result.code, result.out) == (0, "4x10  42  002a\n4x11  43  002b\n")
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


def test_coils_take_on_and_off(run: Callable[..., Any], url: str, device: Device) -> None:
    result = run("write", url, "0x1", "on", "off", "1", "--json")
    assert result.code == 0
    assert device.coils[0:3] == [True, False, True]
    assert len(result.out.splitlines()) == 3


def test_one_bit_of_a_register(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[0] = 0b0101
    assert run("write", url, "4x1.1", "on").out == "4x1.1  on  1\n"
    assert device.holding_registers[0] == 0b0111


def test_a_mask_changes_the_bits_it_names(run: Callable[..., Any], url: str, device: Device) -> None:
    device.holding_registers[4] = 0x12
    assert run("write", url, "4x5", "--mask", "0xF2", "0x25").code == 0
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
        (["3x1", "5"], ["3x1", "can not be written"]),
        (["1x1", "on"], ["1x1", "can not be written"]),
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
def test_what_can_not_be_written_is_refused_before_anything_is_sent(
    run: Callable[..., Any], nobody: str, arguments: list[str], words: list[str]
) -> None:
    result = run("write", nobody, *arguments)
    assert result.code == 2
    assert result.out == ""
    assert len(result.err.splitlines()) == 1
    for word in words:
        assert word in result.err


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
