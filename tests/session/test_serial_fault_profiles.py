"""Devices that misbehave on a line (the fault profiles of the field), and a master that copes."""

import random
from collections.abc import Callable, Sequence

import pytest
from virtual_bus import Bus, MasterEnd, honest

from busway.errors import BadReply, ExceptionReply, ModbusError, NoReply, WriteOutcomeUnknown
from busway.framing.ascii import encode_ascii
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import SerialClientParameters
from busway.pdu.message import Message
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteMultipleRegisters, WriteSingleRegister
from busway.server.device import Device

CHARACTER = 11 / 9600
T3_5 = 3.5 * CHARACTER
Frames = Sequence[tuple[float, bytes]]
Twist = Callable[[bytes], Frames]
"""What a device makes of its honest answer: times after the request, and bytes."""

NOISE = bytes.fromhex("ff 00 55 aa 13")


def line(
    twist: Twist, *, framing: str = "rtu", serial: SerialClientParameters | None = None, **options: object
) -> tuple[Bus, MasterEnd, Device]:
    """A master and one misbehaving device, unit 1, whose register n holds 100 + n."""
    device = Device(holding_registers=20)
    device.holding_registers[0:20] = [100 + number for number in range(20)]
    answer = honest({1: device, 2: device})
    encode = encode_rtu if framing == "rtu" else encode_ascii

    def behaviour(unit: int, pdu: bytes, now: float) -> Frames:
        reply = answer(unit, pdu)
        return [] if reply is None else twist(encode(unit, reply))

    bus = Bus(3, framing=framing)
    settings: dict[str, object] = {"timeout": 0.5, "retries": 0, **options}
    master = bus.master(parameters=ClientParameters(**settings), serial=serial)  # type: ignore[arg-type]
    bus.device(behaviour)
    return bus, master, device


def read(master: MasterEnd, address: int = 0, count: int = 2, unit: int = 1) -> object:
    outcome = master.get(unit, ReadHoldingRegisters(address, count))
    return outcome.registers if isinstance(outcome, ReadHoldingRegisters.Reply) else outcome


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize(
    "junk", [b"\x00", b"\x00\x00", b"\xff", NOISE, b"\x01\x03", b"\x01\x03\x04\x00", b"\x01\x03\xfa" * 5]
)
def test_leading_zero_and_noise_before_a_reply(framing: str, junk: bytes) -> None:
    _, master, _ = line(lambda frame: [(T3_5, junk + frame)], framing=framing)
    for address in range(3):
        assert read(master, address) == [100 + address, 101 + address]


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("junk", [b"\x00", NOISE, b"\x01\x03\x04"])
def test_noise_behind_a_reply_costs_nothing_but_its_own_time(framing: str, junk: bytes) -> None:
    _, master, _ = line(lambda frame: [(T3_5, frame + junk)], framing=framing)
    for address in range(3):
        assert read(master, address) == [100 + address, 101 + address]


@pytest.mark.parametrize("gap", [0.0, 0.0011, 0.003, 0.016, 0.03])
@pytest.mark.parametrize("size", [1, 2, 5, 64])
def test_dribble(gap: float, size: int) -> None:
    def dribble(frame: bytes) -> Frames:
        parts = [frame[at : at + size] for at in range(0, len(frame), size)]
        return [(T3_5 + number * (size * CHARACTER + gap), part) for number, part in enumerate(parts)]

    _, master, _ = line(dribble, timeout=2.0)
    for address in range(3):
        assert read(master, address, 5) == [100 + address + number for number in range(5)]


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_glue_takes_the_first_and_drops_the_rest(framing: str) -> None:
    _, master, _ = line(lambda frame: [(T3_5, frame + frame)], framing=framing)
    for address in range(3):
        assert read(master, address) == [100 + address, 101 + address]
    assert master.session.counters.foreign_replies + master.session.counters.damaged_frames >= 2


