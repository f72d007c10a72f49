"""Rules and policies: which rule decides about which items of a request, and which rules are refused."""

import pytest

from busway.access.access_request import AccessRequest, AccessSubject
from busway.access.rule_evaluation import Rights, UnitAccess, decision_of
from busway.access.rules import DEFAULT_RULE, Action, Limits, Policy, Rule
from busway.codes import Table
from busway.errors import ConfigError
from busway.options.networks import Networks
from busway.pdu.fields import u16
from busway.pdu.functions import STANDARD, FunctionTable
from busway.pdu.message import ReplyMessage, Request, Touch
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)

READ = ReadHoldingRegisters(95, 10)
WRITE = WriteSingleRegister(100, 5)


def decide(policy, request, *, unit=1, **who):
    if isinstance(request, bytes):
        request = STANDARD.decode_request(request)
    return decision_of(policy, AccessRequest.of(request, unit=unit, **who))


def allows(policy, request, **who):
    return decide(policy, request, **who).allowed


def test_without_a_rule_nothing_is_permitted():
    decision = decide(Policy(), READ)
    assert (decision.allowed, decision.code, decision.rule_name) == (False, 1, "default")


@pytest.mark.clause("S17")
@pytest.mark.parametrize(
    ("pdu", "allowed"),
    [
        (b"\x03\x00\x00\x00\x01", True),
        (b"\x18\x00\x00", True),
        (b"\x14\x07\x06\x00\x01\x00\x00\x00\x01", True),
        (b"\x11", True),
        (b"\x2b\x0e\x01\x00", True),
        (b"\x08\x00\x00\x12\x34", True),
        (b"\x08\x00\x0b\x00\x00", True),
        (b"\x06\x00\x00\x00\x01", False),
        (b"\x05\x00\x00\xff\x00", False),
        (b"\x16\x00\x00\xff\xff\x00\x00", False),
        (b"\x17\x00\x00\x00\x01\x00\x00\x00\x01\x02\x00\x01", False),
        (b"\x15\x09\x06\x00\x01\x00\x00\x00\x01\x00\x05", False),
        (b"\x08\x00\x01\x00\x00", False),
        (b"\x08\x00\x03\x0a\x00", False),
        (b"\x08\x00\x04\x00\x00", False),
        (b"\x08\x00\x0a\x00\x00", False),
        (b"\x08\x00\x14\x00\x00", False),
        (b"\x08\x00\x15\x00\x00", False),  # unknown
        (b"\x08\x00", False),  # cut off
        (b"\x2b\x0d\x01", False),  # CANopen
        (b"\x64\x01", False),  # an unknown function
        (b"\x03\x00\x00\x00\x00", True),  # malformed, of a function that reads
        (b"\x06\x00\x00", False),
    ],
)
def test_read_only_permits_what_reads_and_nothing_that_writes_or_is_not_known(pdu, allowed):
    assert allows(Policy.read_only(), pdu) is allowed


def test_a_users_function_is_a_write_unless_it_says_what_it_reads():
    class Silent(Request):
        code = 100
        value: int = u16()

        class Reply(ReplyMessage):
            value: int = u16()

    class Reader(Request):
        code = 101
        reads = Touch(Table.HOLDING_REGISTERS)
        address: int = u16()
        count: int = u16()

        class Reply(ReplyMessage):
            value: int = u16()

    functions = FunctionTable(Silent, Reader)
    assert not allows(Policy.read_only(), functions.decode_request(b"\x64\x00\x01"))
    assert allows(Policy.read_only(), functions.decode_request(b"\x65\x00\x01\x00\x01"))
    assert allows(Policy.of(Rule.of(functions=100)), functions.decode_request(b"\x64\x00\x01"))


def test_a_malformed_request_of_a_users_function_that_reads_and_writes_is_a_write():
    """A gateway forwards it, so that a device could execute it."""

    class Doubling(Request):
        """68: reads a register that it names, and writes one that it does not."""

        code = 0x44
        is_write = True
        reads = Touch(Table.HOLDING_REGISTERS, count=None)
        address: int = u16()

        class Reply(ReplyMessage):
            value: int = u16()

    functions = FunctionTable(Doubling)
    whole, cut_off = functions.decode_request(b"\x44\x00\x05"), functions.decode_request(b"\x44\x00")
    assert not allows(Policy.read_only(), whole)
    assert not allows(Policy.read_only(), cut_off)
    assert allows(Policy.allow_all(), cut_off)


