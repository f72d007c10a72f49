"""Network addresses in registers: what is no address of its kind, and what registers have no place for, is refused."""

import pytest

from busway.errors import InvalidRequest
from busway.values import value_type


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("eui48", "00:  :44:11:3A:B7"),
        ("eui48", "00:1\t:44:11:3A:B7"),
        ("eui64", "00:1B:44:  :  :11:3A:B7"),
        ("ipv6", "fe80::1%eth0"),
        ("ipv6", "fe80::1%"),
    ],
)
def test_blanks_are_no_byte_and_a_zone_is_not_dropped(name: str, text: str) -> None:
    kind = value_type(name)
    with pytest.raises(InvalidRequest, match=f"does not fit {name}, which takes an address such as"):
        kind.encode([text])
    with pytest.raises(InvalidRequest, match=f"does not fit {name}, which takes an address such as"):
        kind.parse(text)


def test_an_eui_may_have_small_letters_and_hyphens() -> None:
    assert value_type("eui48").encode(["00-1b-44-11-3a-b7"]) == bytes.fromhex("00 1B 44 11 3A B7")
