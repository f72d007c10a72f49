"""Streams of requests at random, cut anywhere: the fast path replies, changes, counts, records and reports the same as
the generic path.

Two servers get the same bytes. The responder of one offers no device for direct use, so it has the generic path alone.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest

from busway.access.audit_log import AuditLog
from busway.access.audit_observer import AuditObserver
from busway.access.authorizer import PolicyAuthorizer
from busway.access.rules import Policy, Rule
from busway.codes import Table
from busway.framing.ascii import encode_ascii
from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.rtu import encode_rtu
from busway.observe.metrics.observer import MetricsObserver
from busway.pdu.device_interface import Refusal
from busway.pdu.functions import FunctionTable
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.hooks import Change
from busway.server.single_block import SingleBlock
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.line_framing import line_framing
from busway.session.responder import ClientIdentity, ServedUnit
from busway.session.serial_server import SerialServerSession
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

FRAMINGS = ("mbap", "rtu", "ascii")
SEEDS = range(8)
STEPS = 12
LAST = 0xFFFF
COUNTS = (0, 1, 1, 2, 3, 8, 9, 17, 123, 124, 125, 126, 1968, 1969, 2000, 2001, LAST)
ADDRESSES = (0, 1, 2, 5, 6, 7, 15, 38, 39, 40, 41, 100, 0xFFDC, 0xFFF0, 0xFFFD, 0xFFFE, LAST)
UNITS = (0, 1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 3, 7, 9, 255)
SWITCH, STAMP = 3, 5
"""Coils of unit 1 whose writes call the application, where a server has hooks."""
POLICIES = (
    Policy.allow_all(),
    Policy.read_only(),
    Policy.of(
        Rule.of(name="small", addresses="holding:0-4", values=(0, 9)),
        Rule.of(name="free", addresses=["holding:5-9", "coil:0-9"]),
        Rule.of(name="seen", access="read", addresses=["holding:0-39", "input:65500-65535"]),
    ),
    Policy.of(
        Rule.of(name="few", addresses="holding:5-9", rate=2),
        Rule.of(name="never", action="deny", addresses="holding:6", code=2),
        Rule.of(name="not 23", action="deny", functions=[23, 5]),
        Rule.of(name="not 3", action="deny", units=3),
        default="allow",
    ),
    Policy.of(Rule.of(name="signed", addresses="holding:0-20", values=(-5, 5), signed=True), default="read-only"),
)


class GenericResponder:
    """The responder of devices, which offers none of them for direct use."""

    def __init__(self, responder: DeviceResponder) -> None:
        self._responder = responder
        self.functions: FunctionTable = responder.functions
        self.answer = responder.answer

    @property
    def generation(self) -> int:
        """That of the responder."""
        return self._responder.generation

    def serves(self, unit: int) -> ServedUnit | None:
        """The unit, not to be used directly."""
        served = self._responder.serves(unit)
        return None if served is None else ServedUnit(served.unit, served.device, is_direct=False, units=served.units)


class Recorder:
    """Observer that keeps unit and PDU of every reply."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, bytes | str]] = []

    def answered(self, client: ClientIdentity, replies: Sequence[bytes], seconds: float) -> None:
        """Replies of the fast path."""
        for reply in replies:
            assert struct.unpack(">HH", reply[2:6]) == (0, len(reply) - 6)
            self.seen.append((reply[6], reply[7:]))

    def unanswered(self, client: ClientIdentity, requests: int) -> None:
        """Never: nothing is forwarded."""
        raise AssertionError

    def ended(self, context: Any, request: Any, outcome: Any, seconds: float) -> None:
        """One outcome of the generic path."""
        self.seen.append((context.unit, outcome.encode() if hasattr(outcome, "encode") else str(outcome)))