def test_a_range_that_straddles_rules_is_judged_part_by_part():
    policy = Policy.of(Rule.of(name="gap", action="deny", table="holding", addresses="100-109"), default="allow")
    assert decide(policy, READ).rule_name == "gap"
    assert allows(policy, ReadHoldingRegisters(90, 10))
    assert allows(policy, ReadHoldingRegisters(110, 10))
    assert not allows(policy, ReadHoldingRegisters(0, 125))
    assert allows(policy, ReadCoils(0, 1000))


def test_parts_may_be_permitted_by_different_rules():
    policy = Policy.of(Rule.of(addresses="holding:0-9"), Rule.of(addresses="holding:10-19", access="read"))
    assert allows(policy, ReadHoldingRegisters(5, 10))
    assert not allows(policy, ReadHoldingRegisters(15, 6))
    assert not allows(policy, WriteMultipleRegisters.of(5, [0] * 10))


def test_the_first_rule_that_fits_decides():
    policy = Policy.of(Rule.of(action="deny", units=2), Rule.of(units="1-3"), Rule.of(action="deny"), default="allow")
    assert [allows(policy, READ, unit=unit) for unit in (1, 2, 3, 4)] == [True, False, True, False]


def test_both_halves_of_function_23_have_to_be_permitted():
    policy = Policy.of(
        Rule.of(addresses="holding:0-9", access="write"), Rule.of(addresses="holding:20-29", access="read")
    )
    assert allows(policy, ReadWriteMultipleRegisters.of(20, 5, 0, [1]))
    assert not allows(policy, ReadWriteMultipleRegisters.of(0, 5, 0, [1]))
    assert not allows(policy, ReadWriteMultipleRegisters.of(20, 5, 20, [1]))


@pytest.mark.clause("M6")
def test_peers_roles_and_listeners():
    policy = Policy.of(
        Rule.of(name="role", roles=["operator"]),
        Rule.of(name="peer", peers=["10.0.0.0/8"], access="read"),
        Rule.of(name="way", listeners=["tls://", "tcp://127.0.0.1:5020"], functions="read"),
    )
    assert decide(policy, WRITE, role="operator").rule_name == "role"
    assert not allows(policy, WRITE, role="Operator")
    assert decide(policy, READ, peer="10.1.2.3:77").rule_name == "peer"
    assert not allows(policy, WRITE, peer="10.1.2.3:77")
    assert decide(policy, READ, listener="tls://0.0.0.0:802").rule_name == "way"
    assert decide(policy, READ, listener="tcp://127.0.0.1:5020").rule_name == "way"
    assert not allows(policy, READ, listener="tcp://127.0.0.1:502")


def test_a_rule_of_items_does_not_fit_what_touches_none():
    policy = Policy.of(Rule.of(action="deny", table="holding"), default="allow")
    assert allows(policy, b"\x11")
    assert not allows(policy, b"\x18\x00\x00")
    assert allows(policy, b"\x14\x07\x06\x00\x01\x00\x00\x00\x01")


def test_files_by_number():
    policy = Policy.of(Rule.of(files="1-3", access="read"), Rule.of(files=3))
    assert allows(policy, b"\x14\x07\x06\x00\x01\x00\x00\x00\x01")
    assert not allows(policy, b"\x14\x07\x06\x00\x04\x00\x00\x00\x01")
    assert not allows(policy, b"\x14\x0e\x06\x00\x01\x00\x00\x00\x01\x06\x00\x04\x00\x00\x00\x01")
    assert allows(policy, b"\x15\x09\x06\x00\x03\x00\x00\x00\x01\x00\x05")
    assert not allows(policy, b"\x15\x09\x06\x00\x01\x00\x00\x00\x01\x00\x05")


def test_sub_functions():
    policy = Policy.of(Rule.of(functions=["8/1", "43/14"]))
    assert allows(policy, b"\x08\x00\x01\x00\x00")
    assert not allows(policy, b"\x08\x00\x0a\x00\x00")
    assert allows(policy, b"\x2b\x0e\x01\x00")
    assert not allows(policy, b"\x2b\x0d\x01")


def test_items_beyond_the_table_are_in_no_range_so_that_no_window_reaches_around_its_end():
    policy = Policy.of(Rule.of(addresses="holding:65000-65535"))
    assert allows(policy, b"\x03\xff\xff\x00\x01")
    assert not allows(policy, b"\x03\xff\xff\x00\x02")
    assert allows(Policy.of(Rule.of(table="holding")), b"\x03\xff\xff\x00\x02")


