"""Policies and requests at random: fast path, prepared answers and generic path permit what a plain reading of the
rules permits, item by item, and what is denied never reaches a store.
"""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from authorizing import AuthorizedPipeline
from examples import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

from busway.access.audit_log import AuditLog
from busway.access.rules import AccessKind, Action, Limits, Policy, Rule
from busway.codes import Table
from busway.errors import ConfigError
from busway.pdu.device_interface import Refusal
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.file_records import ReadFileRecord, WriteFileRecord
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import Message
from busway.pdu.unknown_functions import OpaqueRequest
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleRegisters,
    WriteSingleRegister,
)
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState, LineDiagnostics
from busway.session.responder import ClientIdentity, RequestContext
from busway.session.server_pipeline import NO_FAST_PATH, FastPath
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

ITEMS = 40
PEERS = (("10.0.0.7:5000", None), ("10.0.0.7:5001", "op"), ("[fe80::9]:5002", None), ("192.168.1.1:9", "guest"))
NOTABLE = (*range(ITEMS + 30), 65_535, 65_536, 70_000)
"""Items that tell all ranges in these tests apart."""

Item = tuple[Any, int, bool]
"""Space (a table, "files" or None), number, and whether it is written."""


class SpiedBlock:
    """A block that notes who touches it."""

    def __init__(self, block: Any, touched: list[str]) -> None:
        self._block = block
        self._touched = touched
        self.first = block.first
        self.count = block.count

    @property
    def data(self) -> bytearray:
        self._touched.append("data")
        return self._block.data

    def put(self, position: int, count: int, data: bytes) -> None:
        self._touched.append("put")
        self._block.put(position, count, data)

    def exchange(self, position: int, count: int, data: bytes) -> bytes:
        self._touched.append("exchange")
        return self._block.exchange(position, count, data)


class SpiedDevice(Device):
    """A device that notes every access to what it holds."""

    def __init__(self, **tables: Any) -> None:
        super().__init__(**tables)
        self.touched: list[str] = []

    def plain_block(self, table: Table, *, writes: bool) -> Any:
        block = super().plain_block(table, writes=writes)
        return None if block is None else SpiedBlock(block, self.touched)

    def read(self, *arguments: Any, **options: Any) -> Any:
        self.touched.append("read")
        return super().read(*arguments, **options)

    def write(self, *arguments: Any, **options: Any) -> None:
        self.touched.append("write")
        super().write(*arguments, **options)

    def read_file(self, *arguments: Any, **options: Any) -> bytes:
        self.touched.append("read_file")
        return super().read_file(*arguments, **options)

    def write_file(self, *arguments: Any, **options: Any) -> None:
        self.touched.append("write_file")
        super().write_file(*arguments, **options)

    def read_fifo(self, *arguments: Any, **options: Any) -> bytes:
        self.touched.append("read_fifo")
        return super().read_fifo(*arguments, **options)


def device(items: int) -> SpiedDevice:
    return SpiedDevice(
        holding_registers=[7 * number & 0xFFFF for number in range(items)],
        input_registers=list(range(items)),
        coils=[number % 3 == 0 for number in range(items)],
        discrete_inputs=items,
        files={1: [1, 2, 3], 2: [4, 5, 6]},
        fifos={5: [1, 2]},
    )


def contents(one: Device) -> list[Any]:
    tables = [list(one.holding_registers), list(one.coils)]
    return [*tables, *(file[0:3] for file in one.files.values())]


# ---- policies and requests at random

ranges = st.tuples(st.integers(0, ITEMS + 5), st.integers(1, 12)).map(lambda one: ((one[0], one[0] + one[1]),))
tables = st.sampled_from(list(Table))
limits = st.one_of(
    st.tuples(st.integers(0, 300), st.integers(0, 300)).map(lambda both: Limits(min(both), max(both))),
    st.tuples(st.integers(-300, 300), st.integers(-300, 300)).map(lambda both: Limits(min(both), max(both), True)),
)
functions = st.frozensets(
    st.one_of(
        st.tuples(st.sampled_from([1, 2, 3, 4, 5, 6, 15, 16, 20, 21, 22, 23, 24, 8, 43, 100]), st.none()),
        st.tuples(st.just(8), st.integers(0, 4)),
    ),
    min_size=1,
    max_size=8,
)


