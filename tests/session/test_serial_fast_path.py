"""RTU over a network: what is answered from its bytes equals what the generic path answers, counts and remembers."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.rtu import encode_rtu
from busway.pdu.device_interface import Refusal
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.hooks import Access
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.line_framing import line_framing
from busway.session.serial_server import SerialServerSession
from busway.session.server_pipeline import RequestPipeline

SIZE = 40
UNITS = {1: 0, 2: 100}
"""Own units, with the value of their first register."""


class Converter:
    """The session of a network connection that carries RTU, fed as the connection does."""

    def __init__(self, *, hooked: bool) -> None:
        self.devices = {
            unit: Device(holding_registers=list(range(first, first + SIZE)), coils=SIZE)
            for unit, first in UNITS.items()
        }
        if hooked:
            for device in self.devices.values():
                for table in ("holding_registers", "coils"):
                    device.on_read(table, lambda access: None)  # a hook keeps a table off the fast path
                    device.on_write(table, lambda access: None)
        self.diagnostics = LineDiagnostics(changes_allowed=True)
        self.known = 0
        self.session = SerialServerSession(
            RequestPipeline(DeviceResponder(self.devices)),
            self.devices,
            framing=line_framing("rtu", LineRole.SERVER, SerialTiming.of_network(), units=self.devices),
            diagnostics=self.diagnostics,
            deliver=lambda emission: None,
            sends_at_once=True,
        )

    def receive(self, data: bytes, now: float) -> list[bytes]:
        session = self.session
        silent = [one.frame for one in session.tick(now)]
        known = session.answer_known(data, now)
        if known is not None:
            self.known += 1
            return silent + known
        return silent + [one.frame for one in session.receive(data, now)]

    def state(self) -> tuple[object, ...]:
        session, diagnostics = self.session, self.diagnostics
        units = [(diagnostics.of(unit).counters, diagnostics.of(unit).event_log()) for unit in UNITS]
        values = [list(device.holding_registers[0:SIZE]) for device in self.devices.values()]
        return session.requests, session.foreign, session.damaged_frames, session.deadline(), units, values


def read(unit: int, address: int, count: int, function: int = 3) -> bytes:
    return encode_rtu(unit, struct.pack(">BHH", function, address, count))


units = st.sampled_from([1, 2, 9])
reads = st.builds(read, units, st.integers(0, SIZE + 2), st.integers(0, 20), st.sampled_from([1, 3]))
writes = st.builds(
    lambda unit, at, value: encode_rtu(unit, struct.pack(">BHH", 6, at, value)), units, *[st.integers(0, SIZE)] * 2
)
others = st.sampled_from(
    [
        encode_rtu(0, bytes.fromhex("06 0003 1234")),  # a broadcast
        encode_rtu(9, bytes.fromhex("03 02 0001")),  # the reply of another unit
        encode_rtu(9, bytes.fromhex("03 03 01 02 03")),  # likewise, of eight bytes
        encode_rtu(1, bytes.fromhex("10 0000 0001 02 0007")),
        encode_rtu(2, bytes.fromhex("0F 0002 0003 01 05")),
        encode_rtu(1, bytes.fromhex("08 0004 0000")),  # listen-only mode, until the restart below
        encode_rtu(1, bytes.fromhex("08 0001 0000")),
        read(1, 0, 2)[:-1] + b"\xff",  # a bad CRC
        read(1, 0, 2)[:5],  # the first part of a frame
        read(1, 0, 2)[5:],  # and its rest
        b"\x00\x01\x03",
    ]
)
frames = st.one_of(reads, reads, writes, others)
chunks = st.lists(frames, min_size=1, max_size=4).map(b"".join)
silences = st.sampled_from([0.0, 0.001, 0.04, 0.2, 2.0])


@given(st.lists(st.tuples(silences, chunks), min_size=1, max_size=10))
def test_replies_counters_and_what_follows_equal_those_of_the_generic_path(said: list[tuple[float, bytes]]) -> None:
    fast, generic = Converter(hooked=False), Converter(hooked=True)
    now = 10.0
    for _ in range(2):  # the second time its reads are known
        for silence, data in said:
            now += silence
            assert fast.receive(data, now) == generic.receive(data, now)
            assert fast.state() == generic.state()
    assert generic.known == 0


def test_reads_asked_before_are_answered_without_decoding_and_show_what_was_written_since() -> None:
    converter = Converter(hooked=False)
    asked = read(1, 3, 1) + read(2, 3, 1)
    first = converter.receive(asked, 1.0)
    assert converter.known == 0
    converter.devices[2].holding_registers[3] = 7
    assert converter.receive(asked, 2.0) == [first[0], encode_rtu(2, bytes.fromhex("03 02 0007"))]
    assert converter.known == 1


def test_a_known_read_behind_bytes_that_are_undecided_is_no_request_of_its_own() -> None:
    converter = Converter(hooked=False)
    asked = read(1, 3, 1)
    converter.receive(asked, 1.0)
    assert converter.receive(bytes.fromhex("01 10 0000 000A 14"), 2.0) == []  # a write with 20 bytes to come
    assert converter.receive(asked, 2.01) == []
    assert converter.known == 0


def test_a_hook_that_is_added_later_ends_the_known_reads() -> None:
    converter = Converter(hooked=False)
    asked = read(1, 3, 1)
    converter.receive(asked, 1.0)

    @converter.devices[1].on_read("holding_registers")
    def refuse(access: Access) -> None:
        raise Refusal(6)

    assert converter.receive(asked, 2.0) == [encode_rtu(1, bytes.fromhex("83 06"))]
