"""Allow and deny lists, and secure mode."""

import pytest

from busway.access.addresses import AddressList
from busway.errors import ConfigError


@pytest.mark.clause("T15")
@pytest.mark.clause("T35")
@pytest.mark.parametrize(
    ("access", "host", "allowed", "why"),
    [
        (AddressList(), "10.0.0.7", True, "not denied"),
        (AddressList(secure=True), "10.0.0.7", False, "not listed, in secure mode"),
        (AddressList(["10.0.0.0/8"]), "10.0.0.7", True, "allowed by 10.0.0.0/8"),
        (AddressList(["10.0.0.0/8"]), "11.0.0.7", False, "not listed, in secure mode"),
        (AddressList(["10.0.0.0/8"], secure=False), "11.0.0.7", True, "not denied"),
        (AddressList(deny=["10.0.0.0/8"]), "10.0.0.7", False, "denied by 10.0.0.0/8"),
        (AddressList(deny=["10.0.0.0/8"]), "11.0.0.7", True, "not denied"),
        (AddressList(["10.0.0.7"], ["10.0.0.0/8"]), "10.0.0.7", False, "denied by 10.0.0.0/8"),
        (AddressList(["10.0.0.0/8"], ["10.0.0.7"]), "::ffff:10.0.0.7", False, "denied by 10.0.0.7"),
        (AddressList(["fe80::/10"]), "fe80::1%eth0", True, "allowed by fe80::/10"),
        (AddressList(deny=["10.0.0.7"]), "nothing numeric", True, "not denied"),
        (AddressList(["10.0.0.7"]), "nothing numeric", False, "not listed, in secure mode"),
    ],
)
def test_who_may_connect_and_why(access, host, allowed, why):
    assert access(host) is allowed
    assert access.why(host) == why


@pytest.mark.parametrize("name", ["allow", "deny"])
def test_an_entry_that_cannot_be_names_its_list(name):
    with pytest.raises(ConfigError) as caught:
        AddressList(**{name: ["10.0.0.1/8"]})
    assert caught.value.key == name


def test_an_empty_list_of_allowed_hosts_does_not_permit_all_of_them():
    with pytest.raises(ConfigError, match="is empty") as caught:
        AddressList(allow=[])
    assert caught.value.key == "allow"
    assert not AddressList([], secure=True)("10.0.0.7")
    assert AddressList([], secure=False)("10.0.0.7")


def test_lists_that_say_the_same_are_equal():
    assert AddressList(["::1"]) == AddressList(["::1"], secure=True)
    assert hash(AddressList(["::1"])) == hash(AddressList(["::1"], secure=True))
    assert AddressList(["::1"]) != AddressList(["::1"], secure=False)
