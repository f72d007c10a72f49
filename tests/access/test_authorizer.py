"""A policy around a handler: paths of requests, shared prepared answers, rates, late outcomes, and the log."""

import asyncio
import json
import struct

import pytest
from authorizing import AuthorizedPipeline

import busway
from busway.access.audit_log import AuditLog
from busway.access.authorizer import PolicyAuthorizer
from busway.access.rules import Policy, Rule
from busway.framing.mbap import encode_mbap
from busway.options.server import UnitPolicy
from busway.pdu.device_interface import Refusal
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import MaskWriteRegister, WriteMultipleRegisters, WriteSingleRegister
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.responder_failures import answer_later
from busway.session.diagnostic_counters import CommunicationState, LineDiagnostics
from busway.session.responder import LATER, SILENCE, ClientIdentity, RequestContext, ServedUnit
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 2)
READ_FAR = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 8, 2)
OPERATORS_WRITE = Policy.of(Rule.of(name="operators", roles=["operator"]), default="read-only")


def context(function=6, *, peer="10.0.0.7:5000", role=None, unit=1, finish=lambda *_: None):
    return RequestContext(
        unit=unit,
        function=function,
        diagnostics=CommunicationState(),
        finish=finish,
        client=ClientIdentity(peer=peer, role=role, listener="tcp://0.0.0.0:502"),
    )


def session(handler, peer="10.0.0.7:5000", role=None, sent=None):
    return TcpServerSession(
        handler,
        diagnostics=LineDiagnostics(),
        slots=ServerTransactionSlots(16),
        deliver=(sent if sent is not None else []).append,
        client=ClientIdentity(peer=peer, role=role, listener="tcp://0.0.0.0:502"),
    )


def known_reads(handler, peer="10.0.0.7:5000"):
    return handler.fast_path(ClientIdentity(peer=peer, listener="tcp://0.0.0.0:502")).reads


def ask(one, adu):
    return [reply[7:] for reply in one.receive(adu, len(adu))]


@pytest.fixture
def device():
    return Device(holding_registers=list(range(10)), coils=8)


@pytest.fixture
def log(tmp_path):
    return AuditLog(tmp_path / "audit.jsonl", interval=0, clock=lambda: 0.0, now=lambda: 1_772_366_400.25)


def lines(log):
    return [json.loads(line) for line in log.path.read_text(encoding="ascii").splitlines()]


@pytest.mark.clause("M6")
def test_who_may_is_answered_and_who_may_not_gets_exception_01_and_changes_nothing(device):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), OPERATORS_WRITE)
    request = WriteSingleRegister(3, 99)
    assert handler.handle(context(), request) == ExceptionResponse(6, 1)
    assert handler.handle(context(role="viewer"), request) == ExceptionResponse(6, 1)
    assert device.holding_registers[3] == 3
    assert handler.handle(context(role="operator"), request) == request
    assert device.holding_registers[3] == 99
    assert handler.refusals == {"default": 2}


def test_a_rule_of_items_may_answer_02(device):
    handler = AuthorizedPipeline(
        DeviceResponder({1: device}), Policy.of(Rule.of(action="deny", addresses="4x9-4x10", code=2), default="allow")
    )
    one = session(handler)
    assert ask(one, READ) == [b"\x03\x04\x00\x00\x00\x01"]
    assert ask(one, READ_FAR) == [b"\x83\x02"]


def test_reads_keep_the_fast_path_and_their_plans_with_a_policy_and_a_log(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.of(Rule.of(addresses="4x1-4x5")), log)
    one = session(handler)
    for _ in range(3):
        assert ask(one, READ) == [b"\x03\x04\x00\x00\x00\x01"]
    assert len(known_reads(handler)) == 1
    assert handler.handled == 0
    assert ask(one, READ_FAR) == [b"\x83\x01"]
    assert handler.handled == 1


def test_plans_are_shared_by_the_same_rights_and_by_no_others(device):
    policy = Policy.of(
        Rule.of(name="far", peers=["10.0.0.0/8"], addresses="4x1-4x10"), Rule.of(name="near", addresses="4x1-4x5")
    )
    handler = AuthorizedPipeline(DeviceResponder({1: device}), policy)
    inside, same, outside = (session(handler, peer) for peer in ("10.0.0.7:1", "10.9.9.9:2", "192.168.0.1:3"))
    for one in (inside, same):
        assert ask(one, READ_FAR) == [b"\x03\x04\x00\x08\x00\x09"]
    assert ask(outside, READ_FAR) == [b"\x83\x01"]
    assert known_reads(handler) is known_reads(handler, "10.9.9.9:7")
    assert known_reads(handler) is not known_reads(handler, "192.168.0.1:7")
    assert not known_reads(handler, "192.168.0.1:7")


