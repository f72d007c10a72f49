"""Packets of capture files, in each form of the formats, and files that are broken."""

import io
import struct
from pathlib import Path

import pytest
from captured import block, interface, packet, pcap, section
from hypothesis import example, given
from hypothesis import strategies as st

from busway.errors import ConfigError
from busway.observe.capture_files.packet_file import CapturedPacket, PacketFile, is_capture_file
from busway.observe.pcapng import LinkType, PcapngWriter


def read(data: bytes) -> tuple[list[CapturedPacket], PacketFile]:
    file = PacketFile(io.BytesIO(data), "x.pcap")
    return list(file), file


def refusal(data: bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        read(data)
    return str(caught.value)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("ticks", [1_000_000, 1_000_000_000])
def test_a_pcap_is_read_in_both_byte_orders_and_with_both_kinds_of_times(order: str, ticks: int) -> None:
    data = pcap([(1.25, b"one"), (2.000_001, b"")], link=113, order=order, ticks=ticks)
    assert is_capture_file(data)
    packets, file = read(data)
    assert packets == [CapturedPacket(1, 1.25, 113, b"one"), CapturedPacket(2, 2.000_001, 113, b"")]
    assert (file.packets, file.truncated_at) == (2, None)


def test_upper_bits_of_the_link_type_of_a_pcap_say_something_else() -> None:
    assert read(pcap([(0, b"x")], link=0x2400_0001))[0][0].link_type == 1


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_pcapng_has_sections_with_interfaces_and_times_of_their_own(order: str) -> None:
    other = ">" if order == "<" else "<"
    data = (
        section(order)
        + interface(1, order, options=[(2, b"eth0"), (9, b"\x09")])
        + interface(101, order, options=[(9, b"\x8a"), (14, struct.pack(f"{order}q", 100))])
        + packet(0, b"abc", 1_500_000_000, order)
        + packet(1, b"d", 512, order)
        + section(other)
        + interface(147, other)
        + packet(0, b"", 2_000_000, other)
    )
    assert is_capture_file(data)
    assert read(data)[0] == [
        CapturedPacket(1, 1.5, 1, b"abc", 0, 0, "eth0"),
        CapturedPacket(2, 100.5, 101, b"d", 0, 1),
        CapturedPacket(3, 2.0, 147, b"", 0, 2),
    ]


def test_simple_and_old_packets_are_read_and_other_blocks_skipped() -> None:
    old = struct.pack("<HHIIII", 0, 7, 0, 3_000_000, 2, 9) + b"xy"
    data = section() + interface(snap=4) + block(5, b"statistics") + block(2, old)
    data += block(3, struct.pack("<I", 6) + b"abcd") + block(0x0BAD, b"")
    assert read(data)[0] == [CapturedPacket(1, 3.0, 101, b"xy", 7), CapturedPacket(2, 3.0, 101, b"abcd", 2)]


def test_what_our_writer_writes_is_read() -> None:
    stream = io.BytesIO()
    writer = PcapngWriter(stream, comment="why")
    writer.add_interface(LinkType.RAW_IP, "ip")
    writer.add_interface(LinkType.UPPER_PDU, "rtu:///dev/ttyS0")
    writer.add_packet(1, b"12345", 1_700_000_000.25, comment="odd")
    assert read(stream.getvalue())[0] == [CapturedPacket(1, 1_700_000_000.25, 252, b"12345", 0, 1, "rtu:///dev/ttyS0")]


@pytest.mark.parametrize(
    "data", [pcap([(1, b"abcd"), (2, b"efgh")]), section() + interface() + packet(0, b"abcd") + packet(0, b"efgh")]
)
def test_a_file_that_ends_inside_a_record_gives_what_was_whole(data: bytes) -> None:
    last = len(data) - (20 if data[0] == 0xD4 else 36)
    for size in range(5, len(data) + 1):
        packets, file = read(data[:size])
        assert [each.data for each in packets] == [b"abcd", b"efgh"][: len(packets)]
        assert (file.truncated_at is None) == (size in boundaries(data)), size
        if size > last and size < len(data):
            assert file.truncated_at == last
            assert len(packets) == 1


def boundaries(data: bytes) -> set[int]:
    """Where a record of the two files above ends."""
    return {24, 44, 64} if data[0] == 0xD4 else {28, 48, 84, 120}


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "is empty"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b"snoop\0\0\0", "snoop"),
        (b"hello world", "no pcap and no pcapng: it begins 68 65 6c 6c"),
        (pcap([])[:4] + b"\x05" + pcap([])[5:], "offset 0: version 5 of pcap"),
        (pcap([(0, b"a")]) + struct.pack("<IIII", 0, 0, 0xFFFF_FFFF, 1), "offset 41: a packet of 4294967295 bytes"),
        (section()[:12] + b"\x02" + section()[13:], "version 2 of pcapng"),
        (section()[:8] + b"abcd" + section()[12:], "byte order mark is 61 62 63 64"),
        (section() + b"\x06\0\0\0\x0d\0\0\0", "offset 28: a block of 13 bytes"),
        (section() + interface()[:-1] + b"\x01", "offset 28: a block whose two lengths differ"),
        (section() + packet(0, b"a"), "a packet of interface 0, where the section has 0"),
        (section() + block(1, b"abcd"), "an interface block with 4 bytes"),
        (section() + interface() + block(6, b"abcd"), "a packet block with 4 bytes"),
        (section() + interface() + block(6, struct.pack("<IIIII", 0, 0, 0, 9, 9)), "a packet of 9 bytes in a block"),
    ],
)
def test_a_broken_file_is_refused_with_its_name_and_the_offset(data: bytes, sentence: str) -> None:
    assert refusal(data).startswith("x.pcap: ")
    assert sentence in refusal(data)


WHOLE = section() + interface() + packet(0, b"abcd", 5) + section(">") + interface(1, ">") + packet(0, b"efg", 7, ">")


@given(st.integers(0, len(WHOLE) * 8 - 1), st.integers(0, len(WHOLE)), st.binary(max_size=40))
@example(0, len(WHOLE), b"")
def test_broken_bytes_are_refused_or_read_and_never_anything_else(bit: int, size: int, more: bytes) -> None:
    for whole in (WHOLE, pcap([(1, b"abcd"), (2, b"efgh")], order=">"), more + WHOLE):
        data = bytearray(whole)
        data[bit // 8 % len(data)] ^= 1 << bit % 8
        try:
            packets, file = read(bytes(data[:size]) + more)
        except ConfigError:
            continue  # nothing else may come
        else:
            assert file.packets == len(packets)


def test_a_pipe_that_gives_little_at_once_is_read_whole() -> None:
    class Slow(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            return super().read(min(size or 0, 3))

    assert [each.data for each in PacketFile(Slow(pcap([(1, b"abcdefgh")])), "-")] == [b"abcdefgh"]


def test_a_file_of_another_kind_is_told_apart_by_its_first_bytes(tmp_path: Path) -> None:
    assert not is_capture_file(b"")
    assert not is_capture_file(b"0103")
