"""`busway identify`: the levels a device has, and devices that offer one of the two functions, or none."""

import json
from collections.abc import Callable
from typing import Any

from busway import Device


def test_all_objects_and_the_server_id(run: Callable[..., Any], url: str, device: Device) -> None:
    device.set_identification({0: "Acme", 1: "T-1", 2: "2.0", 6: "Tank", 0x80: b"\x01\x02"})
    device.set_server_id(b"tank\xff")
    result = run("identify", url)
    assert result.code == 0
    assert result.out.splitlines() == [
        "43/14  VendorName           Acme",
        "43/14  ProductCode          T-1",
        "43/14  MajorMinorRevision   2.0",
        "43/14  UserApplicationName  Tank",
        "43/14  object 0x80          \\x01\\x02  [01 02]",
        "17     ServerId             tank\\xff  [74 61 6e 6b ff]",
    ]


def test_json_carries_the_bytes(run: Callable[..., Any], url: str, device: Device) -> None:
    device.set_server_id(b"x\x00")
    last = json.loads(run("identify", url, "--json").out.splitlines()[-1])
    assert last == {"function": "17", "name": "ServerId", "value": "x\\x00", "raw": "7800"}


def test_what_a_device_does_not_offer_is_said_and_is_no_error(
    run: Callable[..., Any], url: str, device: Device
) -> None:
    device.functions = [3, 17]
    result = run("identify", url)
    assert result.code == 0
    assert "43/14) is not offered" in result.err
    assert result.out.startswith("17  ServerId")


def test_a_device_that_offers_neither_is_an_error(run: Callable[..., Any], url: str, device: Device) -> None:
    device.functions = [3]
    result = run("identify", url)
    assert result.code == 4
    assert result.out == ""


def test_a_level_that_is_refused_is_asked_lower(run: Callable[..., Any], peer: Callable[..., str]) -> None:
    def only_basic(request: bytes) -> bytes:
        pdu = request[7:]
        if pdu[:3] == b"\x2b\x0e\x01":
            answer = bytes.fromhex("2b 0e 01 01 00 00 03 00 01 41 01 01 42 02 01 43")
        else:
            answer = bytes((pdu[0] | 0x80, 3 if pdu[0] == 0x2B else 1))
        return request[:4] + (1 + len(answer)).to_bytes(2, "big") + request[6:7] + answer

    result = run("identify", peer(only_basic))
    assert result.code == 0
    assert [line.split()[-1] for line in result.out.splitlines()] == ["A", "B", "C"]


def test_no_connection_ends_as_5(run: Callable[..., Any], closed_port: str) -> None:
    assert run("identify", closed_port).code == 5


def test_silent_device_is_told_as_silent_once(run: Callable[..., Any], peer: Callable[..., str]) -> None:
    def keep_silent(request: bytes) -> bytes:
        return b""

    result = run("identify", peer(keep_silent), "--timeout", "50ms", "--retries", "0")
    assert result.code != 0
    assert "is not offered" not in result.err
    assert len(result.err.splitlines()) == 1


def refusing(codes: dict[int, int], asked: list[int]) -> Callable[[bytes], bytes]:
    """Answer each function with its exception code; ``asked`` gets the functions that were asked for."""

    def answer(request: bytes) -> bytes:
        asked.append(request[7])
        return request[:4] + b"\x00\x03" + request[6:7] + bytes((request[7] | 0x80, codes[request[7]]))

    return answer


def test_a_device_that_a_gateway_cannot_reach_is_told_as_that_once(
    run: Callable[..., Any], peer: Callable[..., str]
) -> None:
    asked: list[int] = []
    result = run("identify", peer(refusing({0x2B: 0x0B, 0x11: 0x0B}, asked)))
    assert result.code == 4
    assert "is not offered" not in result.err
    assert len(result.err.splitlines()) == 1
    assert asked == [0x2B, 0x11]


def test_what_is_only_busy_is_not_told_as_missing(run: Callable[..., Any], peer: Callable[..., str]) -> None:
    result = run("identify", peer(refusing({0x2B: 0x06, 0x11: 0x01}, [])), "--retries", "0")
    assert result.code == 4
    assert "43/14) is not offered" not in result.err
    assert "server id (17) is not offered" in result.err


def test_what_a_gateway_cannot_reach_any_more_is_not_told_as_missing(
    run: Callable[..., Any], peer: Callable[..., str]
) -> None:
    result = run("identify", peer(refusing({0x2B: 0x01, 0x11: 0x0A}, [])))
    assert "server id (17) is not answered" in result.err
    assert "43/14) is not offered" in result.err
