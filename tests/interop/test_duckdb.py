"""DuckDB reads the Parquet files of a store by the query of the page."""

import re
from datetime import UTC
from pathlib import Path

import pytest
from collected import NOON, at, filled, read_of

from busway.apps.collector.samples import PointGroup
from busway.apps.collector.store.writer import StoreWriter

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "store.md").read_text("utf-8")
FILES = "'data/segments/*.parquet'"
VALUES = {"real": 1.5, "integer": -(2**53), "large": 2**64 - 2**11, "on": True, "bad": None, "text": "ä"}


@pytest.mark.soak  # what takes long is to install it
def test_the_query_of_the_page_gives_the_means_of_hours(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    pytest.importorskip("pyarrow")
    reasons = [258 if value is None else 0 for value in VALUES.values()]
    filled(tmp_path, 4, step=1800.0).close(at(7200))
    with StoreWriter(tmp_path, now=at(7200)) as writer:
        writer.commit([read_of(PointGroup("d", tuple(VALUES)), 7300, *VALUES.values(), reasons=reasons)], [], at(7300))
        writer.roll()
        writer.seal_closed()
    files = f"'{tmp_path}/segments/*.parquet'"
    (query,) = [each for each in re.findall(r"```sql\n(.*?)```", PAGE, re.DOTALL) if FILES in each]
    rows = duckdb.sql(query.replace(FILES, files)).fetchall()
    means = {
        (device, name, hour.replace(tzinfo=UTC).timestamp() - NOON / 1e9): mean for device, name, hour, mean in rows
    }
    assert means.pop(("d", "text", 7200.0)) is None
    assert ("d", "bad", 7200.0) not in means
    assert means == {
        **{("meter-7", "current", hour * 3600.0): 0.5 + 2 * hour for hour in (0, 1)},
        **{("meter-7", "voltage", hour * 3600.0): 230.5 + 2 * hour for hour in (0, 1)},
        **{("meter-7", "state", hour * 3600.0): None for hour in (0, 1)},
        **{("d", name, 7200.0): float(VALUES[name]) for name in ("real", "integer", "large", "on")},  # type: ignore[arg-type]
    }
    assert duckdb.sql(f"SELECT count(*) FROM {files}").fetchall() == [(4 * 3 + len(VALUES),)]
