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


def when_parts_are_listed(writer: StoreWriter, monkeypatch: pytest.MonkeyPatch, do: Callable[[], None]) -> None:
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