@pytest.mark.parametrize("retries", [0, 1, 2])
def test_late_for_ever_gives_errors_that_name_the_delay_and_never_wrong_data(retries: int) -> None:
    bus, master, _ = line(lambda frame: [(0.8, frame)], retries=retries)
    outcomes = [(address, read(master, address)) for address in range(12)]
    assert all(one == [100 + address, 101 + address] for address, one in outcomes if not isinstance(one, ModbusError))
    errors = [one for _, one in outcomes if isinstance(one, NoReply)]
    assert len(errors) == (12 if retries == 0 else 0)  # a repeated read is answered by the reply to its first attempt
    assert sum("longer timeout" in str(error) for error in errors) >= len(errors) - 2
    assert master.session.late_replies.of(1).delay == pytest.approx(0.8 + 9 * CHARACTER, abs=0.02)
    assert bus.line.collisions == 0


def test_late_for_a_while_is_back_in_step_alone() -> None:
    delays = [0.9, 0.9, 0.9]
    bus, master, _ = line(lambda frame: [(delays.pop() if delays else T3_5, frame)])
    for address in range(3):
        read(master, address)
    bus.run(10.0)
    for address in range(5):
        assert read(master, address) == [100 + address, 101 + address]


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("change", [-1, 1])
def test_short_and_long_byte_counts_are_broken_replies_with_their_bytes(framing: str, change: int) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    broken = encode(1, bytes((3, 4 + change)) + bytes(4))
    _, master, _ = line(lambda frame: [(T3_5, broken)], framing=framing)
    outcome = read(master)
    assert isinstance(outcome, BadReply), outcome
    assert outcome.raw == broken


@pytest.mark.parametrize("registers", [1, 3])
def test_reply_of_another_length_is_broken(registers: int) -> None:
    broken = encode_rtu(1, bytes((3, 2 * registers)) + bytes(2 * registers))
    _, master, _ = line(lambda frame: [(T3_5, broken)])
    outcome = read(master)
    assert isinstance(outcome, BadReply)
    assert outcome.raw == broken


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_wrong_echo_of_a_write_leaves_its_outcome_unknown(framing: str) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    wrong = encode(1, WriteSingleRegister(3, 8).encode())
    _, master, _ = line(lambda frame: [(T3_5, wrong)], framing=framing)
    outcome = master.get(1, WriteSingleRegister(3, 9))
    assert isinstance(outcome, WriteOutcomeUnknown)
    assert isinstance(outcome.__cause__, BadReply)


def test_odd_exceptions_are_typed_and_no_crash() -> None:
    for pdu in (b"\x83\x63", b"\x83\x00"):
        _, master, _ = line(lambda frame, pdu=pdu: [(T3_5, encode_rtu(1, pdu))])  # type: ignore[misc]
        outcome = read(master)
        assert isinstance(outcome, ExceptionReply)
        assert outcome.code == pdu[1]
    for pdu in (b"\x83", b"\x83\x02\x00\x00", b"\x83\x02\x00"):
        _, master, _ = line(lambda frame, pdu=pdu: [(T3_5, encode_rtu(1, pdu))])  # type: ignore[misc]
        assert isinstance(read(master), ModbusError)


def test_min_gap_is_kept_by_request_gap() -> None:
    last: list[float] = [-1.0]
    device = Device(holding_registers=20)
    answer = honest({1: device})

    def behaviour(unit: int, pdu: bytes, now: float) -> Frames:
        if now - last[0] < 0.1:
            return []
        reply = encode_rtu(unit, answer(unit, pdu) or b"")
        last[0] = now + T3_5 + len(reply) * CHARACTER
        return [(T3_5, reply)]

    for gap, answered in ((0.0, False), (0.1, True)):
        bus = Bus()
        master = bus.master(parameters=ClientParameters(timeout=0.05, retries=0, request_gap=gap))
        bus.device(behaviour)
        last[0] = -1.0
        read(master)
        assert (not isinstance(read(master), ModbusError)) is answered


def test_unit_switch_is_kept_by_unit_switch_gap() -> None:
    last = [0, -1.0]
    answer = honest({1: Device(holding_registers=20), 2: Device(holding_registers=20)})

    def behaviour(unit: int, pdu: bytes, now: float) -> Frames:
        """A device misses the first frame after another unit has spoken, unless it had 50 ms."""
        misses = last[0] not in (0, unit) and now - 8 * CHARACTER - last[1] < 0.0499
        reply = encode_rtu(unit, answer(unit, pdu) or b"")
        last[:] = [unit, now + T3_5 + len(reply) * CHARACTER]
        return [] if misses else [(T3_5, reply)]

    for gap, answered in ((0.0, False), (0.05, True)):
        bus = Bus()
        master = bus.master(
            parameters=ClientParameters(timeout=0.1, retries=0), serial=SerialClientParameters(unit_switch_gap=gap)
        )
        last[:] = [0, -1.0]
        bus.device(behaviour)
        read(master, unit=1)
        assert (not isinstance(read(master, unit=2), ModbusError)) is answered