def devices_for(kind: int) -> dict[int, Device]:
    """Devices that begin and end at other addresses, one of them under two units, one with a single block."""
    first = Device(
        holding_registers=[7 * n for n in range(40)],
        input_registers=Cells(0xFFDC, values=[n << 8 | n for n in range(36)]),
        coils=[n % 3 == 0 for n in range(50)],
        discrete_inputs=Cells(0xFFF0, values=[n % 2 for n in range(16)]),
    )
    if kind == 0:
        return {1: first}
    second = Device(
        holding_registers=Cells(0xFFF0, values=[0xFF00 + n for n in range(16)], read_only=[(LAST, 1)]),
        input_registers=200,
        coils=Cells(values={0: [1, 0, 1], 5: [1, 1]}),
    )
    third = Device(
        block=SingleBlock(Cells(0, 40, {0: [0x1234, 0xFFFF]})), functions={1, 3, 5, 6, 8, 11, 12, 16, 22, 23}
    )
    return {1: first, 2: first, 3: second, 7: third}


@dataclass
class Options:
    """What both servers are given."""

    framing: str
    devices: int
    policy: int | None
    audit: Path | None
    observed: bool
    hooked: bool
    share: int | None


@dataclass
class Served:
    """One server with one connection.

    Attributes:
        generic: whether it has the generic path alone.
        cut: whether it gets the bytes in pieces.
    """

    options: Options
    generic: bool
    cut: bool
    now: float = 10.0
    hooks: list[object] = field(default_factory=list)

    def __post_init__(self) -> None:
        options = self.options
        self.devices = devices_for(options.devices)
        responder: Any = DeviceResponder(self.devices)
        if self.generic:
            responder = GenericResponder(responder)
        self.audit = None
        if options.audit is not None:
            name = f"{self.generic}-{self.cut}.jsonl"
            self.audit = AuditLog(options.audit / name, interval=0, repeat_interval=0, now=lambda: 0.0)
        self.authorizer = None
        if options.policy is not None:
            self.authorizer = PolicyAuthorizer(POLICIES[options.policy], self.audit, clock=lambda: self.now)
        self.recorder, self.metrics = Recorder(), MetricsObserver()
        observers: list[Any] = [] if self.audit is None else [AuditObserver(self.audit)]
        observers += [self.recorder, self.metrics] if options.observed else []
        self.diagnostics = LineDiagnostics(changes_allowed=True, listed_unit=self._listed)
        self.responder = responder
        self.pipeline = RequestPipeline(responder, self.authorizer, observers)
        self._connect()
        if options.hooked:
            self.devices[1].on_write("coils", self._switched, when="after", address=SWITCH)
            self.devices[1].on_write("coils", self._stamped, address=STAMP, count=2)

    def _connect(self) -> None:
        """A new connection takes the place of the one before."""
        options, pipeline = self.options, self.pipeline
        client = ClientIdentity("10.0.0.7:5000", "tcp://0.0.0.0:502")
        self.tcp: TcpServerSession | None = None
        self.line: SerialServerSession | None = None
        if options.framing == "mbap":
            self.tcp = TcpServerSession(
                pipeline,
                diagnostics=self.diagnostics,
                slots=ServerTransactionSlots(16),
                deliver=lambda adu: None,
                client=client,
                share=options.share,
            )
        else:
            units = set(self.devices)
            self.line = SerialServerSession(
                pipeline,
                units,
                framing=line_framing(options.framing, LineRole.SERVER, SerialTiming.of_network(), units=units),
                diagnostics=self.diagnostics,
                deliver=lambda frame: None,
                client=client,
                sends_at_once=True,
            )

    def _listed(self, unit: int) -> int:
        served = self.responder.serves(unit)
        return unit if served is None else served.unit

    def _switched(self, change: Change) -> None:
        """A hook that changes values, and what the next requests of the segment may do."""
        self.hooks.append(change)
        held = self.devices[1].holding_registers
        held[7] = (held[7] + change.address + change.count) & LAST
        if self.authorizer is not None:
            self.authorizer.replace_policy(
                POLICIES[2 * change.count - 1 if self.authorizer.policy is POLICIES[0] else 0]
            )
        elif change.count == 1:
            self.devices[1].functions = None if change.new[0] else {3, 5, 15, 16}
        elif change.count == 3:
            self.devices[1].on_read("holding_registers", self.hooks.append, address=8)

    def _stamped(self, change: Change) -> None:
        self.hooks.append(change)
        if change.count == 2:
            raise Refusal(6)
        self.devices[1].holding_registers[6] = 4711

    def receive(self, data: bytes) -> list[bytes]:
        """Bytes in one segment, in a buffer that is used again afterwards."""
        buffer = bytearray(data + data[:20])  # what lies behind them is no part of them
        if self.tcp is not None:
            replies = list(self.tcp.receive(buffer, len(data)))
            while self.tcp.rest:
                replies += self.tcp.go_on()
        else:
            assert self.line is not None
            known = self.line.answer_known(data, self.now)
            if known is None:
                known = [one.frame for one in self.line.receive(data, self.now)]
            replies = list(known)
        buffer[:] = b"\xee" * len(buffer)
        return replies

    def wait(self, seconds: float) -> list[bytes]:
        """Time passes."""
        self.now += seconds
        return [] if self.line is None else [one.frame for one in self.line.tick(self.now)]

    def act(self, number: int) -> None:
        """The application does something between two segments."""
        device = self.devices[1]
        action, number = number % 16, number // 16
        if action == 6 or (self.tcp is not None and (self.tcp.broken or self.tcp.unfinished)):
            self._connect()
        if action == 7:
            for unit in sorted(self.diagnostics.listen_only_units):
                self.diagnostics.of(unit).restart()
        if action == 0:
            device.holding_registers[number % 40] = number & LAST
        elif action == 1:
            with device.update():
                device.holding_registers[0:3] = [number & 0xFF] * 3
                device.coils[number % 50] = True
        elif action == 2 and self.authorizer is not None:
            self.authorizer.replace_policy(POLICIES[number % 3 and number % len(POLICIES)])
        elif action == 3:
            device.functions = None if number % 5 else {1, 2, 3, 6, 8, 16}
        elif action == 4 and number % 4 == 0:
            device.on_read("input_registers", self.hooks.append, address=0xFFE0, count=4)
        elif action == 5 and number % 4 == 0:
            device.on_write("holding_registers", self.hooks.append, address=2)

    def state(self) -> dict[str, object]:
        """Everything that must not depend on the path."""
        lines, refusals = "", {}
        if self.audit is not None:
            self.audit.flush()
            lines = self.audit.path.read_text()
        if self.authorizer is not None:
            refusals = dict(self.authorizer.refusals)
        session: Any = self.tcp or self.line
        names = (
            "requests",
            "discarded",
            "refused_busy",
            "broken",
            "unfinished",
            "foreign",
            "damaged_frames",
            "waiting",
        )
        units = sorted({*UNITS})
        logs = [self.diagnostics.of(unit).event_log() for unit in units]
        tables = [(Table.HOLDING_REGISTERS, 0, 40), (Table.COILS, 0, 50), (Table.HOLDING_REGISTERS, 0xFFF0, 16)]
        tables += [(Table.COILS, 0, 3), (Table.COILS, 5, 2), (Table.COILS, 0, 640)]
        tally = self.metrics.tally
        return {
            "session": {name: getattr(session, name) for name in names if hasattr(session, name)},
            "failures": [(type(one.error), str(one.error)) for one in session.failures],
            "line": self.diagnostics.counters,
            "units": [self.diagnostics.of(unit).counters for unit in units],
            "logs": logs,
            "listen only": sorted(self.diagnostics.listen_only_units),
            "items": [[one.peek(*table) for table in tables] for one in self.devices.values()],
            "hooks": list(self.hooks),
            "refusals": refusals,
            "audit": lines,
            "seen": self.recorder.seen,
            "metrics": sorted((one.unit, one.function, one.exception, one.count) for one in tally.all_series()),
            "unanswered": tally.unanswered_counts(),
        }


