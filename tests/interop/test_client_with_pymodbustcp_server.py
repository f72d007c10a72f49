"""Our client against pyModbusTCP: the functions beyond those that every foreign server has."""

from collections.abc import Callable
from typing import Any

import foreign
import pytest

import busway


@pytest.fixture
def unit(pymodbustcp_server: foreign.Program, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(pymodbustcp_server.url)


def test_basic_identification_objects(unit: Any) -> None:
    assert unit.read_device_identification("basic") == {
        number: text for number, text in foreign.IDENTITY.items() if number <= 2
    }


def test_regular_identification_objects_of_a_server_that_leaves_out_the_basic_ones(unit: Any) -> None:
    assert unit.read_device_identification("regular") == {
        number: text for number, text in foreign.IDENTITY.items() if number >= 3
    }


def test_a_function_that_the_server_lacks_is_an_exception_reply_with_code_1(unit: Any) -> None:
    with pytest.raises(busway.ExceptionReply) as caught:
        unit.mask_write_register(0, and_mask=0xFFFF, or_mask=0)
    assert caught.value.code == 1