def test_mute_after_connect_is_kept_by_connect_delay() -> None:
    _, master, _ = line(lambda frame: [(T3_5, frame)], connect_delay=2.0)
    question = master.ask(1, ReadHoldingRegisters(0, 2))
    master.bus.run(until=lambda: question.done)
    assert master.sent[0][0] == pytest.approx(2.0)


def test_broadcast_reply_is_swallowed_within_the_turnaround() -> None:
    bus = Bus()
    master = bus.master()
    answer = honest({1: Device(holding_registers=20)})

    def behaviour(unit: int, pdu: bytes, now: float) -> Frames:
        reply = answer(unit or 1, pdu)
        return [] if reply is None else [(T3_5, encode_rtu(unit, reply))]

    bus.device(behaviour)
    assert isinstance(master.get(0, WriteSingleRegister(0, 5)), Message)
    assert read(master) == [5, 0]
    assert master.session.counters.foreign_replies == 1


def test_busy_unit_leaves_others_alone() -> None:
    device = Device(holding_registers=20)
    answer = honest({1: device, 2: device})

    def behaviour(unit: int, pdu: bytes, now: float) -> Frames:
        reply = bytes((pdu[0] | 0x80, 6)) if unit == 1 else answer(unit, pdu)
        return [(T3_5, encode_rtu(unit, reply or b""))]

    bus = Bus()
    master = bus.master()
    bus.device(behaviour)
    for _ in range(5):
        outcome = read(master, unit=1)
        assert isinstance(outcome, ExceptionReply)
        assert outcome.code == 6
        assert read(master, unit=2) == [0, 0]


def test_fc6_only_and_fc16_only_devices_drop_the_other_function() -> None:
    for only, right, wrong in (
        (6, WriteSingleRegister(0, 1), WriteMultipleRegisters.of(0, [1])),
        (16, WriteMultipleRegisters.of(0, [1]), WriteSingleRegister(0, 1)),
    ):
        answer = honest({1: Device(holding_registers=20)})

        def behaviour(
            unit: int,
            pdu: bytes,
            now: float,
            only: int = only,
            answer: Callable[[int, bytes], bytes | None] = answer,
        ) -> Frames:
            return [(T3_5, encode_rtu(unit, answer(unit, pdu) or b""))] if pdu[0] == only else []

        bus = Bus()
        master = bus.master(parameters=ClientParameters(timeout=0.1))
        bus.device(behaviour)
        assert isinstance(master.get(1, right), Message)
        assert isinstance(master.get(1, wrong), WriteOutcomeUnknown)


def test_max_block_and_hole_are_exceptions_of_the_block() -> None:
    for code in (2, 3):
        _, master, _ = line(lambda frame, code=code: [(T3_5, encode_rtu(1, bytes((0x83, code))))])  # type: ignore[misc]
        outcome = read(master, 0, 10)
        assert isinstance(outcome, ExceptionReply)
        assert outcome.code == code


@pytest.mark.clause("S10")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_noise_on_the_line_damages_frames_and_never_data(framing: str) -> None:
    """One character in 200 is damaged; a reply that is taken is right, and the master stays in step."""
    bus = Bus(2, framing=framing, noise=0.005)
    device = Device(holding_registers=100)
    device.holding_registers[0:100] = list(range(1000, 1100))
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=5))
    bus.servers({1: device})
    chance = random.Random(5)
    good = 0
    for _ in range(300):
        address, count = chance.randrange(90), chance.randrange(1, 10)
        outcome = read(master, address, count)
        if not isinstance(outcome, ModbusError):
            assert outcome == [1000 + address + number for number in range(count)]
            good += 1
        else:
            bus.run(9.0)  # the breaker, if it opened
    assert good > 290
