import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.lease_times import Epoch
from busway.apps.fleet.messages import SampleMessage, UnreadableMessage, by_link, decode_message

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
        "part": 0,
        "round": 0,
        "samples": samples,
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


@given(st.binary(max_size=60))
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(UnreadableMessage):
        decode_message(data)


def test_a_newer_format_is_refused_by_name() -> None:
    with pytest.raises(UnreadableMessage, match="format 3 is not known here"):
        decode_message(msgpack.packb([3, "anything"]))


def test_names_differ_by_link_epoch_store_commits_and_part_and_by_nothing_else() -> None:
    sample = CommittedSample(5, "meter", "power", 1, 0, 1.0, 0)
    later = CommittedSample(6, "meter", "power", 2, 0, 1.0, 0)
    one = message([sample])
    others = [
        message([sample], link="roof"),
        message([sample], epoch=Epoch(1, 8)),
        message([sample], store="b2"),
        message([sample], part=1),
        message([sample], round=1),
        message([sample, later]),
        message([], complete=5),
    ]
    assert len({each.name for each in (one, *others)}) == 8
    assert message([sample], complete=9, kept=9, revision=8).name == one.name


def test_samples_are_grouped_by_link_in_their_order() -> None:
    samples = [CommittedSample(n, f"d{n % 3}", "p", n, 0, n, 0) for n in range(9)]
    found = dict(by_link(samples, {"d0": "a", "d1": "b", "d2": "a"}))
    assert [each.commit for each in found["a"]] == [0, 2, 3, 5, 6, 8]
    assert [each.commit for each in found["b"]] == [1, 4, 7]
