"""Our server against pyModbusTCP: the functions beyond those that every foreign client has."""

import foreign
import pytest


@pytest.mark.parametrize(("level", "highest"), [(1, 2), (2, 6), (3, 6)])
def test_identification_objects_of_a_level(pymodbustcp_client: foreign.Program, level: int, highest: int) -> None:
    answer = pymodbustcp_client.ask(f"read_device_identification {level}")
    assert answer["objects"] == {
        str(number): text.hex() for number, text in foreign.IDENTITY.items() if number <= highest
    }


def test_one_identification_object(pymodbustcp_client: foreign.Program) -> None:
    assert pymodbustcp_client.ask("read_device_identification 4 2")["objects"] == {"2": foreign.IDENTITY[2].hex()}


def test_a_function_that_no_device_offers_is_refused_with_code_1(pymodbustcp_client: foreign.Program) -> None:
    assert pymodbustcp_client.ask("raw 0x41 1 2")["exception"] == 1