@st.composite
def rules(draw: st.DrawFn) -> Rule:
    fields: dict[str, Any] = {
        "action": draw(st.sampled_from(list(Action))),
        "access": draw(st.sampled_from(list(AccessKind))),
        "roles": draw(st.sampled_from([None, None, frozenset({"op"}), frozenset({"op", "guest"})])),
        "units": draw(st.sampled_from([None, None, frozenset({1}), frozenset({2, 3})])),
        "functions": draw(st.one_of(st.none(), functions)),
        "items": draw(st.dictionaries(tables, ranges, max_size=2)),
        "files": draw(st.sampled_from([(), (), ((1, 2),)])),
        "code": draw(st.sampled_from([1, 1, 2])),
    }
    peers = draw(st.sampled_from([None, None, ["10.0.0.0/8"], ["fe80::/16", "192.168.0.0/16"]]))
    for left_out in ((), ("limits",), ("limits", "code")):
        given_fields = {**fields, "limits": draw(st.one_of(st.none(), limits))}
        for name in left_out:
            given_fields.pop(name, None)
        try:
            Rule(**given_fields)
        except ConfigError:
            continue
        base = Rule.of(peers=peers)
        return Rule(**given_fields, peers=base.peers)
    raise AssertionError("a rule without limits and code can always be")


ranges_only = st.builds(
    lambda action, table, found: Rule(action=action, items={table: found}),
    st.sampled_from(list(Action)),
    st.sampled_from([Table.HOLDING_REGISTERS, Table.COILS]),
    ranges,
)
"""Rules that leave windows on the fast path."""

policies = st.builds(
    lambda found, default: Policy(tuple(found), default),
    st.one_of(st.lists(rules(), max_size=5), st.lists(ranges_only, min_size=1, max_size=3)),
    st.sampled_from(list(Action)),
)