def test_no_read_is_planned_that_is_denied_or_counted(device):
    policy = Policy.of(Rule.of(addresses="4x1-4x5", rate=10), default="deny")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), policy)
    one = session(handler)
    for _ in range(2):
        assert ask(one, READ + READ_FAR) == [b"\x03\x04\x00\x00\x00\x01", b"\x83\x01"]
    assert not known_reads(handler)
    handler.replace_policy(Policy.read_only())
    ask(one, READ)
    assert known_reads(handler)


def test_a_policy_is_replaced_under_a_living_connection(device):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.allow_all())
    one = session(handler)
    assert ask(one, READ + READ) == [b"\x03\x04\x00\x00\x00\x01"] * 2
    before = handler.generation
    handler.replace_policy(Policy())
    assert handler.generation != before
    assert ask(one, READ) == [b"\x83\x01"]
    handler.replace_policy(Policy.read_only())
    assert ask(one, READ) == [b"\x03\x04\x00\x00\x00\x01"]


@pytest.mark.parametrize("other", ["read-only", "", [], {}, None, False])
def test_what_is_no_policy_is_refused_and_the_one_before_holds(device, other):
    if other is not None:  # None permits all
        with pytest.raises(busway.ConfigError, match="must be a Policy"):
            busway.serve("tcp://127.0.0.1:0", units={1: device}, policy=other)
    authorizer = PolicyAuthorizer(Policy.read_only())
    with pytest.raises(busway.ConfigError, match="must be a Policy"):
        authorizer.replace_policy(other)
    assert authorizer.policy == Policy.read_only()


def test_what_changes_inside_is_offered_anew(device):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.read_only())
    one = session(handler)
    assert ask(one, READ + READ) == [b"\x03\x04\x00\x00\x00\x01"] * 2
    seen = []
    device.on_read("holding_registers", seen.append)
    ask(one, READ)
    assert len(seen) == 1


def test_what_comes_faster_than_a_rule_allows_is_answered_06_per_host(device):
    now = [100.0]
    policy = Policy.of(Rule.of(name="slowly", rate=2, table="holding"), default="allow")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), policy, clock=lambda: now[0])
    one, sibling, other = (session(handler, peer) for peer in ("10.0.0.7:1", "10.0.0.7:2", "10.0.0.8:1"))
    done, busy = b"\x03\x04\x00\x00\x00\x01", b"\x83\x06"
    assert ask(one, READ + READ) == [done, done]
    assert ask(sibling, READ) == [busy]
    assert ask(other, READ) == [done]
    now[0] += 0.5
    assert ask(sibling, READ + READ) == [done, busy]
    assert handler.refusals == {"slowly": 2}


def test_a_mask_write_is_judged_by_what_it_makes_of_the_register(device):
    policy = Policy.of(Rule.of(name="small", table="holding", values=(0, 21)))
    handler = AuthorizedPipeline(DeviceResponder({1: device}), policy)
    assert handler.handle(context(22), MaskWriteRegister(5, 0xFFFF, 0)) == MaskWriteRegister(5, 0xFFFF, 0)
    assert handler.handle(context(22), MaskWriteRegister(5, 0x000F, 0x0010)) == MaskWriteRegister(5, 0x000F, 0x0010)
    assert device.holding_registers[5] == 5 | 0x10
    assert handler.handle(context(22), MaskWriteRegister(5, 0x00FF, 0x0100)) == ExceptionResponse(22, 1)
    assert device.holding_registers[5] == 5 | 0x10


def test_where_the_value_cannot_be_read_a_mask_write_is_judged_by_all_that_it_might_make():
    inside = Promising()
    handler = AuthorizedPipeline(inside, Policy.of(Rule.of(table="holding", values=(0, 20))))
    assert handler.handle(context(22), MaskWriteRegister(5, 0xFFFF, 0)) == ExceptionResponse(22, 1)
    assert inside.asked == []
    assert handler.handle(context(22), MaskWriteRegister(5, 0x000F, 0x0010)) == ExceptionResponse(22, 1)
    assert handler.handle(context(22), MaskWriteRegister(5, 0x0003, 0x0010)) is LATER


