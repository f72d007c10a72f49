"""Access rules that an earlier rule hides are found; rules that may still decide are not."""

import time
from itertools import product
from typing import Any

import pytest
from examples import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

from busway.access.access_request import FILES, AccessSubject
from busway.access.rule_evaluation import Rights, UnitAccess
from busway.access.rules import Action, Policy, Rule
from busway.access.unreached_rules import COMPARED, unreached_rules
from busway.codes import Table


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


# ---- policies at random: a rule that is reported never decides

LISTENERS = (None, ["tcp://"], ["tls://"], ["tcp://:502"], ["TCP://:502"], ["tcp://10.0.0.1:502"], ["tcp://", "tls://"])
SUBJECTS = [
    AccessSubject(host, role, listener, names)
    for host in ("10.0.0.7", "10.0.0.8", "192.168.0.1", "/dev/ttyUSB0")
    for role in (None, "operator", "viewer")
    for listener, names in (
        ("tcp://0.0.0.0:502", ("tcp://:502",)),
        ("tcp://10.0.0.1:502", ()),
        ("tls://10.0.0.1:802", ()),
        ("rtu:///dev/ttyUSB0", ()),
    )
]
FUNCTIONS = ((3, None), (6, None), (16, None), (20, None), (8, None), (8, 0), (8, 1), (43, 14))
SPACES = (Table.HOLDING_REGISTERS, Table.COILS, FILES, None)
DEVICES = (
    (0, frozenset({0})),
    (1, frozenset({1})),
    (1, frozenset({1, 255})),
    (255, frozenset({255})),
    (0, frozenset()),
)

rules = st.fixed_dictionaries(
    {
        "action": st.sampled_from(["allow", "deny", "read-only"]),
        "access": st.sampled_from(["any", "any", "read", "write"]),
        "peers": st.sampled_from(
            [None, None, ["10.0.0.7"], ["10.0.0.7", "10.0.0.8"], ["10.0.0.8", "10.0.0.7"], ["10.0.0.0/8"]]
        ),
        "roles": st.sampled_from([None, None, ["operator"], ["viewer", "operator"], ["operator", "viewer"]]),
        "listeners": st.sampled_from(LISTENERS),
        "units": st.sampled_from([None, None, "0", "255", "0-255", "1", "1,255", "0-1", [1, 1]]),
        "functions": st.sampled_from([None, None, "write", "read", [3, 6], "8", "8/1", ["8", "8/1"], "43", [6, 3, 3]]),
        "addresses": st.sampled_from(
            [None, None, "4x1-4x4", "4x2-4x3", "4x1-4x2,4x3-4x4", "4x1-4x65536", "0x1", "4x1,0x1", "4x65536"]
        ),
        "files": st.sampled_from([None, None, None, "1", "1-2", "0-65535"]),
    }
)


def deciding(policy: Policy) -> set[str]:
    """The names of the rules that decide about anything that the subjects here can ask."""
    names = set()
    for rules_of_client in {policy.rules_for(subject) for subject in SUBJECTS}:
        rights = Rights(rules_of_client, policy.default)
        for (unit, listed), (code, sub_code), space, writes in product(DEVICES, FUNCTIONS, SPACES, (True, False)):
            zones = rights.zones(UnitAccess(unit, listed, code, sub_code, space, writes))
            names |= {zone.rule_name for zone in zones}
    return names


@given(st.lists(rules, min_size=2, max_size=4), st.data())
@settings(max_examples=examples(60), deadline=None)
@example([{}, {}], None)
@example([{"addresses": "4x1-4x4"}, {"addresses": "4x1-4x2,4x3-4x4", "action": "deny"}], None)
@example([{"listeners": ["tcp://:502"]}, {"listeners": ["TCP://:502"], "action": "deny"}], None)
@example([{"units": "0-255"}, {"units": "0"}, {"units": "255"}], None)
def test_a_rule_that_is_warned_of_decides_nothing_and_an_equal_one_is_found(
    chosen: list[dict[str, Any]], data: st.DataObject | None
) -> None:
    if data is not None:  # the last is equal to an earlier one, but for what it does
        again = data.draw(st.sampled_from(chosen))
        chosen = [*chosen, {**again, "action": "deny"}]
    policy = Policy(tuple(Rule.of(**each) for each in chosen), Action.READ_ONLY)
    unreached = dict(unreached_rules(policy.rules))
    assert data is None or len(chosen) - 1 in unreached
    names = deciding(policy)
    for later, earlier in unreached.items():
        assert earlier < later
        assert policy.rules[later].name not in names
        left = tuple(rule for position, rule in enumerate(policy.rules) if position != later)
        assert deciding(Policy(left, Action.READ_ONLY)) == names  # nor does it matter to the others
