"""Access rules that an earlier rule hides are found; rules that may still decide are not."""

import time
from typing import Any

import pytest

from busway.access.rules import Rule
from busway.access.unreached_rules import COMPARED, unreached_rules


def found(*rules: dict[str, Any]) -> list[tuple[int, int]]:
    return list(unreached_rules([Rule.of(**each) for each in rules]))


@pytest.mark.parametrize(
    ("earlier", "later"),
    [
        ({}, {"action": "deny"}),
        ({"action": "read-only"}, {"functions": "write", "addresses": "4x1-4x5"}),
        ({"rate": 5}, {"peers": ["10.0.0.7"], "roles": ["operator"], "listeners": ["tls://"]}),
        ({"roles": ["operator", "viewer"]}, {"roles": ["operator"], "action": "deny"}),
        ({"peers": ["10.0.0.7", "10.0.0.8"]}, {"peers": ["10.0.0.8", "10.0.0.7"], "units": 3}),
        ({"listeners": ["tls://"]}, {"listeners": ["tls://10.0.0.1:802"]}),
        ({"units": "1-5"}, {"units": "2,3", "access": "write"}),
        ({"functions": [8, 3]}, {"functions": ["8/1", 3]}),
        ({"addresses": "4x1-4x100"}, {"addresses": "4x10-4x20,4x30"}),
        ({"table": ["holding", "coil"]}, {"table": "coil", "access": "read"}),
        ({"files": "1-4"}, {"files": "2-3"}),
        ({"values": (0, 5), "addresses": "4x1"}, {"addresses": "4x1"}),
    ],
)
def test_a_rule_behind_one_that_takes_all_its_requests_never_decides(
    earlier: dict[str, Any], later: dict[str, Any]
) -> None:
    assert found(earlier, later) == [(1, 0)]


@pytest.mark.parametrize(
    ("earlier", "later"),
    [
        ({"access": "write"}, {"access": "read"}),
        ({"units": "1-5"}, {"units": "5-6"}),
        ({"roles": ["operator"]}, {"roles": ["viewer"]}),
        ({"functions": ["8/1"]}, {"functions": 8}),
        ({"addresses": "4x1-4x100"}, {"addresses": "4x100-4x101"}),
        ({"addresses": "4x1-4x100"}, {"addresses": "3x1"}),
        ({"table": "holding", "files": "1"}, {"files": "2"}),
        ({"listeners": ["tcp://10.0.0.1:502"]}, {"listeners": ["tcp://"]}),
        ({"peers": ["10.0.0.7"]}, {"peers": ["10.0.0.8"]}),
    ],
)
def test_a_rule_for_other_requests_may_decide(earlier: dict[str, Any], later: dict[str, Any]) -> None:
    assert found(earlier, later) == []


def test_behind_the_rules_that_are_compared_equal_and_whole_ones_are_found() -> None:
    hosts = [{"peers": [f"10.1.{n >> 8}.{n & 255}"], "units": 1} for n in range(COMPARED)]
    behind = [
        {"peers": ["10.1.0.9"], "units": 1, "action": "deny"},  # equal
        {"peers": ["10.2.0.1"]},
        {"peers": ["10.2.0.1"], "units": 3},  # of a client that the rule before takes whole
        {"peers": ["10.1.0.9"], "units": 1, "addresses": "4x1"},  # narrower: it is not looked for
    ]
    assert found(*hosts, *behind) == [(COMPARED, 9), (COMPARED + 2, COMPARED + 1)]


def test_a_hundred_thousand_rules_do_not_take_long() -> None:
    rules = [
        Rule.of(name=f"r{n}", peers=[f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}"], units=1 + n % 200)
        for n in range(100_000)
    ]
    begin = time.process_time()
    assert list(unreached_rules(rules)) == []
    assert time.process_time() - begin < 20
