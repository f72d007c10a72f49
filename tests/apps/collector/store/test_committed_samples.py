"""What sinks read: nothing is skipped, whatever happens to the parts of the store meanwhile."""

from collections.abc import Callable
from pathlib import Path

import pytest
from collected import at, filled, meter_read

from busway.apps.collector.samples import Reason, StateInterval
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.manifest import StorePart
from busway.apps.collector.store.writer import StoreWriter

pytest.importorskip("pyarrow")


def when_parts_are_listed(writer: StoreWriter, monkeypatch: pytest.MonkeyPatch, do: Callable[[], object]) -> None:
    """Do something once, right after the parts were listed for the first time."""
    real, calls = writer.manifest.parts, []

    def parts() -> list[StorePart]:
        found = real()
        calls.append(found)
        if len(calls) == 1:
            do()
        return found

    monkeypatch.setattr(writer.manifest, "parts", parts)


def test_a_segment_that_is_sealed_while_its_part_is_looked_at_is_not_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with filled(tmp_path, 3) as writer:
        writer.commit([meter_read(4)], [StateInterval("meter-7", at(5), None, Reason.SUSPENDED)], at(5))
        reader = CommitReader(tmp_path, writer.manifest)

        def seal() -> None:
            writer.roll()
            writer.seal_closed()

        when_parts_are_listed(writer, monkeypatch, seal)
        found = reader.read(0, 1000)
        assert found is not None
        assert [sample.value for sample in found.samples if sample.point == "voltage" and not sample.reason] == [
            230.0,
            231.0,
            232.0,
            230.0,
        ]


def test_a_segment_that_is_sealed_while_its_samples_are_counted_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with filled(tmp_path, 3) as writer:
        reader = CommitReader(tmp_path, writer.manifest)
        writer.roll()
        when_parts_are_listed(writer, monkeypatch, writer.seal_closed)
        assert reader.count(0, 1000) == 9
    with filled(tmp_path, 3, first=700) as writer:
        reader = CommitReader(tmp_path, writer.manifest)
        last = writer.commit([meter_read(704)], [], at(705)).number
        writer.roll()
        when_parts_are_listed(writer, monkeypatch, writer.seal_closed)
        assert reader.last_before(at(1000), 0) == last


def test_commits_that_are_made_and_sealed_after_the_parts_were_listed_are_not_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with filled(tmp_path, 3) as writer:
        reader = CommitReader(tmp_path, writer.manifest)
        first = reader.read(0, 1000)
        assert first is not None
        writer.roll()

        def commit_and_seal() -> None:
            writer.commit([meter_read(4)], [StateInterval("meter-7", at(5), None, Reason.SUSPENDED)], at(5))
            writer.roll()
            writer.seal_closed()

        when_parts_are_listed(writer, monkeypatch, commit_and_seal)
        found = reader.read(first.last, 1000) or reader.read(first.last, 1000)
        assert found is not None
        assert [sample.value for sample in found.samples if sample.point == "voltage" and not sample.reason] == [230.0]


@pytest.mark.parametrize("seals", [True, False])
def test_a_device_that_falls_silent_after_the_last_sample_of_a_segment_is_told_to_a_sink_that_is_behind(
    tmp_path: Path, seals: bool
) -> None:
    with filled(tmp_path, 3) as writer:
        writer.commit([], [StateInterval("meter-7", at(4), None, Reason.SUSPENDED)], at(5))
        writer.roll()
        assert not seals or writer.seal_closed() == 1
        writer.commit([meter_read(700)], [StateInterval("meter-7", at(4), at(699), Reason.SUSPENDED)], at(700))
        reader = CommitReader(tmp_path, writer.manifest)
        seen: list[tuple[int, int]] = []
        after = 0
        while (found := reader.read(after, 1000)) is not None:
            after = found.last
            seen += [(sample.time, sample.reason) for sample in found.samples if sample.point == "voltage"]
    assert seen == [(at(0), 0), (at(1), 0), (at(2), 0), (at(4), Reason.SUSPENDED), (at(700), 0)]
