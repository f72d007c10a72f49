"""Blocks of a capture file, byte by byte."""

import io
import struct

from capture_file import blocks, options

from busway.observe.pcapng import Flow, LinkType, PcapngWriter


def test_a_file_begins_with_the_section_header() -> None:
    stream = io.BytesIO()
    PcapngWriter(stream, comment="why")
    ((kind, body),) = blocks(stream.getvalue())
    assert kind == 0x0A0D0D0A
    assert body[:16] == bytes.fromhex("4d3c2b1a 0100 0000 ffffffffffffffff")
    assert options(body[16:])[1] == b"why"
    assert options(body[16:])[4].startswith(b"busway ")


def test_an_interface_says_what_its_packets_begin_with() -> None:
    stream = io.BytesIO()
    writer = PcapngWriter(stream)
    assert writer.add_interface(LinkType.RAW_IP, "ip") == 0
    assert writer.add_interface(LinkType.UPPER_PDU, "rtu:///dev/ttyS0", "serial line") == 1
    _, first, second = blocks(stream.getvalue())
    assert first[0] == second[0] == 1
    assert first[1][:8] == bytes.fromhex("6500 0000 00000000")
    assert second[1][:8] == bytes.fromhex("fc00 0000 00000000")
    assert options(second[1][8:]) == {2: b"rtu:///dev/ttyS0", 3: b"serial line", 9: b"\x06"}


def test_a_packet_has_its_time_in_microseconds_its_way_and_its_comment() -> None:
    stream = io.BytesIO()
    writer = PcapngWriter(stream)
    writer.add_interface(LinkType.RAW_IP, "ip")
    writer.add_packet(0, b"\x01\x02\x03\x04\x05", 1_700_000_000.25, flow=Flow.OUTGOING, comment="odd")
    kind, body = blocks(stream.getvalue())[-1]
    assert kind == 6
    interface, high, low, captured, original = struct.unpack_from("<IIIII", body)
    assert (interface, captured, original) == (0, 5, 5)
    assert high << 32 | low == 1_700_000_000_250_000
    assert body[20:28] == b"\x01\x02\x03\x04\x05\0\0\0"
    assert options(body[28:]) == {1: b"odd", 2: struct.pack("<I", 2)}
    assert writer.packets == 1


def test_a_packet_without_anything_to_say_has_no_options() -> None:
    stream = io.BytesIO()
    writer = PcapngWriter(stream)
    writer.add_packet(0, b"\x01\x02\x03\x04", 0.0)
    assert len(blocks(stream.getvalue())[-1][1]) == 24


def test_a_long_comment_is_cut_between_two_characters() -> None:
    stream = io.BytesIO()
    writer = PcapngWriter(stream)
    writer.add_packet(0, b"", 0.0, comment="…" * 30_000)
    text = options(blocks(stream.getvalue())[-1][1][20:])[1].decode()
    assert set(text) == {"…"}
    assert len(text) == 1333


def test_each_block_is_flushed_so_that_the_file_is_whole_at_any_time() -> None:
    class Counting(io.BytesIO):
        flushed = 0

        def flush(self) -> None:
            self.flushed += 1

    stream = Counting()
    writer = PcapngWriter(stream)
    writer.add_interface(LinkType.RAW_IP, "ip")
    writer.add_packet(0, b"", 0.0)
    assert stream.flushed == 3