def test_a_malformed_request_is_permitted_only_where_its_whole_table_is():
    malformed = b"\x03\x00\x05\x00\x00"
    assert not allows(Policy.of(Rule.of(addresses="holding:0-9")), malformed)
    assert allows(Policy.of(Rule.of(table="holding")), malformed)


@pytest.mark.parametrize(
    ("request_", "allowed"),
    [
        (WriteSingleRegister(5, 20), True),
        (WriteSingleRegister(5, 21), False),
        (WriteSingleRegister(5, 9), False),
        (WriteSingleRegister(10, 21), True),
        (WriteMultipleRegisters.of(8, [20, 20, 99]), True),
        (WriteMultipleRegisters.of(8, [20, 21, 99]), False),
        (ReadWriteMultipleRegisters.of(0, 5, 9, [10, 500]), True),
        (ReadWriteMultipleRegisters.of(0, 5, 9, [500, 10]), False),
        (MaskWriteRegister(5, 0, 15), True),
        (MaskWriteRegister(5, 0xFFFF, 0), False),
        (MaskWriteRegister(5, 0x0003, 0x0010), True),
        (ReadHoldingRegisters(0, 20), True),
        (WriteSingleCoil(5, 0xFF00), True),
        (STANDARD.decode_request(b"\x06\x00\x05"), False),
    ],
)
def test_what_may_be_written_to_each_register(request_, allowed):
    policy = Policy.of(Rule.of(name="limits", addresses="holding:0-9", values=(10, 20)), default="allow")
    assert allows(policy, request_) is allowed


@pytest.mark.parametrize(
    ("masks", "allowed"),
    [
        ((0, 0xFFFB), True),
        ((0, 0xFFFA), False),
        ((0x8000, 3), False),
        ((0, 5), True),
        ((0, 6), False),
        ((3, 0xFFFC), True),
    ],
)
def test_masks_under_limits_with_a_sign(masks, allowed):
    policy = Policy.of(Rule.of(values=(-5, 5), signed=True))
    assert allows(policy, MaskWriteRegister(5, *masks)) is allowed


@pytest.mark.parametrize("limits", [Limits(10, 20), Limits(-3, 3, True), Limits(0, 0xFFFF), Limits(0x7F00, 0x8100)])
def test_masks_that_are_permitted_can_give_nothing_outside(limits):
    for and_mask in (0, 1, 0x8000, 0x8001, 0xFF, 0xFFFF):
        for or_mask in (0, 1, 10, 0x12, 0x7FFF, 0x8000, 0xFFFF):
            free = [bit for bit in range(16) if and_mask >> bit & 1]
            outcomes = set()
            for pattern in range(1 << min(len(free), 8)):
                current = sum(1 << free[-1 - at] for at in range(min(len(free), 8)) if pattern >> at & 1)
                outcomes.add(current & and_mask | or_mask & ~and_mask & 0xFFFF)
            if limits.permit_masks(and_mask, or_mask):
                assert all(limits.permit(one) for one in outcomes)


def test_a_mask_write_asks_again_when_the_register_is_known():
    policy = Policy.of(Rule.of(values=(0, 20)))
    access_request = AccessRequest.of(MaskWriteRegister(5, 0x00FF, 0), unit=1)
    assert decision_of(policy, access_request).needs_current
    assert decision_of(policy, access_request.with_current(20)).allowed
    assert not decision_of(policy, access_request.with_current(21)).allowed


def test_the_code_of_a_refusal():
    policy = Policy.of(Rule.of(action="deny", addresses="4x1", code=2), Rule.of(action="deny"))
    assert decide(policy, ReadHoldingRegisters(0, 1)).code == 2
    assert decide(policy, ReadHoldingRegisters(1, 1)).code == 1


def test_the_rates_that_a_request_passes_are_told():
    policy = Policy.of(Rule.of(name="slow", addresses="4x1-4x10", rate=2), default="allow")
    assert [rule.name for rule in decide(policy, ReadHoldingRegisters(5, 10)).rates] == ["slow"]
    assert decide(policy, ReadHoldingRegisters(10, 10)).rates == ()


