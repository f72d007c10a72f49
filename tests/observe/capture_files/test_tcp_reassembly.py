"""Segments of one direction put in order: late, twice, overlapping, missing; compared with the stream that was cut."""

import random

from captured import pieces
from hypothesis import given
from hypothesis import strategies as st

from busway.observe.capture_files.tcp_reassembly import (
    FARTHEST,
    MOST_WAITING,
    StreamAssembler,
    StreamGap,
    StreamPart,
    StreamPiece,
)


def begun(first: int = 1) -> StreamAssembler:
    stream = StreamAssembler()
    stream.begin(first - 1)
    return stream


def told(parts: list[StreamPart]) -> list[bytes | int | None]:
    """Bytes, and sizes of gaps."""
    return [each.data if isinstance(each, StreamPiece) else each.size for each in parts]


def test_segments_in_order_are_given_at_once_with_their_packets() -> None:
    stream = begun()
    assert stream.segment(1, b"ab", 0, 4, 0.5) == [StreamPiece(b"ab", 4, 0.5)]
    assert stream.segment(3, b"c", 0, 5, 0.6) == [StreamPiece(b"c", 5, 0.6)]


def test_a_late_segment_is_waited_for() -> None:
    stream = begun()
    assert stream.segment(3, b"cd", 0, 1, 0.1) == []
    assert stream.segment(1, b"ab", 0, 2, 0.2) == [StreamPiece(b"ab", 2, 0.2), StreamPiece(b"cd", 1, 0.1)]
    assert (stream.out_of_order, stream.repeated) == (1, 0)


def test_what_comes_again_is_dropped_also_where_it_overlaps() -> None:
    stream = begun()
    stream.segment(1, b"abcd", 0, 1, 0.0)
    assert told(stream.segment(1, b"abcd", 0, 2, 0.0)) == []
    assert told(stream.segment(3, b"XXef", 0, 3, 0.0)) == [b"ef"]
    assert stream.repeated == 6


def test_missing_bytes_are_told_when_the_peer_has_acknowledged_what_follows() -> None:
    stream = begun()
    stream.segment(1, b"ab", 0, 1, 0.0)
    assert stream.segment(6, b"fg", 0, 2, 0.2) == []
    assert told(stream.acknowledge(6)) == []
    assert stream.acknowledge(8) == [StreamGap(3, 2, 0.2), StreamPiece(b"fg", 2, 0.2)]
    assert told(stream.segment(3, b"cde", 0, 3, 0.3)) == []  # too late


def test_an_acknowledgement_of_several_segments_gives_all_of_them_with_their_gaps() -> None:
    stream = begun()
    for packet, at in enumerate((1, 21, 41, 61)):
        stream.segment(at, bytes(10), 0, packet, float(packet))
    assert stream.acknowledge(51) == [
        StreamGap(10, 1, 1.0),
        StreamPiece(bytes(10), 1, 1.0),
        StreamGap(10, 2, 2.0),
        StreamPiece(bytes(10), 2, 2.0),
    ]
    assert stream.acknowledge(70) == []
    assert told(stream.acknowledge(71)) == [10, bytes(10)]


def test_bytes_that_were_not_captured_are_a_gap_of_known_size() -> None:
    stream = begun()
    assert told(stream.segment(1, b"ab", 3, 1, 0.0)) == [b"ab", 3]
    assert told(stream.segment(6, b"fg", 0, 2, 0.0)) == [b"fg"]


def test_a_stream_that_begins_in_the_middle_says_so_first() -> None:
    stream = StreamAssembler()
    assert told(stream.segment(700, b"ab", 0, 1, 0.0)) == [None, b"ab"]
    assert told(stream.segment(702, b"c", 0, 1, 0.0)) == [b"c"]


def test_a_segment_far_away_begins_the_stream_anew() -> None:
    stream = begun()
    stream.segment(1, b"ab", 0, 1, 0.0)
    assert told(stream.segment(2 + 2 * FARTHEST, b"cd", 0, 2, 0.0)) == [None, b"cd"]
    assert told(stream.segment(4 + 2 * FARTHEST, b"ef", 0, 2, 0.0)) == [b"ef"]


def test_waiting_bytes_are_limited() -> None:
    stream = begun()
    size = 0
    found: list[StreamPart] = []
    while not found:
        found = stream.segment(100 + size, bytes(1000), 0, 1, 0.0)
        size += 1000
    assert size <= MOST_WAITING + 1000
    assert told(found)[0] == 99


def test_what_waits_at_the_end_is_given_with_its_gaps() -> None:
    stream = begun()
    stream.segment(3, b"c", 0, 1, 0.0)
    stream.segment(6, b"f", 0, 2, 0.0)
    assert told(stream.finish()) == [2, b"c", 2, b"f"]


CUTS = st.lists(st.integers(0, 300), max_size=12)


@given(st.binary(min_size=1, max_size=300), CUTS, CUTS, st.integers(0, 2**32 - 1), st.randoms(use_true_random=False))
def test_any_order_and_any_repetition_give_the_stream(
    data: bytes, cuts: list[int], others: list[int], first: int, chance: random.Random
) -> None:
    segments = pieces(data, cuts) + pieces(data, others)
    chance.shuffle(segments)
    stream = begun(first)
    found = [part for at, piece in segments for part in stream.segment((first + at) % 2**32, piece, 0, 1, 0.0)]
    assert b"".join(each for each in told(found) if isinstance(each, bytes)) == data
    assert not [each for each in found if isinstance(each, StreamGap)]


@given(st.binary(min_size=2, max_size=300), CUTS, st.sets(st.integers(0, 12)), st.integers(0, 2**32 - 1))
def test_missing_segments_are_gaps_of_their_size(data: bytes, cuts: list[int], lost: set[int], first: int) -> None:
    stream = begun(first)
    found: list[StreamPart] = []
    kept = [each for index, each in enumerate(pieces(data, cuts)) if index not in lost]
    for at, piece in kept:
        found += stream.segment((first + at) % 2**32, piece, 0, 1, 0.0)
    found += stream.finish()
    at = 0
    for each in told(found):
        if isinstance(each, bytes):
            assert data[at : at + len(each)] == each
        at += len(each) if isinstance(each, bytes) else each or 0
    assert at == (kept[-1][0] + len(kept[-1][1]) if kept else 0)