# ---- the log


class Promising:
    """Promises replies, or gives what it is told to give."""

    functions = STANDARD
    generation = 0

    def __init__(self, outcome=LATER):
        self.outcome = outcome
        self.asked = []

    def serves(self, unit):
        return ServedUnit(unit)

    def answer(self, context, request):
        self.asked.append(context)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def test_a_write_leaves_who_when_what_was_and_what_is(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), OPERATORS_WRITE, log)
    one = session(handler, role="operator")
    pdu = WriteMultipleRegisters.of(2, [70, 80]).encode()
    assert ask(one, struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu) == [pdu[:5]]
    assert lines(log) == [
        {
            "time": "2026-03-01T12:00:00.250Z",
            "peer": "10.0.0.7:5000",
            "role": "operator",
            "listener": "tcp://0.0.0.0:502",
            "unit": 1,
            "function": 16,
            "address": 2,
            "count": 2,
            "old": [2, 3],
            "new": [70, 80],
            "outcome": "done",
            "code": None,
            "rule": "operators",
        }
    ]


def test_a_denied_request_leaves_what_it_would_have_written_and_never_what_stands_there(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), OPERATORS_WRITE, log)
    handler.handle(context(), WriteSingleRegister(2, 70))
    handler.replace_policy(Policy())
    handler.handle(context(3), ReadHoldingRegisters(4, 2))
    log.close()  # both are by one rule, from one host: the second waits to be counted
    write, read = lines(log)
    assert (write["outcome"], write["code"], write["rule"]) == ("denied", 1, "default")
    assert (write["old"], write["new"]) == (None, [70])
    assert (read["function"], read["address"], read["count"], read["new"]) == (3, 4, 2, None)


def test_permitted_reads_leave_nothing(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), OPERATORS_WRITE, log)
    ask(session(handler), READ + READ_FAR)
    handler.handle(context(3), ReadHoldingRegisters(0, 1))
    assert lines(log) == []


def test_a_write_that_the_device_refuses_leaves_its_exception(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.allow_all(), log)
    assert handler.handle(context(), WriteSingleRegister(500, 1)) == ExceptionResponse(6, 2)

    @device.on_write("holding_registers")
    def failing(change):
        raise RuntimeError("a fault")

    assert handler.handle(context(), WriteSingleRegister(5, 1)) == ExceptionResponse(6, 4)
    assert [(one["outcome"], one["code"], one["old"]) for one in lines(log)] == [
        ("exception", 2, None),
        ("exception", 4, [5]),
    ]


def test_a_late_reply_is_noted_when_it_comes_and_a_client_that_goes_before_too(log):
    inside = Promising()
    handler = AuthorizedPipeline(inside, Policy.allow_all(), log)
    sent = []
    one = session(handler, sent=sent)
    adu = struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 3, 9)
    assert ask(one, adu + adu + adu) == []
    assert lines(log) == []
    inside.asked[0].reply(WriteSingleRegister(3, 9))
    inside.asked[1].refuse(11)
    one.close()
    inside.asked[2].reply(WriteSingleRegister(3, 9))
    assert [(line["outcome"], line["code"]) for line in lines(log)] == [
        ("done", None),
        ("exception", 11),
        ("no answer", None),
    ]
    assert {(str(line["old"]), str(line["new"])) for line in lines(log)} == {("None", "[9]")}
    assert len(sent) == 2


def test_silence_is_no_answer(log):
    assert (
        AuthorizedPipeline(Promising(SILENCE), Policy.allow_all(), log).handle(context(), WriteSingleRegister(3, 9))
        is SILENCE
    )
    assert [line["outcome"] for line in lines(log)] == ["no answer"]


async def test_what_is_awaited_is_noted_when_it_ends(log):
    async def refused():
        raise Refusal(4)

    async def done():
        return WriteSingleRegister(3, 9)

    async def never():
        await asyncio.get_running_loop().create_future()

    sent = []
    for awaitable in (done(), refused(), never()):
        one = session(AuthorizedPipeline(Promising(awaitable), Policy.allow_all(), log), sent=sent)
        assert ask(one, struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 3, 9)) == []
        (deferred,) = one.deferred
        task = asyncio.ensure_future(answer_later(deferred))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        task.cancel()
        one.close()
        await asyncio.gather(task, return_exceptions=True)
    assert [(line["outcome"], line["code"]) for line in lines(log)] == [
        ("done", None),
        ("exception", 4),
        ("no answer", None),
    ]


