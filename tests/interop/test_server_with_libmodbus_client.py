"""Our server against libmodbus: functions that not every foreign client has, and requests that it lets us forge."""

from collections.abc import Iterator
from typing import Any

import foreign
import pytest

import busway


@pytest.fixture(scope="module")
def unit(our_url: str) -> Iterator[Any]:
    with busway.connect(our_url) as link:
        yield link.unit(1)


def test_mask_write_keeps_the_bits_of_the_and_mask(libmodbus_client: foreign.Program, unit: Any) -> None:
    unit.write_single_register(800, 0x12)
    assert libmodbus_client.ask("mask_write_register 800 0xF2 0x25")["ok"]
    assert unit.read_holding_registers(800, count=1) == [0x17]


def test_the_server_id_is_the_same_for_both(libmodbus_client: foreign.Program, unit: Any) -> None:
    assert bytes.fromhex(libmodbus_client.ask("report_server_id")["data"]) == unit.report_server_id()


@pytest.mark.parametrize(
    ("request_bytes", "reply"),
    [
        ("0x03 0 0 0 1", "03020003"),  # holding register 0
        ("0x03 0 0 0 0", "8303"),  # no registers at all
        ("0x03 0 0 0 126", "8303"),  # one more than a reply may carry
        ("0x01 0 0 0x07 0xD1", "8103"),  # 2001 coils
        ("0x05 0 0 0x12 0x34", "8503"),  # neither on nor off
        ("0x41 1 2 3", "c101"),  # a function that no device offers
    ],
)
def test_a_forged_request_is_answered_as_the_specification_says(
    libmodbus_client: foreign.Program, request_bytes: str, reply: str
) -> None:
    assert libmodbus_client.ask(f"raw {request_bytes}") == {"ok": True, "pdu": reply}
