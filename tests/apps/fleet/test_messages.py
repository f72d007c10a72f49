import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import (
    Chain,
    SampleMessage,
    UnreadableMessage,
    by_link,
    decode_message,
    longest_head,
    longest_row,
)
from busway.apps.fleet.ownership_gaps import OwnershipGap

msgpack = pytest.importorskip("msgpack")

VALUES = st.one_of(
    st.booleans(), st.integers(-(2**70), 2**70), st.floats(allow_nan=False), st.text(max_size=20), st.none()
)
SAMPLES = st.builds(
    CommittedSample,
    commit=st.integers(1, 2**50),
    device=st.sampled_from(["meter 1", "ü/2"]),
    point=st.text(min_size=1, max_size=8),
    time=st.integers(0, 2**62),
    half_width=st.integers(0, 2**40),
    value=VALUES,
    reason=st.integers(0, 255),
    unit_of_measure=st.sampled_from(["", "V"]),
    revision=st.just(0),
)


def message(samples: list[CommittedSample], **other: object) -> SampleMessage:
    given_: dict[str, object] = {
        "collector": "one",
        "store": "a1",
        "link": "hall",
        "epoch": Epoch(1, 7),
        "revision": 3,
        "complete": 5,
        "kept": 4,
        "samples": samples,
        "chain": Chain(7, 3, 2, is_first=False),
    }
    return SampleMessage(**{**given_, **other})  # type: ignore[arg-type]


@given(st.lists(SAMPLES, max_size=8), st.one_of(st.none(), st.builds(Epoch, st.integers(1, 9), st.integers(1, 2**60))))
def test_a_message_comes_back_as_it_was_with_the_type_of_every_value(
    samples: list[CommittedSample], epoch: Epoch | None
) -> None:
    sent = message(samples, epoch=epoch)
    found = decode_message(sent.encode())
    assert found == sent
    assert [type(each.value) for each in found.samples] == [type(each.value) for each in samples]


@given(st.lists(SAMPLES, max_size=30), st.text(max_size=100))
def test_a_message_is_never_longer_than_computed_before(samples: list[CommittedSample], name: str) -> None:
    known = set[str]()
    bound = longest_head(name, name, name) + sum(longest_row(each, known) for each in samples)
    largest = 2**63 - 1
    chain = Chain(2**48 - 1, largest, largest)
    numbers = {"epoch": Epoch(largest, largest), "revision": largest, "complete": largest, "kept": largest}
    sent = message(samples, collector=name, store=name, link=name, chain=chain, **numbers)
    assert len(sent.encode()) <= bound


@given(st.lists(st.text(max_size=40), max_size=20), st.integers(0, 2**62), st.integers(0, 2**62))
def test_a_gap_comes_back_as_it_was_and_is_not_longer_than_computed_before(
    devices: list[str], begin: int, end: int
) -> None:
    gap = OwnershipGap("hall", Epoch(1, 7), 9, tuple(devices), begin, end)
    sent = message([], gap=gap)
    assert decode_message(sent.encode()) == sent
    assert len(sent.encode()) <= longest_head("one", "a1", "hall", *devices)


@pytest.mark.parametrize("points", [1, 1300])
@pytest.mark.parametrize("value", [0.1, 2**64 - 1, 2**70, "", "x" * 300, None, True])
def test_a_message_of_as_many_of_the_longest_rows_as_it_takes_is_not_longer_than_computed_before(
    points: int, value: float | str | None
) -> None:
    rows = [CommittedSample(2**62, "meter", str(n % points), 2**62, 2**62, value, 2**15, "V") for n in range(1300)]
    known = set[str]()
    bound = longest_head("one", "a1", "hall") + sum(longest_row(each, known) for each in rows)
    assert len(message(rows).encode()) <= bound


def test_numbers_take_most_of_the_room_that_is_computed_for_them() -> None:
    known = set[str]()
    rows = [CommittedSample(2**33, "meter", "power", 2**60 + n, 2**20, 230.5, 0) for n in range(1000)]
    bound = longest_head("one", "a1", "hall") + sum(longest_row(each, known) for each in rows)
    assert bound < 2 * len(message(rows).encode())


FEW_TEXTS = st.sampled_from(["", "V", "W", "1", "a\ud800", "V\0", "\u20ac" * 11, "x" * 40])
FEW_NUMBERS = [
    1,
    0,
    0.0,
    -0.0,
    1.0,
    2**53,
    float(2**53),
    2**63 - 1,
    2**63,
    2**64 - 1,
    2**64,
    float(2**64),
    -(2**63) - 1,
]
EQUAL_VALUES = st.sampled_from(
    [*FEW_NUMBERS, *map(str, FEW_NUMBERS), True, False, "", None, "V", math.nan, math.inf, -math.inf]
)
EQUAL_SAMPLES = st.builds(
    CommittedSample,
    commit=st.sampled_from([1, 2, 2**63 - 1]),
    device=FEW_TEXTS,
    point=FEW_TEXTS,
    time=st.sampled_from([0, 7, 2**63 - 1]),
    half_width=st.sampled_from([0, 7, 2**63 - 1]),
    value=EQUAL_VALUES,
    reason=st.sampled_from([0, 1, 15, 16, 22, 127, 128, 255, 256, 511]),
    unit_of_measure=FEW_TEXTS,
    revision=st.just(0),
)


