"""Servers on a line that gives back what they send: their own replies are no requests, a repeated write is one."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_bus import Bus, ServerEnd

from busway.framing.ascii import encode_ascii
from busway.framing.echo import Echo
from busway.framing.rtu import encode_rtu
from busway.options.lines import FramingParameters
from busway.server.device import Device

FRAMINGS = pytest.mark.parametrize("framing", ["rtu", "ascii"])
MODES = pytest.mark.parametrize("mode", Echo)

WRITE = bytes.fromhex("06 00 00 00 09")
READ = bytes.fromhex("03 00 00 00 02")
REQUESTS = {
    "coil": bytes.fromhex("05 00 01 FF 00"),
    "register": WRITE,
    "loopback": bytes.fromhex("08 00 00 A5 37"),
    "coils": bytes.fromhex("0F 00 00 00 03 01 05"),
    "registers": bytes.fromhex("10 00 00 00 02 04 00 01 00 02"),
    "mask": bytes.fromhex("16 00 00 00 F2 00 25"),
    "read": READ,
    "coils read": bytes.fromhex("01 00 00 00 08"),
    "read and write": bytes.fromhex("17 00 00 00 02 00 04 00 01 02 00 07"),
    "refused": bytes.fromhex("06 00 63 00 09"),
    "unknown": bytes.fromhex("41 00"),
    "to another unit": b"",
}
REPLY_IS_REQUEST = ("coil", "register", "loopback", "mask")


class Line:
    """A server at a port that hears itself, unless ``echo`` is False, and a master that a test speaks for."""

    def __init__(
        self,
        framing: str,
        mode: Echo,
        *,
        echo: bool = True,
        baud: int = 9600,
        by_character: bool = False,
        noise: float = 0.0,
        seed: int = 1,
        parameters: FramingParameters | None = None,
    ) -> None:
        self.bus = Bus(
            2, baud, framing=framing, echo=[0] if echo else False, by_character=by_character, noise=noise, seed=seed
        )
        self.device = Device(coils=10, holding_registers=10)
        self.written: list[object] = []
        self.device.on_write("coils")(self.written.append)
        self.device.on_write("holding_registers")(self.written.append)
        self.server: ServerEnd = self.bus.servers({5: self.device}, echo=mode, framing=parameters)
        self._encode = encode_rtu if framing == "rtu" else encode_ascii
        self.silence = self.bus.timing.t3_5 if framing == "rtu" else 0.0

    def ask(self, pdu: bytes, unit: int = 5) -> int:
        """Send a request, wait for the end of the reply and its silence, and return how many frames the server sent."""
        before = len(self.server.sent)
        frame = self._encode(unit, pdu)
        end = self.bus.line.inject(frame, self.bus.now)
        self.bus.run(end - self.bus.now + self.silence + 1e-6)
        self.bus.run(max(self.server.port.free_at - self.bus.now, 0.0) + self.silence)
        return len(self.server.sent) - before

    def rest(self) -> None:
        """Let a second pass."""
        self.bus.run(1.0)


@FRAMINGS
@MODES
@pytest.mark.parametrize("by_character", [False, True])
@pytest.mark.parametrize("name", [name for name in REQUESTS if name != "to another unit"])
def test_own_reply_is_neither_executed_nor_answered(framing: str, mode: Echo, by_character: bool, name: str) -> None:
    line = Line(framing, mode, by_character=by_character)
    assert line.ask(REQUESTS[name]) == 1
    line.rest()
    assert len(line.server.sent) == 1
    session = line.server.session
    assert (session.requests, session.foreign, session.damaged_frames) == (1, 0, 0)
    assert session.echoes == (mode is Echo.OFF)
    assert line.server.diagnostics.counters.bus_message_count == 1


@FRAMINGS
@pytest.mark.parametrize(
    ("mode", "echo"),
    [(mode, echo) for mode in Echo for echo in (False, True) if echo or mode is not Echo.ON],  # ON says that it echoes
)
@pytest.mark.parametrize("name", REPLY_IS_REQUEST)
def test_write_that_a_master_repeats_at_once_is_executed_each_time(
    framing: str, mode: Echo, echo: bool, name: str
) -> None:
    line = Line(framing, mode, echo=echo)
    line.ask(READ)
    if mode is Echo.AUTOMATIC:
        line.ask(REQUESTS["coil"] if name != "coil" else WRITE)
    for _ in range(5):
        assert line.ask(REQUESTS[name]) == 1
    line.rest()
    assert line.server.session.requests == 6 + (mode is Echo.AUTOMATIC)
    assert name == "loopback" or len(line.written) == 5 + (mode is Echo.AUTOMATIC)


@FRAMINGS
def test_first_write_that_a_master_repeats_at_once_is_executed_each_time_with_echo_off(framing: str) -> None:
    line = Line(framing, Echo.OFF, echo=False)
    for _ in range(5):
        assert line.ask(WRITE) == 1
    assert len(line.written) == 5
    assert line.server.session.echoes == 0


def test_own_reply_is_not_executed_with_strict_timing() -> None:
    line = Line("rtu", Echo.OFF, by_character=True, parameters=FramingParameters(strict_timing=True))
    for pdu in (WRITE, READ, WRITE, WRITE):
        assert line.ask(pdu) == 1
    line.rest()
    assert len(line.written) == 3
    assert line.server.session.requests == 4


@FRAMINGS
@MODES
def test_broadcast_after_a_reply_is_executed_once(framing: str, mode: Echo) -> None:
    line = Line(framing, mode)
    line.ask(WRITE)
    assert line.ask(WRITE, unit=0) == 0
    assert line.ask(WRITE, unit=0) == 0
    line.rest()
    assert len(line.written) == 3


@pytest.mark.parametrize("mode", [Echo.OFF, Echo.AUTOMATIC])
def test_part_of_an_own_reply_that_passes_for_a_request_is_not_executed(mode: Echo) -> None:
    """The reply to function 23 holds registers, and these may hold the rest of a request of function 23."""
    line = Line("rtu", mode)
    begin = bytes.fromhex("17 10 00 00 01 00 05 00 01 02 00 63")
    crc = encode_rtu(5, begin)[-2:]
    held = begin[2:] + crc
    for index in range(0, len(held), 2):
        line.device.holding_registers[index // 2] = int.from_bytes(held[index : index + 2].ljust(2, b"\0"), "big")
    line.written.clear()
    assert line.ask(bytes.fromhex("17 00 00 00 08 00 09 00 01 02 00 07")) == 1
    line.rest()
    assert len(line.written) == 1
    assert len(line.server.sent) == 1


@FRAMINGS
def test_late_echo_of_a_write_is_not_executed_once_a_read_has_shown_the_echo(framing: str) -> None:
    line = Line(framing, Echo.OFF, baud=115_200)
    line.bus.hear_late(line.server, 0.016)
    for pdu in (READ, WRITE, WRITE):
        line.ask(pdu)
        line.rest()
    assert len(line.written) == 2
    assert len(line.server.sent) == 3


actions = st.tuples(st.sampled_from(sorted(REQUESTS)), st.sampled_from([0.0, 0.0005, 0.003, 0.02, 0.06, 0.5]))


@settings(max_examples=150, deadline=None)
@given(
    framing=st.sampled_from(["rtu", "ascii"]),
    mode=st.sampled_from(Echo),
    echo=st.booleans(),
    baud=st.sampled_from([1200, 9600, 19_200, 115_200]),
    by_character=st.booleans(),
    lag=st.sampled_from([0.0, 0.0005, 0.001, 0.016, 0.04]),
    sequence=st.lists(actions, max_size=12),
)
def test_each_request_of_the_master_is_executed_and_answered_once_whatever_the_line_gives_back(
    framing: str,
    mode: Echo,
    echo: bool,
    baud: int,
    by_character: bool,
    lag: float,
    sequence: list[tuple[str, float]],
) -> None:
    if mode is Echo.OFF:
        lag = min(lag, 0.001)  # a later copy may be a request, until a read has shown the echo
    line = Line(framing, mode, echo=echo or mode is Echo.ON, baud=baud, by_character=by_character)
    if lag:
        line.bus.hear_late(line.server, lag)
    if mode is Echo.AUTOMATIC:
        sequence = [("read", 0.1), ("refused", 0.1), *sequence]  # rule 5: the first frames decide
    own = 0
    for name, pause in sequence:
        pdu = REQUESTS[name]
        line.bus.run(pause)
        if not pdu:
            line.ask(WRITE, unit=9)
            line.bus.run(0.05)
            continue
        own += 1
        before = len(line.written)
        line.ask(pdu)
        line.bus.run(lag)  # a master hears the reply as late
        writes = name not in ("read", "coils read", "loopback", "refused", "unknown")
        assert len(line.written) - before == writes, (name, pause)
        assert line.server.session.requests == own
        line.bus.run(0.4 if baud == 1200 else 0.1)
    line.rest()
    assert len(line.server.sent) == line.server.session.requests == own


@settings(max_examples=100, deadline=None)
@given(
    framing=st.sampled_from(["rtu", "ascii"]),
    mode=st.sampled_from(Echo),
    baud=st.sampled_from([9600, 115_200]),
    by_character=st.booleans(),
    seed=st.integers(0, 10_000),
    noise=st.sampled_from([0.002, 0.02, 0.08]),
    sequence=st.lists(st.tuples(st.sampled_from([*REPLY_IS_REQUEST, "read", "refused"]), st.booleans()), max_size=30),
)
def test_no_write_is_executed_more_often_than_the_master_sent_it_on_a_noisy_line_that_echoes(
    framing: str,
    mode: Echo,
    baud: int,
    by_character: bool,
    seed: int,
    noise: float,
    sequence: list[tuple[str, bool]],
) -> None:
    line = Line(framing, mode, baud=baud, by_character=by_character, noise=noise, seed=seed)
    asked = 0
    for name, waits in sequence:
        asked += 1
        line.ask(REQUESTS[name])
        if waits:
            line.bus.run(0.3)
        assert line.server.session.requests <= asked
        assert len(line.server.sent) <= asked
    line.rest()
    assert len(line.server.sent) <= line.server.session.requests <= asked
