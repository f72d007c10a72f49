"""A master and servers on a line that may give back what is sent: a write is done once for each call that says so."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_bus import Bus

from busway.errors import ModbusError
from busway.framing.echo import Echo
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from busway.pdu.diagnostics import ReturnQueryData
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.write_items import MaskWriteRegister, WriteMultipleRegisters, WriteSingleCoil, WriteSingleRegister
from busway.server.device import Device

CALLS: dict[str, Callable[[], Request]] = {
    "read": lambda: ReadHoldingRegisters(0, 2),
    "coils": lambda: ReadCoils(0x0300, 21),
    "loopback": lambda: ReturnQueryData(b"\x12\x34"),
    "write": lambda: WriteSingleRegister(3, 9),
    "other value": lambda: WriteSingleRegister(3, 10),
    "coil": lambda: WriteSingleCoil(0x0300, 0xFF00),
    "mask": lambda: MaskWriteRegister(3, 0xF2, 0x25),
    "registers": lambda: WriteMultipleRegisters(0, 2, bytes(4)),
}
WRITES = ("write", "other value", "coil", "mask", "registers")
SERVED, ABSENT = 5, 6


class World:
    """One master and one server of unit 5 on a line; counts what the server executes."""

    def __init__(
        self,
        framing: str,
        *,
        echo: bool,
        asked: Echo,
        served: Echo,
        baud: int = 9600,
        early: bool = False,
        strict: bool = False,
        by_character: bool = False,
        noise: float = 0.0,
        seed: int = 1,
    ) -> None:
        self.bus = Bus(2, baud, framing=framing, echo=echo, by_character=by_character, noise=noise, seed=seed)
        self.master = self.bus.master(
            parameters=ClientParameters(timeout=0.5, retries=0),
            serial=SerialClientParameters(early_replies=early),
            breaker=BreakerParameters(open_after=0),
            echo=asked,
            framing=FramingParameters(strict_timing=strict),
        )
        device = Device(coils=0x0400, holding_registers=10)
        self.executed: list[object] = []
        device.on_write("coils")(self.executed.append)
        device.on_write("holding_registers")(self.executed.append)
        self.server = self.bus.servers({SERVED: device}, echo=served, framing=FramingParameters(strict_timing=strict))

    def call(self, name: str, unit: int = SERVED) -> tuple[object, int]:
        """Make a call; return its outcome, and how often the server has executed a write meanwhile."""
        before = len(self.executed)
        outcome = self.master.get(unit, CALLS[name]())
        self.bus.run(0.6)
        return outcome, len(self.executed) - before


steps = st.lists(
    st.tuples(st.sampled_from(sorted(CALLS)), st.sampled_from([SERVED, SERVED, SERVED, ABSENT])), max_size=10
)


@settings(max_examples=150, deadline=None)
@given(
    framing=st.sampled_from(["rtu", "ascii"]),
    echo=st.booleans(),
    asked=st.sampled_from(Echo),
    served=st.sampled_from(Echo),
    baud=st.sampled_from([9600, 115_200]),
    early=st.booleans(),
    strict=st.booleans(),
    by_character=st.booleans(),
    lag=st.sampled_from([0.0, 0.0005]),
    sequence=steps,
)
def test_write_is_done_once_if_a_unit_has_received_it_and_never_otherwise(
    framing: str,
    echo: bool,
    asked: Echo,
    served: Echo,
    baud: int,
    early: bool,
    strict: bool,
    by_character: bool,
    lag: float,
    sequence: list[tuple[str, int]],
) -> None:
    echo = echo or Echo.ON in (asked, served)
    strict = strict and by_character  # it needs the time of each character
    lag = 0.0 if strict else lag
    world = World(
        framing,
        echo=echo,
        asked=asked,
        served=served,
        baud=baud,
        early=early,
        strict=strict,
        by_character=by_character,
    )
    if lag:
        world.bus.hear_late(world.master, lag)
        world.bus.hear_late(world.server, lag)
    for name, unit in sequence:
        outcome, executed = world.call(name, unit)
        if unit == ABSENT:
            assert not isinstance(outcome, Message), (name, outcome)
            assert executed == 0
        else:
            assert isinstance(outcome, Message), (name, outcome)
            assert executed == (name in WRITES), (name, executed)


@settings(max_examples=100, deadline=None)
@given(
    framing=st.sampled_from(["rtu", "ascii"]),
    asked=st.sampled_from(Echo),
    served=st.sampled_from(Echo),
    by_character=st.booleans(),
    noise=st.sampled_from([0.002, 0.01, 0.04]),
    seed=st.integers(0, 10_000),
    sequence=steps,
)
def test_write_that_ends_as_done_was_executed_once_on_a_noisy_line_that_echoes(
    framing: str,
    asked: Echo,
    served: Echo,
    by_character: bool,
    noise: float,
    seed: int,
    sequence: list[tuple[str, int]],
) -> None:
    world = World(framing, echo=True, asked=asked, served=served, by_character=by_character, noise=noise, seed=seed)
    for name, unit in sequence:
        outcome, executed = world.call(name, unit)
        assert executed <= (name in WRITES and unit == SERVED)
        if isinstance(outcome, Message) and name in WRITES:
            assert executed == 1, (name, unit, outcome)
        if unit == ABSENT:
            assert not isinstance(outcome, Message), (name, outcome)


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("asked", Echo)
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("name", ["write", "coil", "mask", "loopback", "coils"])
def test_first_request_to_a_silent_unit_is_not_answered_by_its_echo(
    framing: str, asked: Echo, early: bool, name: str
) -> None:
    world = World(framing, echo=True, asked=asked, served=Echo.ON, early=early)
    outcome, executed = world.call(name, ABSENT)
    assert isinstance(outcome, ModbusError)
    assert executed == 0
    outcome, executed = world.call(name)
    assert isinstance(outcome, Message)
    assert executed == (name in WRITES)