@given(st.lists(st.one_of(EQUAL_SAMPLES, st.just(CommittedSample(1, "V", "V", 7, 0, 1, 0, "V"))), max_size=40))
def test_names_and_values_that_are_equal_across_devices_points_units_and_types_stay_apart(
    samples: list[CommittedSample],
) -> None:
    """Compared as text: `1`, `1.0` and `True` are equal, a NaN is not, and `-0.0` is another number than `0.0`."""
    sent = message(samples)
    data = sent.encode()
    assert repr(decode_message(data)) == repr(sent)
    assert repr(decode_message(decode_message(data).encode())) == repr(sent), "as sent on once more"
    known = set[str]()
    assert len(data) <= longest_head("one", "a1", "hall") + sum(longest_row(each, known) for each in samples)


@pytest.mark.parametrize("length", [0, 1, 31, 32, 255, 256, 65_536])
@pytest.mark.parametrize("letter", ["x", "\u20ac", "\ud800"])
def test_a_name_of_device_point_and_unit_at_once_is_not_longer_than_computed_before(length: int, letter: str) -> None:
    name = letter * length
    rows = [
        CommittedSample(1, name, name, 1, 0, 1, 0, name),
        CommittedSample(1, name, "p", 1, 0, 1, 0, ""),
        CommittedSample(1, "d", name, 1, 0, 1, 0, "p"),
        CommittedSample(1, "p", "d", 1, 0, name, 0, name),
    ]
    for count in range(len(rows) + 1):
        for first in range(count):
            known = set[str]()
            bound = longest_head(name, name, name) + sum(longest_row(each, known) for each in rows[first:count])
            sent = message(rows[first:count], collector=name, store=name, link=name)
            data = sent.encode()
            assert len(data) <= bound
            assert decode_message(data) == sent


def test_text_with_half_a_pair_of_surrogates_comes_back() -> None:
    sent = message([CommittedSample(1, "d", "p", 1, 0, "a\ud800", 0)])
    assert decode_message(sent.encode()) == sent


@given(st.binary(max_size=60))
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(UnreadableMessage):
        decode_message(data)


def test_bytes_that_are_nested_too_deep_are_refused_by_the_kind_of_the_error() -> None:
    with pytest.raises(UnreadableMessage, match=r"the bytes are no message of samples: StackError$"):
        decode_message(b"\x91" * 2000)


@pytest.mark.parametrize("wrong", [7, "text", [9], None, {"a": 1}])
def test_a_message_with_a_field_of_another_kind_is_refused_or_read_without_another_error(wrong: object) -> None:
    content = msgpack.unpackb(message([CommittedSample(1, "d", "p", 1, 0, 2**70, 0, "V")]).encode())
    for place in range(1, len(content)):
        with suppress(UnreadableMessage):
            decode_message(msgpack.packb([*content[:place], wrong, *content[place + 1 :]]))


def test_names_that_all_samples_have_take_room_once() -> None:
    def of(count: int) -> int:
        rows = [CommittedSample(1, "a long name " * 9, f"p{n % 2}", 1, 0, 1, 0, "a unit " * 9) for n in range(count)]
        return len(message(rows).encode())

    assert of(100) - of(10) < 90 * 12


@pytest.mark.parametrize("points", [255, 256, 257])  # with the names of the device and of the unit two more
@pytest.mark.parametrize("reason", [255, 256])
def test_places_and_reasons_beyond_a_byte_come_back(points: int, reason: int) -> None:
    samples = [CommittedSample(1, "meter", f"p{n}", n, 2, None, reason * (n % 2), "V") for n in range(points)]
    assert decode_message(message(samples).encode()).samples == samples


def test_a_newer_format_is_refused_by_name() -> None:
    with pytest.raises(UnreadableMessage, match="format 5 is not known here"):
        decode_message(msgpack.packb([5, "anything"]))


def test_each_attempt_to_send_a_message_has_a_name_of_its_own() -> None:
    one = message([], chain=Chain(1, 1))
    others = [
        message([], chain=Chain(1, 2)),
        message([], chain=Chain(2, 1)),
        message([], chain=Chain(1, 1), store="b2"),
        message([], chain=Chain(1, 1), collector="two"),
    ]
    assert len({each.name for each in (one, *others)}) == 5


def test_samples_are_grouped_by_link_in_their_order() -> None:
    samples = [CommittedSample(n, f"d{n % 3}", "p", n, 0, n, 0) for n in range(9)]
    found = dict(by_link(samples, {"d0": "a", "d1": "b", "d2": "a"}))
    assert [each.commit for each in found["a"]] == [0, 2, 3, 5, 6, 8]
    assert [each.commit for each in found["b"]] == [1, 4, 7]