class Chance:
    """Requests at random; some of them are asked again and again."""

    def __init__(self, random: Random, framing: str) -> None:
        self._random = random
        self._framing = framing
        polled = [struct.pack(">BHH", 3, random.randint(0, 9), random.randint(1, 20)) for _ in range(4)]
        polled += [struct.pack(">BHH", 4, 0xFFDC + random.randint(0, 9), random.randint(1, 20)), self._read()]
        self._polled = [self._frame(pdu, random.choice((1, 1, 1, 2, 7, 255)), 7) for pdu in polled]
        self._transaction = 0

    def segment(self) -> bytes:
        """The bytes of several requests."""
        random = self._random
        kind = random.random()
        if kind < 0.35:  # a poller
            return b"".join(self._renumbered(random.choice(self._polled)) for _ in range(random.randint(1, 6)))
        frames = []
        if kind < 0.5:  # what changes the path stands between requests that are sent before it and after it
            same = [self._frame(self._write(), 1, 5), *random.sample(self._polled, 2), self._frame(self._write(), 2, 6)]
            turn = random.choice(
                (
                    struct.pack(">BHH", 5, SWITCH, random.choice((0, 0xFF00))),
                    struct.pack(">BHHBB", 15, random.choice((1, 2, SWITCH)), 3, 1, random.choice((0, 7))),
                    bytes.fromhex("08 0004 0000"),
                    bytes.fromhex("08 0001 0000"),
                )
            )
            odd = random.random() < 0.3
            return b"".join([*same, *same, self._frame(turn, 1, 9, odd=odd), *same])
        for _ in range(random.randint(1, 8)):
            if random.random() < 0.3:
                frames.append(self._renumbered(random.choice(self._polled)))
            else:
                frames.append(self._any())
        return b"".join(frames)

    def cuts(self, data: bytes) -> list[bytes]:
        """The bytes in pieces."""
        random = self._random
        if random.random() < 0.15:
            return [data[at : at + 1] for at in range(len(data))]
        if random.random() < 0.5:
            return [data]
        places = sorted(random.randint(0, len(data)) for _ in range(random.randint(0, 4)))
        pieces = [data[begin:end] for begin, end in zip([0, *places], [*places, len(data)], strict=True)]
        return [piece for piece in pieces if piece]

    def _any(self) -> bytes:
        random = self._random
        unit = random.choice(UNITS)
        pdu = random.choices((self._read, self._write, self._other), (3, 6, 1))[0]()
        if random.random() < 0.06:
            pdu = random.choice((pdu[:-1], pdu[:-2], pdu + b"\0", pdu + pdu, pdu[:1], pdu[:3]))[:253] or b"\x03"
        return self._frame(pdu, unit, random.choice((0, 7, 7, LAST)), odd=random.random() < 0.05)

    def _read(self) -> bytes:
        random = self._random
        code = random.choice((1, 2, 3, 3, 3, 4))
        if random.random() < 0.8:
            base = {1: 0, 2: 0xFFF0, 3: 0, 4: 0xFFDC}[code]
            return struct.pack(">BHH", code, base + random.randint(0, 9), random.choice((1, 2, 3, 5, 7)))
        return struct.pack(">BHH", code, random.choice(ADDRESSES), random.choice(COUNTS))

    def _write(self) -> bytes:
        random = self._random
        code = random.choice((5, 6, 6, 15, 16, 16, 22, 23))
        near = random.random() < 0.8
        address = random.randint(0, 12) if near else random.choice(ADDRESSES)
        if code == 5:
            value = random.choice((0, 0, 0, 0xFF00, 0xFF00, 0xFF00, 1, 0xFF01, 0x00FF, LAST))
            address = random.choice((SWITCH, STAMP, *[address] * 6))
            return struct.pack(">BHH", 5, address, value)
        if code == 6:
            return struct.pack(">BHH", 6, address, random.choice((0, 5, 9, 10, 0x8000, 0xFFFB, LAST)))
        if code == 22:
            return struct.pack(">BHHH", 22, address, random.choice((0, 0xF0F0, LAST)), random.choice((0, 3, 0xF00F)))
        count = random.randint(1, 4) if near else random.choice((*COUNTS[:11], 121, 122, 123, 124))
        size = (count + 7) // 8 if code == 15 else 2 * count
        size = min(size, 246)
        data = bytes(random.choice((0, 3, 9, 0xFF)) if code == 15 or n % 2 or size > 8 else 0 for n in range(size))
        if random.random() < 0.1:
            size = random.choice((size + 1, size - 1, 0, 255)) % 256
        if random.random() < 0.1:
            count = random.choice((0, count + 1, count + 8, count + 8, LAST))
        if code == 23:
            read = random.choice((0, 1, 1, 2, 2, 3, 125, 126)), random.choice((0, 1, 2, 3, 37, 39, 40, LAST))
            return struct.pack(">BHHHHB", 23, read[1], read[0], address, count, size) + data[:242]
        return struct.pack(">BHHB", code, address, count, size) + data

    def _other(self) -> bytes:
        random = self._random
        return random.choice(
            (
                bytes.fromhex("08 0000 1234"),
                bytes.fromhex("08 000B 0000"),
                bytes.fromhex("08 000E 0000"),
                bytes.fromhex("08 000A 0000"),
                bytes.fromhex("08 0001 0000"),
                bytes.fromhex("08 0001 FF00"),
                bytes.fromhex("08 0001 0000"),
                bytes.fromhex("08 0004 0000"),
                bytes.fromhex("08 0002 0000"),
                bytes.fromhex("0B"),
                bytes.fromhex("0C"),
                bytes.fromhex("07"),
                bytes.fromhex("11"),
                bytes.fromhex("2B 0E 01 00"),
                bytes.fromhex("2B 0D 00"),
                bytes.fromhex("18 0005"),
                bytes.fromhex("14 07 06 0001 0000 0001"),
                bytes.fromhex("41 01"),
                bytes.fromhex("00"),
                bytes.fromhex("83 02"),
                bytes.fromhex("FF"),
            )
        )

    def _frame(self, pdu: bytes, unit: int, transaction: int, *, odd: bool = False) -> bytes:
        random = self._random
        if self._framing == "mbap":
            protocol, length = 0, len(pdu) + 1
            if odd:
                protocol = random.choice((0, 1, 0x100, 0x100))
                length += 0 if protocol else random.choice((-1, 1))
                if random.random() < 0.05:
                    length = random.choice((0, 1, 255, LAST))
            return struct.pack(">HHHB", transaction, protocol, length, unit) + pdu
        encode = encode_rtu if self._framing == "rtu" else encode_ascii
        frame = bytearray(encode(unit, pdu))
        if odd:
            frame[random.randrange(len(frame))] ^= 1 << random.randrange(7)
        return bytes(frame)

    def _renumbered(self, frame: bytes) -> bytes:
        if self._framing != "mbap":
            return frame
        self._transaction = self._transaction + 1 & LAST
        return struct.pack(">H", self._transaction) + frame[2:]