def test_a_mask_write_that_is_denied_by_its_outcome_leaves_no_old_value(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.of(Rule.of(name="small", values=(0, 20))), log)
    handler.handle(context(22), MaskWriteRegister(5, 0x00FF, 0x0100))
    handler.handle(context(22), MaskWriteRegister(5, 0x00FF, 0x0000))
    handler.handle(context(22), MaskWriteRegister(6, 0xFFF0, 0x0009))
    denied, same, changed = lines(log)
    assert (denied["outcome"], denied["old"], denied["new"], denied["masks"]) == (
        "denied",
        None,
        None,
        [0x00FF, 0x0100],
    )
    assert (same["outcome"], same["old"], same["new"]) == ("done", [5], [5])
    assert (changed["old"], changed["new"], changed["rule"]) == ([6], [9], "small")


def test_a_broadcast_to_a_device_of_several_units_leaves_one_line(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device, 2: device}), Policy.allow_all(), log)
    executed = set()
    for unit in (1, 2):
        one = context(unit=unit)
        one.executed = executed
        handler.handle(one, WriteSingleRegister(3, 9))
    assert [(line["unit"], line["old"], line["outcome"]) for line in lines(log)] == [(1, [3], "done")]


def test_without_a_log_that_can_be_written_a_write_is_refused_if_that_is_wanted(device, tmp_path):
    log = AuditLog(tmp_path / "log", interval=0, on_failure="refuse")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.allow_all(), log)
    log.close()
    assert handler.handle(context(), WriteSingleRegister(3, 9)) == ExceptionResponse(6, 4)
    assert device.holding_registers[3] == 3


@pytest.mark.clause("M6")
async def test_through_a_server_an_unauthorized_write_is_answered_01_and_a_replaced_policy_holds_at_once(device, log):
    async with (
        busway.serve("tcp://127.0.0.1:0", units={1: device}, policy=Policy.read_only(), audit=log) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=2) == [0, 1]
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.write_single_register(0, 5)
        assert caught.value.code == 1
        assert device.holding_registers[0] == 0
        server.replace_policy(Policy.allow_all())
        await unit.write_single_register(0, 5)
    denied, done = lines(log)
    assert (denied["outcome"], denied["old"], denied["new"]) == ("denied", None, [5])
    assert (done["outcome"], done["old"], done["new"], done["listener"]) == ("done", [0], [5], denied["listener"])


def test_rates_of_a_replaced_policy_are_those_of_the_new_one(device):
    shared = {}
    handler = AuthorizedPipeline(
        DeviceResponder({1: device}), Policy.of(Rule.of(name="a", rate=1)), rates=shared, clock=lambda: 0.0
    )
    read = ReadHoldingRegisters(0, 1)
    answers = [handler.handle(context(3), read) for _ in range(2)]
    assert [isinstance(one, ExceptionResponse) for one in answers] == [False, True]
    kept = dict(shared)
    handler.replace_policy(Policy.of(Rule.of(name="a", rate=3)))
    shared.update(kept)  # as another thread might have left it behind
    answers = [handler.handle(context(3), read) for _ in range(4)]
    assert [isinstance(one, ExceptionResponse) for one in answers] == [False, False, False, True]


def test_a_rule_that_stays_goes_on_counting_when_the_policy_is_replaced(device):
    rates = {}
    slowly, other = Rule.of(name="slowly", rate=2), Rule.of(name="other", rate=5, units="7")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), Policy.of(slowly, other), rates=rates, clock=lambda: 0.0)
    read = ReadHoldingRegisters(0, 1)
    assert [isinstance(handler.handle(context(3), read), ExceptionResponse) for _ in range(3)] == [False, False, True]
    handler.replace_policy(Policy.of(Rule.of(name="first", action="deny", units="9"), slowly))
    assert handler.handle(context(3), read) == ExceptionResponse(3, 6)
    assert set(rates) == {"slowly"}


