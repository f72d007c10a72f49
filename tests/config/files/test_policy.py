"""Policy files: what they declare, and every way in which one can be wrong, with file, line and key."""

import random

import pytest
from damaged_texts import after_accidents

from busway.access.access_request import AccessRequest
from busway.access.rule_evaluation import decision_of
from busway.access.rules import AccessKind, Action, Limits, Policy
from busway.codes import Table
from busway.config.files.file_error import FileError
from busway.config.files.policy import PolicySection, parse_policy_file
from busway.config.files.section import Section
from busway.config.files.toml_source import parse_file
from busway.errors import ConfigError
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister

GOOD = """\
[policy]
default = "deny"
allow = ["10.0.0.0/8", "fe80::/10"]
deny = ["10.6.6.6"]

[[policy.rule]]
name = "setpoints"
peers = ["10.1.0.0/16"]
roles = ["operator", "engineer"]
listeners = ["tls://"]
units = "1-5,7"
functions = ["read", 16, "write_registers"]
table = "holding"
addresses = "100-199"
values = { min = -5, max = 1000, signed = true }
rate = 20
access = "write"

[[policy.rule]]
action = "deny"
addresses = ["4x1-4x10", "0x1"]
files = 3
code = 2

[[policy.rule]]
name = "all clients"
action = "read-only"
units = [1, "3-4"]
values_of_nothing = 1
"""
GOOD = GOOD.replace("values_of_nothing = 1\n", "")
MUTATIONS = 150


def problems_of(text):
    with pytest.raises(FileError) as caught:
        parse_policy_file(text, "x.toml")
    return str(caught.value).splitlines()


def test_a_good_file_says_what_it_declares():
    found = parse_policy_file(GOOD, "x.toml")
    assert found.policy.default is Action.DENY
    assert found.addresses("10.0.0.7")
    assert not found.addresses("10.6.6.6")
    assert not found.addresses("11.0.0.1")
    first, second, third = found.policy.rules
    assert (first.name, first.access, first.rate) == ("setpoints", AccessKind.WRITE, 20)
    assert first.limits == Limits(-5, 1000, True)
    assert first.items == {Table.HOLDING_REGISTERS: ((100, 200),)}
    assert first.roles == {"operator", "engineer"}
    assert (second.name, second.code, second.files) == ("rule 2", 2, ((3, 4),))
    assert (third.action, third.units) == (Action.READ_ONLY, {1, 3, 4})


@pytest.mark.parametrize("word", ["allow", "deny", "read-only"])
def test_a_policy_in_one_word(word):
    found = parse_policy_file(f'policy = "{word}"', "x.toml")
    assert found.policy == Policy.of(default=word)
    assert found.addresses("203.0.113.9")
    access_request = AccessRequest.of(WriteSingleRegister(0, 1), unit=1)
    assert decision_of(found.policy, access_request).allowed == (word == "allow")
    assert decision_of(found.policy, AccessRequest.of(ReadHoldingRegisters(0, 1), unit=1)).allowed == (word != "deny")


HEAD = '[policy]\ndefault = "deny"\n'
RULE = HEAD + "[[policy.rule]]\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "x.toml:1: policy: is missing"),
        ('policy = "perhaps"', "x.toml:1: policy.default: must be 'allow', 'deny' or 'read-only', not 'perhaps'"),
        ("policy = 7", "x.toml:1: policy: must be a table, not 7"),
        ("[policy]\nsecure = true", "x.toml:1: policy.default: is missing"),
        (HEAD + "x = 1", "x.toml:3: policy.x: unknown key"),
        (HEAD + 'secure = "yes"', "x.toml:3: policy.secure: must be true or false"),
        (HEAD + 'allow = "10.0.0.1"', "x.toml:3: policy.allow: must be a list"),
        (HEAD + 'allow = ["10.0.0.1/8"]', "x.toml:3: policy.allow: '10.0.0.1/8' has bits set"),
        (HEAD + 'deny = ["host"]', "x.toml:3: policy.deny: 'host' is no address"),
        (HEAD + "allow = []", "x.toml:3: policy.allow: is empty: leave it out for all hosts"),
        (RULE + 'peers = ["host"]', "x.toml:4: policy.rule[0].peers: 'host' is no address"),
        (RULE + "rols = []", "x.toml:4: policy.rule[0].rols: unknown key; is it roles?"),
        (RULE + "roles = []", "x.toml:4: policy.rule[0].roles: is empty"),
        (RULE + "files = []", "x.toml:4: policy.rule[0].files: is empty"),
        (RULE + 'units = "1-999"', "x.toml:4: policy.rule[0].units: a unit is 0…255, not 999"),
        (RULE + "units = 1.5", "x.toml:4: policy.rule[0].units: must be a number, a text such as '1-5', or a list"),
        (RULE + "functions = [true]", "x.toml:4: policy.rule[0].functions: must be a number"),
        (RULE + "table = 4", "x.toml:4: policy.rule[0].table: must be a list, not 4"),
        (RULE + 'functions = "raed"', "x.toml:4: policy.rule[0].functions: there is no function 'raed'"),
        (RULE + 'table = "x"', "x.toml:4: policy.rule[0].table: there is no table 'x'"),
        (RULE + 'addresses = "1-5"', "x.toml:4: policy.rule[0].addresses: address '1' does not say which table"),
        (RULE + 'listeners = ["x"]', "x.toml:4: policy.rule[0].listeners: 'x' is no endpoint"),
        (RULE + "values = { min = 5, max = 1 }", "x.toml:4: policy.rule[0].values: nothing is between 5 and 1"),
        (RULE + "values = { least = 5 }", "x.toml:4: policy.rule[0].values.least: unknown key"),
        (RULE + 'action = "deny"\nrate = 5', "x.toml:5: policy.rule[0].rate: a rule that denies"),
        (RULE + "code = 2", "x.toml:4: policy.rule[0].code: 2 is for rules that name"),
        (RULE + "code = 3", "x.toml:4: policy.rule[0].code: must be 1 or 2, not 3"),
        (RULE + 'name = "a"\n[[policy.rule]]\nname = "a"', "x.toml:6: policy.rule[1].name: rule 1 has the same name"),
        (RULE + 'name = "default"', "x.toml:3: policy.rule: the name 'default' is taken"),
    ],
)
def test_what_is_wrong_is_said_with_its_line_and_key(text, problem):
    (said,) = problems_of(text)
    assert said.startswith(problem)


def test_all_that_is_wrong_is_said_at_once():
    said = problems_of(HEAD + "x = 1\n[[policy.rule]]\nunits = 999\n[[policy.rule]]\nfunctions = 999\n")
    assert [line.split(":")[1] for line in said] == ["3", "5", "7"]


def test_a_policy_is_a_part_of_other_files():
    class Whole(Section):
        policy: PolicySection
        other: int

    found = parse_file('other = 1\npolicy = "read-only"', Whole, "x.toml")
    assert found.policy.policy() == Policy.read_only()
    with pytest.raises(FileError, match=r"x.toml:2: policy.rule\[0\].units"):
        parse_file("policy.default = 'deny'\npolicy.rule = [{ units = 999 }]\nother = 1", Whole, "x.toml")


def test_files_after_accidents_are_read_or_refused_with_a_line():
    random_source = random.Random(20)
    refused = []
    for _ in range(MUTATIONS):
        try:
            parse_policy_file(after_accidents(GOOD, random_source), "x.toml")
        except ConfigError as error:
            refused.append(str(error))
    assert len(refused) > MUTATIONS / 2
    assert all(said.startswith("x.toml:") for said in refused)