def test_clients_with_the_same_rules_have_the_same_rights():
    policy = Policy.of(Rule.of(name="a", peers=["10.0.0.0/8"]), Rule.of(name="b", roles=["op"]), Rule.of(name="c"))
    assert policy.rules_for(AccessSubject("10.0.0.1")) == policy.rules_for(AccessSubject("10.9.9.9"))
    assert [rule.name for rule in policy.rules_for(AccessSubject("11.0.0.1", "op"))] == ["b", "c"]


def test_rules_without_a_name_are_called_by_their_number():
    policy = Policy.of(Rule.of(), Rule.of(name="mine"), Rule.of())
    assert [rule.name for rule in policy.rules] == ["rule 1", "mine", "rule 3"]


@pytest.mark.parametrize("names", [("a", "a"), ("default",), ("", "rule 1")])
def test_a_name_is_given_once(names):
    with pytest.raises(ConfigError, match="is taken"):
        Policy.of(*(Rule.of(name=name) for name in names))


@pytest.mark.parametrize(
    ("fields", "key"),
    [
        ({"action": "maybe"}, "action"),
        ({"access": "both"}, "access"),
        ({"peers": ["10.0.0.1/8"]}, "peers"),
        ({"peers": []}, "peers"),
        ({"peers": Networks()}, "peers"),
        ({"roles": []}, "roles"),
        ({"roles": "operator"}, "roles"),
        ({"roles": [""]}, "roles"),
        ({"listeners": []}, "listeners"),
        ({"listeners": ["nonsense"]}, "listeners"),
        ({"listeners": ["ftp://"]}, "listeners"),
        ({"units": 256}, "units"),
        ({"units": []}, "units"),
        ({"functions": "raed"}, "functions"),
        ({"functions": []}, "functions"),
        ({"table": "holdings_"}, "table"),
        ({"table": []}, "table"),
        ({"table": ["holding", "coil"], "addresses": "1-5"}, "addresses"),
        ({"addresses": "1-5"}, "addresses"),
        ({"addresses": []}, "addresses"),
        ({"files": "x"}, "files"),
        ({"files": []}, "files"),
        ({"values": (5, 1)}, "values"),
        ({"values": "1-5"}, "values"),
        ({"values": [1, 5]}, "values"),
        ({"values": (1,)}, "values"),
        ({"values": (1, 5, True)}, "values"),
        ({"values": (-1, 1)}, "values"),
        ({"values": (0, 40000), "signed": True}, "values"),
        ({"values": (0, 1), "action": "deny"}, "values"),
        ({"values": (0, 1), "access": "read"}, "values"),
        ({"values": (0, 1), "table": "coil"}, "values"),
        ({"rate": 0}, "rate"),
        ({"rate": True}, "rate"),
        ({"rate": 1, "action": "deny"}, "rate"),
        ({"code": 3}, "code"),
        ({"code": 2}, "code"),
        ({"code": 2, "table": "holding", "roles": ["a"]}, "code"),
    ],
)
def test_a_rule_that_cannot_be_names_what_is_wrong(fields, key):
    with pytest.raises(ConfigError) as caught:
        Rule.of(**fields)
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("fields", "key"),
    [
        ({"action": "deny"}, "action"),
        ({"access": "write"}, "access"),
        ({"peers": ["10.0.0.7"]}, "peers"),
        ({"peers": Networks()}, "peers"),
        ({"roles": "operator"}, "roles"),
        ({"roles": frozenset({7})}, "roles"),
        ({"roles": frozenset()}, "roles"),
        ({"listeners": "tcp://"}, "listeners"),
        ({"listeners": ("TCP://",)}, "listeners"),
        ({"listeners": ("",)}, "listeners"),
        ({"units": 1}, "units"),
        ({"units": [1]}, "units"),
        ({"units": frozenset({256})}, "units"),
        ({"units": frozenset()}, "units"),
        ({"functions": frozenset({3, 6})}, "functions"),
        ({"functions": frozenset({"write"})}, "functions"),
        ({"functions": frozenset()}, "functions"),
        ({"items": {"holding": ((0, 10),)}}, "items"),
        ({"items": {Table.COILS: ()}}, "items"),
        ({"items": {Table.COILS: [(0, 10)]}}, "items"),
        ({"items": {Table.COILS: ((10, 0),)}}, "items"),
        ({"items": {Table.COILS: ((5, 5),)}}, "items"),
        ({"action": Action.ALLOW, "limits": (0, 5)}, "values"),
        ({"files": "1"}, "files"),
        ({"files": (1,)}, "files"),
        ({"files": ((2, 2),)}, "files"),
    ],
)
def test_a_rule_with_a_field_of_another_type_or_an_empty_one_cannot_be_so_that_a_denial_fits_what_it_says(fields, key):
    with pytest.raises(ConfigError) as caught:
        Rule(**{"action": Action.DENY, **fields})
    assert caught.value.key == key