@pytest.mark.clause("M6", "T24")
@pytest.mark.parametrize("audited", [False, True])
@pytest.mark.parametrize(
    ("unit_policy", "units"), [(UnitPolicy.LISTED, (3, 0, 255)), (UnitPolicy.ANY, (3, 0, 255, 77))]
)
def test_what_is_denied_of_a_unit_is_denied_by_every_name_of_its_device(device, log, audited, unit_policy, units):
    inner = DeviceResponder({3: device}, unit_policy=unit_policy)
    policy = Policy.of(Rule.of(name="closed", action="deny", units="3", addresses="4x1-4x5"), default="allow")
    one = session(AuthorizedPipeline(inner, policy, log if audited else None))
    for unit in units:
        read = struct.pack(">HHHBBHH", 1, 0, 6, unit, 3, 0, 2)
        write = struct.pack(">HHHBBHH", 1, 0, 6, unit, 6, 0, 99)
        elsewhere = struct.pack(">HHHBBHH", 1, 0, 6, unit, 3, 8, 1)
        for adu in (read, read, write):  # the second time a prepared answer would do
            assert ask(one, adu) == [bytes((adu[7] | 0x80, 1))]
        assert ask(one, elsewhere) == [bytes.fromhex("03 02 0008")]
    assert device.holding_registers[0] == 0


@pytest.mark.clause("M6")
def test_a_rule_may_also_name_the_unit_that_was_asked(device):
    policy = Policy.of(Rule.of(name="gate", action="deny", units="255"), default="allow")
    one = session(AuthorizedPipeline(DeviceResponder({3: device}), policy))
    for unit, answer in ((3, "03 02 0008"), (255, "83 01"), (0, "03 02 0008")):
        assert ask(one, struct.pack(">HHHBBHH", 1, 0, 6, unit, 3, 8, 1)) == [bytes.fromhex(answer)]


def test_whom_no_rule_is_about_reaches_the_device_until_another_policy_says_otherwise(device):
    others = Policy.of(Rule.of(name="guests", action="deny", peers=["10.9.0.0/16"]), default="allow")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), others)
    write = WriteSingleRegister(0, 5)
    assert handler.handle(context(), write) == write
    assert handler.handle(context(peer="10.9.0.1:5"), write) == ExceptionResponse(6, 1)
    handler.replace_policy(Policy.read_only())
    assert handler.handle(context(), write) == ExceptionResponse(6, 1)


def test_rates_that_are_shared_count_for_all_handlers_together(device):
    slowly = Policy.of(Rule.of(name="slowly", action="allow", rate=1), default="deny")
    rates = {}
    one, two = (AuthorizedPipeline(DeviceResponder({1: device}), slowly, rates=rates) for _ in range(2))
    read = ReadHoldingRegisters(0, 1)
    assert isinstance(one.handle(context(3), read), ReadHoldingRegisters.Reply)
    assert two.handle(context(3), read) == ExceptionResponse(3, 6)


async def test_a_client_that_hammers_leaves_two_lines_and_the_writes_of_another_stand_between_in_their_order(
    device, tmp_path
):
    log = AuditLog(tmp_path / "audit.jsonl")
    policy = Policy.of(Rule.of(name="writers", peers=["127.0.0.2"], functions="write"), default="read-only")
    frame = encode_mbap(1, 1, WriteSingleRegister(3, 99).encode())
    async with busway.serve("tcp://127.0.0.1:0", units={1: device}, policy=policy, audit=log) as server:
        port = int(server.endpoints[0].rpartition(":")[2])
        streams = [await asyncio.open_connection("127.0.0.1", port, local_addr=(f"127.0.0.{n}", 0)) for n in (1, 2)]
        for turn in range(100):
            for (reader, writer), times in zip(streams, (50, 1), strict=True):
                writer.write(frame * times if times > 1 else encode_mbap(1, 1, WriteSingleRegister(3, turn).encode()))
                await reader.readexactly((9 if times > 1 else 12) * times)
        for _, writer in streams:
            writer.close()
    log.close()
    told = lines(log)
    assert [each["new"] for each in told if each["outcome"] == "done"] == [[turn] for turn in range(100)]
    denied = [each.get("repeated", 0) for each in told if each["outcome"] == "denied"]
    assert denied == [0, 4999]
    assert log.path.stat().st_size < 40_000


def test_a_sole_device_is_served_by_the_unit_that_it_is_configured_as():
    responder = DeviceResponder({7: Device(holding_registers=1)})
    assert [served and served.unit for served in map(responder.serves, (0, 7, 255, 9))] == [7, 7, 7, None]