def _registers(values: Sequence[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


addresses = st.integers(0, ITEMS + 4)
counts = st.integers(1, 12)
values = st.one_of(st.integers(0, 400), st.integers(0xFF00, 0xFFFF))
pdus = st.one_of(
    st.builds(struct.pack, st.just(">BHH"), st.integers(1, 4), addresses, counts),
    st.builds(struct.pack, st.just(">BHH"), st.integers(1, 4), st.integers(65_520, 65_535), counts),
    st.builds(struct.pack, st.just(">BHH"), st.just(5), addresses, st.sampled_from([0, 0xFF00, 1])),
    st.builds(struct.pack, st.just(">BHH"), st.just(6), addresses, values),
    st.builds(struct.pack, st.just(">BHHH"), st.just(22), addresses, values, values),
    st.builds(struct.pack, st.just(">BH"), st.just(24), addresses),
    st.builds(
        lambda address, written: (
            struct.pack(">BHHB", 16, address, len(written), 2 * len(written)) + _registers(written)
        ),
        addresses,
        st.lists(values, min_size=1, max_size=6),
    ),
    st.builds(
        lambda address, count, data: struct.pack(">BHHBH", 15, address, count, 2, data),
        addresses,
        st.integers(9, 16),
        values,
    ),
    st.builds(
        lambda read, count, address, written: (
            struct.pack(">BHHHHB", 23, read, count, address, len(written), 2 * len(written)) + _registers(written)
        ),
        addresses,
        counts,
        addresses,
        st.lists(values, min_size=1, max_size=4),
    ),
    st.builds(
        lambda groups: (
            struct.pack(">BB", 20, 7 * len(groups)) + b"".join(struct.pack(">BHHH", 6, *group) for group in groups)
        ),
        st.lists(st.tuples(st.integers(1, 3), st.integers(0, 3), st.integers(1, 2)), min_size=1, max_size=3),
    ),
    st.builds(
        lambda groups: (
            struct.pack(">BB", 21, 9 * len(groups)) + b"".join(struct.pack(">BHHHH", 6, *group) for group in groups)
        ),
        st.lists(st.tuples(st.integers(1, 3), st.integers(0, 2), st.just(1), values), min_size=1, max_size=3),
    ),
    st.builds(struct.pack, st.just(">BHH"), st.just(8), st.sampled_from([0, 2, 10, 11, 77]), st.just(0)),
    st.just(b"\x2b\x0e\x01\x00"),
    st.sampled_from([b"\x2b", b"\x2b\x0d\x01", b"\x08\x00", b"\x11", b"\x64\x01\x02", b"\x07"]),
    st.binary(min_size=1, max_size=9).filter(
        lambda pdu: 1 <= pdu[0] <= 127 and pdu[:3] not in (b"\x08\x00\x04", b"\x08\x00\x01")
    ),
)


# ---- a plain reading of the rules, item by item

TABLE_OF = {1: Table.COILS, 2: Table.DISCRETE_INPUTS, 3: Table.HOLDING_REGISTERS, 4: Table.INPUT_REGISTERS}
READS = {1, 2, 3, 4, 20, 23, 24, 22}
WRITES = {5: Table.COILS, 15: Table.COILS, 6: Table.HOLDING_REGISTERS, 16: Table.HOLDING_REGISTERS}
CHANGES = {1, 3, 4, 10, 20}


def items_of(request: AnyRequest, pdu: bytes) -> list[Item]:
    code = pdu[0]
    if isinstance(request, OpaqueRequest):
        return [(None, 0, True)]
    if isinstance(request, MalformedRequest):
        if code in (20, 21):
            return [("files", number, code == 21) for number in NOTABLE]
        if code in TABLE_OF:
            return [(TABLE_OF[code], number, False) for number in NOTABLE]
        if code in WRITES:
            return [(WRITES[code], number, True) for number in NOTABLE]
        if code == 24:
            return [(Table.HOLDING_REGISTERS, number, False) for number in NOTABLE]
        if code in (22, 23):
            return [(Table.HOLDING_REGISTERS, number, writes) for writes in (True, False) for number in NOTABLE]
        if code == 8:
            cut_off = len(pdu) < 3
            return [(None, 0, cut_off or int.from_bytes(pdu[1:3], "big") in CHANGES)]
        if code == 43:
            return [(None, 0, len(pdu) < 2 or pdu[1] == 13)]
        return [(None, 0, False)]
    word = [int.from_bytes(pdu[at : at + 2], "big") for at in range(1, len(pdu) - 1, 2)]
    if code in TABLE_OF:
        return [(TABLE_OF[code], word[0] + number, False) for number in range(word[1])]
    if code in (5, 6):
        return [(WRITES[code], word[0], True)]
    if code in (15, 16):
        return [(WRITES[code], word[0] + number, True) for number in range(word[1])]
    if code == 24:
        return [(Table.HOLDING_REGISTERS, word[0], False)]
    if code == 22:
        return [(Table.HOLDING_REGISTERS, word[0], writes) for writes in (True, False)]
    if code == 23:
        return [(Table.HOLDING_REGISTERS, word[2] + number, True) for number in range(word[3])] + [
            (Table.HOLDING_REGISTERS, word[0] + number, False) for number in range(word[1])
        ]
    if isinstance(request, ReadFileRecord | WriteFileRecord):
        return [("files", group.file, code == 21) for group in request.groups]
    if code == 8:
        return [(None, 0, word[0] in CHANGES)]
    return [(None, 0, code == 43 and pdu[1] == 13)]


def fits(rule: Rule, item: Item, who: tuple[str, str | None], unit: int, pdu: bytes) -> bool:
    space, number, writes = item
    host = who[0].rpartition(":")[0].strip("[]")
    sub_code = None
    if pdu[0] == 8 and len(pdu) >= 3:
        sub_code = int.from_bytes(pdu[1:3], "big")
    if pdu[0] == 43 and len(pdu) >= 2:
        sub_code = pdu[1]
    return (
        (rule.peers is None or host in rule.peers)
        and (rule.roles is None or who[1] in rule.roles)
        and (rule.units is None or unit in rule.units)
        and (rule.functions is None or bool({(pdu[0], None), (pdu[0], sub_code)} & rule.functions))
        and (rule.access is AccessKind.ANY or (rule.access is AccessKind.WRITE) == writes)
        and (
            (not rule.items and not rule.files)
            or (isinstance(space, Table) and any(low <= number < high for low, high in rule.items.get(space, ())))
            or (space == "files" and any(low <= number < high for low, high in rule.files))
        )
    )


def plainly(
    policy: Policy, request: AnyRequest, pdu: bytes, who: tuple[str, str | None], unit: int, twin: Device
) -> set[int]:
    """The codes of all refusals that the rules give; empty if it is permitted."""
    refusals: set[int] = set()
    written: dict[int, int] = {}
    if isinstance(request, WriteSingleRegister):
        written = {request.address: request.value}
    elif isinstance(request, WriteMultipleRegisters):
        written = dict(enumerate(struct.unpack(f">{request.count}H", request.data), request.address))
    elif isinstance(request, ReadWriteMultipleRegisters):
        written = dict(enumerate(struct.unpack(f">{request.write_count}H", request.data), request.write_address))
    elif isinstance(request, MaskWriteRegister) and unit == 1 and request.address < len(twin.holding_registers):
        current = twin.holding_registers[request.address]
        written = {request.address: current & request.and_mask | request.or_mask & ~request.and_mask & 0xFFFF}
    for item in items_of(request, pdu):
        rule = next((one for one in policy.rules if fits(one, item, who, unit, pdu)), None)
        action = policy.default if rule is None else rule.action
        if action is Action.DENY or (action is Action.READ_ONLY and item[2]):
            refusals.add(1 if rule is None else rule.code)
        elif rule is not None and rule.limits is not None and item[2] and item[0] is Table.HOLDING_REGISTERS:
            value = written.get(item[1])
            if value is None and isinstance(request, MaskWriteRegister):
                if not rule.limits.permit_masks(request.and_mask, request.or_mask):
                    refusals.add(rule.code)
            elif value is None or not rule.limits.permit(value):
                refusals.add(rule.code)
    return refusals


# ---- the whole way, through a server's conversation


class World:
    """A policed device behind conversations of several clients, and its twin without a policy."""

    def __init__(
        self,
        policy: Policy,
        audit: AuditLog | None = None,
        handler: type[AuthorizedPipeline] = AuthorizedPipeline,
        items: int = ITEMS,
    ) -> None:
        self.device, self.twin = device(items), device(items)
        self.handler = handler(DeviceResponder({1: self.device}), policy, audit)
        self.plain = DeviceResponder({1: self.twin})
        self.sessions = [
            TcpServerSession(
                self.handler,
                diagnostics=LineDiagnostics(),
                slots=ServerTransactionSlots(16),
                deliver=lambda adu: None,
                client=ClientIdentity(peer=peer, role=role),
            )
            for peer, role in PEERS
        ]

    def ask(self, who: int, unit: int, pdu: bytes) -> bytes:
        adu = struct.pack(">HHHB", 1, 0, len(pdu) + 1, unit) + pdu
        (reply,) = self.sessions[who].receive(adu, len(adu))
        return reply[7:]

    def expected(self, unit: int, pdu: bytes) -> bytes:
        context = RequestContext(unit=unit, function=pdu[0], diagnostics=CommunicationState(), finish=lambda *_: None)
        try:
            reply = self.plain.answer(context, STANDARD.decode_request(pdu))
        except Refusal as refusal:
            reply = ExceptionResponse(pdu[0], refusal.code)
        assert isinstance(reply, Message)
        return reply.encode()


def check(world: World, asked: Sequence[tuple[int, int, bytes]]) -> None:
    for who, unit, pdu in asked:
        request = STANDARD.decode_request(pdu)
        refusals = plainly(world.handler.policy, request, pdu, PEERS[who], unit, world.twin)
        world.device.touched.clear()
        reply = world.ask(who, unit, pdu)
        if refusals:
            right = {bytes((pdu[0] | 0x80, code)) for code in refusals}
            if pdu[0] == 22 and unit != 1:  # a limit cannot be judged where there is no register to look at: 0B
                right.add(world.expected(unit, pdu))
            assert reply in right
            # Function 22 under limits looks at the register, by `peek`; nothing else is touched.
            assert world.device.touched == []
        elif pdu[0] in (8, 11, 12):  # what they say depends on what was counted
            assert reply[0] == pdu[0] or reply == world.expected(unit, pdu)
        else:
            assert reply == world.expected(unit, pdu)
    assert contents(world.device) == contents(world.twin)


asked_often = st.lists(
    st.tuples(st.integers(0, len(PEERS) - 1), st.sampled_from([1, 1, 1, 2]), pdus), min_size=1, max_size=6
).map(lambda pool: pool * 3)  # the second time by what was learned the first time


@pytest.mark.clause("M6")
@given(policies, asked_often)
@example(
    Policy((Rule(access=AccessKind.WRITE, limits=Limits(1, 1)),), Action.ALLOW),
    [(2, 2, bytes.fromhex("16000000000000"))],
)
@settings(max_examples=examples(250), deadline=None)
def test_both_paths_permit_what_the_rules_say_and_nothing_denied_reaches_a_store(policy, asked):
    check(World(policy), asked)


@given(policies, policies, asked_often)
@settings(max_examples=examples(100), deadline=None)
def test_a_policy_that_is_replaced_holds_from_the_next_request_on(first, second, asked):
    world = World(first)
    check(world, asked)
    world.handler.replace_policy(second)
    check(world, asked)


LOCK = b"\x05\x00\x00\xff\x00"


@given(policies, policies, st.lists(pdus.filter(lambda pdu: pdu[0] not in (7, 8, 11, 12, 43)), min_size=1, max_size=6))
@settings(max_examples=examples(150), deadline=None)
@example(Policy.allow_all(), Policy.of(), [b"\x06\x00\x00\x00\x01", b"\x10\x00\x00\x00\x01\x02\x00\x01"])
@example(Policy.allow_all(), Policy.allow_all(), [b"\x06\x00\x00\x00\x01", b"\x03\x00\x00\x00\x01"])
def test_a_policy_that_a_write_of_a_segment_replaces_holds_from_the_next_request_of_the_segment_on(
    first, second, asked
):
    world, others = World(first), {id(first): second, id(second): first}
    world.device.on_write(
        "coils", lambda change: world.handler.replace_policy(others[id(world.handler.policy)]), when="after"
    )
    segment = [*asked, *asked, LOCK, *asked, *asked, LOCK, *asked, LOCK, *asked]
    adus = b"".join(struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu for pdu in segment)
    replies = world.sessions[0].receive(adus, len(adus))
    assert len(replies) == len(segment)
    policy = first
    for pdu, reply in zip(segment, replies, strict=True):
        refusals = plainly(policy, STANDARD.decode_request(pdu), pdu, PEERS[0], 1, world.twin)
        if refusals:
            assert reply[7:] in {bytes((pdu[0] | 0x80, code)) for code in refusals}
            continue
        right = world.expected(1, pdu)
        assert reply[7:] == right
        if pdu[0] in (5, 15) and not right[0] & 0x80:
            policy = others[id(policy)]
    assert contents(world.device) == contents(world.twin)


@given(policies, asked_often)
@settings(max_examples=examples(60), deadline=None)
def test_a_log_changes_nothing_in_what_is_permitted(tmp_path_factory, policy, asked):
    path = tmp_path_factory.mktemp("audit") / "log"
    with AuditLog(path, schedule=lambda seconds, function: True, now=lambda: 1_772_366_400.25) as audit:
        check(World(policy, audit), asked)


class GenericPathOnly(AuthorizedPipeline):
    """A policy without a fast path."""

    def fast_path(self, client: ClientIdentity) -> FastPath:
        return NO_FAST_PATH


@given(policies, asked_often)
@settings(max_examples=examples(150), deadline=None)
def test_both_paths_leave_the_same_lines_to_the_byte(tmp_path_factory, policy, asked):
    folder = tmp_path_factory.mktemp("audit")
    found = []
    for handler in (AuthorizedPipeline, GenericPathOnly):
        path = folder / handler.__name__
        with AuditLog(path, schedule=lambda seconds, function: True, now=lambda: 1_772_366_400.25) as audit:
            world = World(policy, audit, handler)
            replies = [world.ask(who, unit, pdu) for who, unit, pdu in asked]
        found.append((path.read_bytes(), replies, contents(world.device)))
    assert found[0] == found[1]


# ---- edges by name: of a zone, of the addresses, and of what a request says of its own length

EDGES = {  # policies with the addresses at the edges of their zones
    "window": (
        Policy.of(Rule.of(table="holding", addresses="10-19"), Rule.of(table="coil", addresses="10-19")),
        10,
        20,
    ),
    "values": (Policy.of(Rule.of(table="holding", addresses="10-19", values=(0, 5)), default="read-only"), 10, 20),
    "two": (
        Policy.of(
            Rule.of(table="holding", addresses="8-14", values=(0, 5)),
            Rule.of(table="holding", addresses="15-19"),
            Rule.of(table="coil", addresses="8-14"),
            Rule.of(table="coil", addresses="15-19"),
        ),
        15,
        20,
    ),
    "end": (Policy.of(Rule.of(addresses="holding:65530-65535"), Rule.of(addresses="coil:65530-65535")), 65_530, 65_536),
    "denied": (
        Policy.of(Rule.of(action="deny", addresses="holding:65535,coil:65535", code=2), default="allow"),
        1,
        65_535,
    ),
    "unit 0": (Policy.of(Rule.of(units="0"), Rule.of(units="255", addresses="4x1")), 0, 1),
}


def edge_requests(first: int, end: int) -> list[bytes]:
    """Requests at both ends of a zone: right ones, and ones that disagree with themselves."""
    found = []
    for address in sorted({at & 0xFFFF for at in (0, first - 1, first, end - 2, end - 1, end, 65_535)}):
        for count in (0, 1, 2, 0xFFFF):
            found += [struct.pack(">BHH", code, address, count) for code in (1, 2, 3, 4)]
            for length in {2 * count, 2 * count + 1, 2 * count + 2, 0} if count < 4 else (2,):
                for sent in (length, length + 1):
                    found.append(struct.pack(">BHHB", 16, address, count, length & 0xFF) + bytes(sent))
            for length in (0, 1, 2):
                found += [struct.pack(">BHHB", 15, address, count, length) + bytes(sent) for sent in (length, 1)]
            found.append(
                struct.pack(">BHHHHB", 23, address, max(count, 1) & 3, address, count, 2 * count & 0xFF) + b"\0" * 2
            )
        for value in (0, 5, 6, 0xFF00):
            found += [struct.pack(">BHH", code, address, value) for code in (5, 6)]
            found += [struct.pack(">BHH", code, address, value)[:-1] for code in (5, 6)]
            found += [struct.pack(">BHH", code, address, value) + b"\0" for code in (5, 6)]
            found.append(struct.pack(">BHHH", 22, address, 0, value))
    return found


@pytest.mark.clause("M6")
@pytest.mark.parametrize(("items", "audited"), [(20, False), (65_536, False), (65_536, True)])
@pytest.mark.parametrize("name", list(EDGES))
def test_at_the_edges_equal_bytes_get_what_the_policy_of_the_moment_permits(
    name: str, items: int, audited: bool, tmp_path: Path
) -> None:
    policy, first, end = EDGES[name]
    units = (0, 1, 255) if name == "unit 0" else (1,)
    asked = [(0, unit, pdu) for pdu in edge_requests(first, end) for unit in units for _ in range(2)]
    with AuditLog(tmp_path / "log", schedule=lambda seconds, function: True) as audit:
        world = World(policy, audit if audited else None, items=items)
        check(world, asked)
        for other in (Policy.read_only(), policy):
            world.handler.replace_policy(other)
            check(world, asked)