def test_a_policy_with_a_word_as_default_cannot_be():
    with pytest.raises(ConfigError, match=r"default: must be an Action, not 'allow'; Policy\.of takes texts"):
        Policy((), "allow")


def test_defaults_by_word():
    assert Policy.of(default="read-only") == Policy.read_only()
    assert Policy.allow_all().default is Action.ALLOW
    with pytest.raises(ConfigError):
        Policy.of(default="perhaps")


@pytest.mark.parametrize("limits", [Limits(10, 20), Limits(-3, 3, True), Limits(0, 0xFFFF), Limits(-0x8000, -1, True)])
@pytest.mark.parametrize("registers", [(0,), (10, 20), (10, 21), (9,), (0xFFFD, 3, 0), (0xFFFC,), (0x8000, 0x7FFF)])
def test_registers_on_the_wire_are_judged_as_one_by_one(limits, registers):
    wire = WriteMultipleRegisters.of(0, registers).data
    assert limits.permit_all(wire) == all(limits.permit(register) for register in registers)


def writable(policy, unit, function, table, listed=frozenset()):
    """Where a function may write: first, end, rule and limits of each zone."""
    rights = Rights(policy.rules, policy.default)
    zones = rights.permitted(UnitAccess(unit, listed, function, None, table, True))
    return [(zone.first, zone.end, zone.rule_name, zone.limits) for zone in zones]


def test_the_zones_of_writes_say_which_rule_decides_where():
    small = Limits(0, 9)
    policy = Policy.of(
        Rule.of(name="low", addresses="holding:10-19", values=small),
        Rule.of(name="shut", action="deny", addresses="holding:15-24"),
        Rule.of(name="slow", addresses="holding:25-26", rate=1),
        Rule.of(name="rest", addresses="holding:0-29"),
        default="read-only",
    )
    assert writable(policy, 1, 6, Table.HOLDING_REGISTERS) == [
        (0, 10, "rest", None),
        (10, 20, "low", small),
        (27, 30, "rest", None),
    ]
    assert writable(policy, 1, 5, Table.COILS) == []
    assert writable(Policy.read_only(), 1, 6, Table.HOLDING_REGISTERS) == []
    ((first, _, rule, limits),) = writable(Policy.allow_all(), 1, 5, Table.COILS)
    assert (first, rule, limits) == (0, DEFAULT_RULE, None)


def test_the_zones_of_a_unit_are_those_of_the_unit_that_its_device_is_listed_as_too():
    policy = Policy.of(Rule.of(name="shut", action="deny", units=3), default="allow")
    assert writable(policy, 255, 6, Table.HOLDING_REGISTERS, listed=frozenset({3})) == []
    assert len(writable(policy, 255, 6, Table.HOLDING_REGISTERS)) == 1
    assert writable(Policy.of(Rule.of(values=(1, 2))), 1, 5, Table.COILS)[0][3] is None


@pytest.mark.parametrize("writes", [False, True])
def test_zones_cover_every_address_once_and_each_by_the_first_rule_that_fits(writes):
    policy = Policy.of(
        Rule.of(name="a", addresses="holding:5-9", access="write"),
        Rule.of(name="b", addresses=["holding:3-6", "holding:9-12", "holding:20"]),
        Rule.of(name="c", action="deny", addresses="holding:0-14"),
        Rule.of(name="d", units=2),
        default="read-only",
    )
    rights = Rights(policy.rules, policy.default)
    zones = rights.zones(UnitAccess(1, frozenset(), 3, None, Table.HOLDING_REGISTERS, writes))
    assert [zone.first for zone in zones] == [0, *(zone.end for zone in zones[:-1])]
    for address in range(30):
        (name,) = {zone.rule_name for zone in zones if zone.first <= address < zone.end}
        fitting = [
            rule
            for rule in policy.rules
            if rule.units is None
            and rule.access.fits(writes)
            and any(low <= address < high for low, high in rule.ranges(Table.HOLDING_REGISTERS))
        ]
        assert name == (fitting[0].name if fitting else DEFAULT_RULE)
