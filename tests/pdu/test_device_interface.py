"""What a device and a hook raise to refuse."""

import pytest

from busway.pdu.device_interface import Refusal


@pytest.mark.clause("A20")
def test_a_refusal_without_a_code_is_a_failure_of_the_device() -> None:
    refusal = Refusal()
    assert refusal.code == 4
    assert str(refusal) == "server device failure while executing"


def test_a_refusal_keeps_code_and_reason() -> None:
    refusal = Refusal(6, "the valve is moving")
    assert (refusal.code, refusal.reason, str(refusal)) == (6, "the valve is moving", "the valve is moving")


@pytest.mark.parametrize("code", [0, 256, -1])
def test_a_code_that_does_not_fit_its_byte_is_no_refusal(code: int) -> None:
    with pytest.raises(ValueError, match=f"an exception code is 1…255, not {code}"):
        Refusal(code)
