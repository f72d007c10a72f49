"""A multi-drop bus: many units, dead ones, another master's traffic, and no byte that was not asked for."""

import random
from collections import Counter

import pytest
from virtual_bus import Bus, MasterEnd, Question

from busway.errors import ExceptionReply, ModbusError, NoReply, UnitSuspended
from busway.framing.ascii import encode_ascii
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.pdu.diagnostics import ReturnQueryData
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleRegister,
)
from busway.server.device import Device

OWN = {1: (1, 2, 3), 2: (10, 11), 3: (20, 21, 22, 23)}
"""Units by port."""
FOREIGN = (40, 41)
DEAD = (60, 61, 62)
FOREIGN_DEAD = 63


def mixed(chance: random.Random) -> Request:
    """Any request that a device of these tests can do, and now and then one that it refuses."""
    address = chance.randrange(60)
    count = chance.randrange(1, 20)
    return chance.choice(
        (
            lambda: ReadHoldingRegisters(address, count),
            lambda: ReadHoldingRegisters(address, count),
            lambda: ReadCoils(address, count),
            lambda: WriteSingleRegister(address, chance.randrange(65_536)),
            lambda: WriteMultipleRegisters.of(address, [chance.randrange(65_536) for _ in range(count)]),
            lambda: WriteMultipleCoils.of(address, [chance.random() < 0.5 for _ in range(count)]),
            lambda: MaskWriteRegister(address, chance.randrange(65_536), chance.randrange(65_536)),
            lambda: ReadWriteMultipleRegisters.of(address, count, address, [1, 2, 3]),
            lambda: ReturnQueryData(chance.randbytes(2 * chance.randrange(1, 8))),
            lambda: ReadHoldingRegisters(500, count),  # exception 02
        )
    )()


class Traffic:
    """So many mixed requests of one master, from several callers, one transaction after the other."""

    def __init__(self, master: MasterEnd, units: tuple[int, ...], count: int, seed: int) -> None:
        self.outcomes: list[tuple[int, Request, object]] = []
        self._master = master
        self._units = units
        self._left = count
        self._chance = random.Random(seed)

    def pauses(self) -> bool:
        """Whether all that was asked has ended."""
        return not self._master.session.queued and not self._master.session.in_flight

    @property
    def done(self) -> bool:
        return self._left == 0 and self.pauses()

    def go_on(self, count: int) -> None:
        """Ask the next ``count`` requests, all at once, in the name of several callers."""
        for number in range(min(count, self._left)):
            self._left -= 1
            unit, request = self._chance.choice(self._units), mixed(self._chance)
            if self._chance.random() < 0.01:
                unit, request = 0, WriteSingleRegister(self._chance.randrange(60), 7)
            try:
                self._master.ask(
                    unit,
                    request,
                    caller=number % 4,
                    then=lambda question, unit=unit, request=request: self._ended(unit, request, question),  # type: ignore[misc]
                )
            except UnitSuspended as error:
                self.outcomes.append((unit, request, error))

    def _ended(self, unit: int, request: Request, question: Question) -> None:
        self.outcomes.append((unit, request, question.outcome))


@pytest.mark.clause("S1")
@pytest.mark.clause("S11")
@pytest.mark.parametrize(("framing", "count"), [("rtu", 10_000), ("ascii", 1000)])
def test_every_owned_request_is_answered_and_no_byte_is_unsolicited(framing: str, count: int) -> None:
    bus = Bus(6, 19_200, framing=framing)
    parameters = ClientParameters(timeout=0.2, retries=1, queue=100)
    ours = bus.master(parameters=parameters)
    servers = {
        port: bus.servers({unit: Device(holding_registers=100, coils=100) for unit in units})
        for port, units in OWN.items()
    }
    theirs = bus.master(parameters=parameters)
    bus.servers({unit: Device(holding_registers=100, coils=100) for unit in FOREIGN})

    owned = tuple(unit for units in OWN.values() for unit in units)
    own = Traffic(ours, owned + DEAD, count, seed=1)
    foreign = Traffic(theirs, (*FOREIGN, FOREIGN_DEAD), count // 5, seed=2)
    while not (own.done and foreign.done):  # two masters on one line must take turns by themselves
        for traffic, turn in ((own, 50), (foreign, 10)):
            traffic.go_on(turn)
            bus.run(
                until=lambda traffic=traffic: traffic._master.session.queued == 0 == traffic._master.session.in_flight
            )  # type: ignore[misc]
            bus.run(0.06)

    assert bus.line.collisions == 0
    assert len(own.outcomes) == count
    for unit, request, outcome in own.outcomes:
        if unit in owned:
            assert isinstance(outcome, Message | ExceptionReply), (unit, request, outcome)
        elif unit:
            assert isinstance(outcome, ModbusError), (unit, request, outcome)
    assert Counter(type(outcome) for unit, _, outcome in own.outcomes if unit in DEAD)[UnitSuspended] > 0
    assert ours.session.counters.damaged_frames == ours.session.counters.bad_replies == 0
    check_the_line(bus, framing)
    for port, server in servers.items():
        assert server.session.damaged_frames == 0, port
        assert server.session.abandoned == 0


def check_the_line(bus: Bus, framing: str) -> None:
    """Each answer follows a request to a unit of that port, and each request to one is followed by its answer."""
    encode = encode_rtu if framing == "rtu" else encode_ascii
    port_of = {unit: port for port, units in OWN.items() for unit in units} | dict.fromkeys(FOREIGN, 5)
    masters = (0, 4)
    due: int | None = None
    talks = bus.line.transmissions(0.0005)
    for talk in talks:
        if talk.port in masters:
            assert due is None, f"unit {due} did not answer"
            unit = talk.data[0] if framing == "rtu" else int(talk.data[1:3], 16)
            due = unit if unit in port_of else None
        else:
            assert due is not None, f"port {talk.port} spoke unasked at {talk.begin}"
            assert talk.port == port_of[due]
            assert talk.data[: 1 if framing == "rtu" else 3] == encode(due, b"\x01")[: 1 if framing == "rtu" else 3]
            due = None
    assert due is None


def test_the_line_of_the_test_itself_tells_who_speaks_unasked() -> None:
    bus = Bus(6)
    bus.line.ports[1].write(encode_rtu(1, b"\x03\x02\x00\x00"), 0.1)
    bus.run(1.0)
    with pytest.raises(AssertionError, match="unasked"):
        check_the_line(bus, "rtu")
    assert issubclass(UnitSuspended, NoReply)