def run(seed: int, framing: str, folder: Path, steps: int = STEPS) -> int:
    """One walk; returns how many replies there were."""
    random = Random(f"{seed} {framing}")
    options = Options(
        framing=framing,
        devices=random.randint(0, 1),
        policy=random.choice((None, None, 0, 1, 2, 2, 3, 3, 4)),
        audit=folder if random.random() < 0.4 else None,
        observed=random.random() < 0.5,
        hooked=random.random() < 0.5,
        share=random.choice((None, None, 1, 3)),
    )
    if options.policy is None:
        options.audit = None
    servers = [Served(options, generic=generic, cut=True) for generic in (False, True)]
    if framing == "mbap":
        servers.append(Served(options, generic=False, cut=False))  # where a stream is cut makes no difference
    chance = Chance(random, framing)
    answers = 0
    for step in range(steps):
        number, seconds = random.randrange(1 << 12), random.choice((0.0, 0.01, 0.3, 2.0))
        data = chance.segment()
        pieces = chance.cuts(data)
        replies: list[Any] = []
        for server in servers:
            told: list[bytes] = server.wait(seconds)
            server.act(number)
            for piece in pieces if server.cut else [data]:
                told += server.receive(piece)
            replies.append(told)
        answers += len(replies[0])
        about = f"seed {seed}, {framing}, step {step}, {options}, {[piece.hex(' ') for piece in pieces]}"
        states = [server.state() for server in servers]
        for other, state in zip(replies[1:], states[1:], strict=True):
            assert replies[0] == other, about
            for name, value in states[0].items():
                assert value == state[name], f"{name}: {about}"
    for server in servers:
        if server.audit is not None:
            server.audit.close()
    return answers


@pytest.mark.parametrize("framing", FRAMINGS)
def test_the_fast_path_cannot_be_told_from_the_generic_path(framing: str, tmp_path: Path) -> None:
    answers = 0
    for seed in SEEDS:
        folder = tmp_path / str(seed)
        folder.mkdir()
        answers += run(seed, framing, folder)
    assert answers > 10 * len(SEEDS)
