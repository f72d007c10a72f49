"""Listeners without a policy: which ones other hosts can reach, and what is read-only then."""

import pytest

from busway.access.rules import Action
from busway.apps.service.listeners_without_policy import reaches_network, read_only_for


@pytest.mark.parametrize(
    ("url", "reaches"),
    [
        ("tcp://:502", True),
        ("tcp://0.0.0.0:502", True),
        ("udp://10.0.0.1:502", True),
        ("tls://[fe80::1%25eth0]:802", True),
        ("rtu+tcp://plant.example:4001", True),
        ("tcp://127.0.0.9:502", False),
        ("tcp://[::1]:502", False),
        ("tcp://localhost:502", False),
        ("rtu:///dev/ttyUSB0", False),
    ],
)
def test_whether_other_hosts_can_reach_a_listener(url: str, reaches: bool) -> None:
    assert reaches_network(url) is reaches


def test_a_policy_for_want_of_another_is_about_the_listeners_that_it_names() -> None:
    policy = read_only_for(["tcp://0.0.0.0:502"])
    assert (policy.default, [rule.action for rule in policy.rules]) == (Action.ALLOW, [Action.READ_ONLY])
    assert read_only_for([]).rules == ()
