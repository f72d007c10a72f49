"""``busway query`` and ``busway store`` on a store that is written meanwhile."""

import csv
import io
import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from collected import PUMP, at, filled, read_of

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointDescription, PointGroup, Reason, StateInterval
from busway.apps.collector.store.folder import SEGMENTS
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter


@pytest.fixture
def data(tmp_path: Path) -> Iterator[str]:
    with filled(tmp_path / "data", 3) as writer:
        writer.commit([read_of(PUMP, 3, 2**63)], [], at(3))
        writer.commit([], [StateInterval("pump-1", at(4), None, Reason.SUSPENDED)], at(4))
        yield str(tmp_path / "data")


def test_samples_are_lines_with_time_point_value_quality_and_reason(run: Callable[..., Any], data: str) -> None:
    result = run("query", data, "meter-7/voltage", "pump-1")
    assert result.code == 0
    assert [line.split() for line in result.out.splitlines()[-2:]] == [
        ["2027-01-15T08:00:03.000Z", "pump-1/speed", "9223372036854775808", "good"],
        ["2027-01-15T08:00:04.000Z", "pump-1/speed", "–", "bad", "device", "suspended"],
    ]
    header, first = result.out.splitlines()[:2]
    assert header.split() == ["time", "point", "value", "quality", "reason"]
    assert first.split() == ["2027-01-15T08:00:00.000Z", "meter-7/voltage", "230", "good"]


def test_the_columns_of_a_long_table_are_named_once(
    run: Callable[..., Any], data: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.cli.query._CHUNK", 2)
    assert [line.split()[0] for line in run("query", data, "meter-7/voltage").out.splitlines()].count("time") == 1


def test_a_point_of_type_float32_is_shown_with_the_digits_of_that_type(run: Callable[..., Any], tmp_path: Path) -> None:
    """0.1 in a float32; beside it a point of another type that holds the same number, and one that has changed."""
    single = struct.unpack(">f", struct.pack(">f", 0.1))[0]
    group = PointGroup("d", ("single", "double", "changed"))
    folder = str(tmp_path / "data")
    with StoreWriter(folder, now=at(0)) as writer:
        described = [PointDescription("d", name, is_float32=name != "double") for name in group.points]
        writer.describe_points(described)
        writer.commit([read_of(group, 1, single, single, 0.30000000000000004)], [], at(1))
        wanted = {"single": 0.1, "double": 0.10000000149011612, "changed": 0.30000000000000004}
        rows = [json.loads(line) for line in run("query", folder, "--json").out.splitlines()]
        assert {row["point"]: row["value"] for row in rows} == {f"d/{name}": value for name, value in wanted.items()}
        csv_rows = list(csv.DictReader(io.StringIO(run("query", folder, "--csv").out)))
        assert {row["point"]: float(row["value"]) for row in csv_rows} == {f"d/{k}": v for k, v in wanted.items()}
        assert [line.split()[2] for line in run("query", folder).out.splitlines()[1:]] == ["0.1", "0.1000000015", "0.3"]
        rows = [json.loads(line) for line in run("query", folder, "--bucket", "1m", "--json").out.splitlines()]
        assert {row["point"]: (row["minimum"], row["maximum"]) for row in rows} == {
            f"d/{name}": (value, value) for name, value in wanted.items()
        }
        writer.describe_points([PointDescription("d", "single")])
        assert {each.point for each in Store(folder).points() if each.is_float32} == {"changed"}


def test_where_nothing_fits_that_is_said_on_stderr(run: Callable[..., Any], data: str) -> None:
    result = run("query", data, "meter-7/voltage", "--since", "2030-01-01")
    assert (result.code, result.out, result.err) == (0, "", "busway: the store has nothing that fits\n")
    assert run("query", data, "meter-7/voltage", "--since", "2030-01-01", "--quiet").err == ""


def test_json_has_nanoseconds_and_csv_a_header(run: Callable[..., Any], data: str) -> None:
    lines = run("query", data, "--points", "*/current", "--json", "--until", "2027-01-15T08:00:02").out.splitlines()
    assert [json.loads(line)["value"] for line in lines] == [0.0, 1.0]
    assert json.loads(lines[1]) == {
        "time": "2027-01-15T08:00:01.000000000Z",
        "point": "meter-7/current",
        "value": 1.0,
        "quality": "good",
        "reason": "",
        "half_width": 0.005,
    }
    rows = list(csv.DictReader(io.StringIO(run("query", data, "pump-1", "--csv").out)))
    assert [row["value"] for row in rows] == ["9223372036854775808", ""]
    assert rows[1]["reason"] == "device suspended"


def test_buckets(run: Callable[..., Any], data: str) -> None:
    out = run("query", data, "meter-7/current", "--bucket", "2s", "--csv").out
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [(row["minimum"], row["maximum"], row["mean"], row["count"]) for row in rows] == [
        ("0.0", "1.0", "0.5", "2"),
        ("2.0", "2.0", "2.0", "1"),
    ]


def test_the_journal_of_alarms_is_lines_with_limit_event_value_and_who(run: Callable[..., Any], tmp_path: Path) -> None:
    folder = tmp_path / "alarms"
    raised = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(1), 90.5, "", True, "above 80 rpm")
    acknowledged = replace(raised, kind=AlarmEventKind.ACKNOWLEDGED, at=at(2), value=None, by="anna")
    with filled(folder, 1) as writer:
        writer.commit([read_of(PUMP, 1, 90.5)], [], at(1), [raised])
        writer.roll()
        writer.commit([], [], at(2), [acknowledged])
        out = run("query", str(folder), "--alarms", "--json").out.splitlines()
        assert [(json.loads(line)["event"], json.loads(line)["by"]) for line in out] == [
            ("raised", ""),
            ("acknowledged", "anna"),
        ]
        rows = list(csv.DictReader(io.StringIO(run("query", str(folder), "pump-1", "--alarms", "--csv").out)))
        assert (rows[0]["value"], rows[0]["text"], rows[0]["limit"]) == ("90.5", "above 80 rpm", "H")
        table = run("query", str(folder), "--alarms", "--since", "2027-01-15T08:00:02").out.split()
        assert table[:7] == ["time", "point", "limit", "event", "value", "text", "by"]
        assert table[7:] == [
            "2027-01-15T08:00:02.000Z",
            "pump-1/speed",
            "H",
            "acknowledged",
            "–",
            "above",
            "80",
            "rpm",
            "anna",
        ]
        assert run("query", str(folder), "meter-7", "--alarms").out == ""
        assert run("query", str(folder), "--alarms", "--bucket", "1m").code == 2


def test_the_points_are_listed(run: Callable[..., Any], data: str) -> None:
    assert [line.strip() for line in run("query", data, "--list").out.splitlines()] == [
        "point            unit of measure",
        "meter-7/voltage",
        "meter-7/current",
        "meter-7/state",
        "pump-1/speed",
    ]


def test_a_parquet_file_is_written_and_never_overwritten(run: Callable[..., Any], data: str, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    target = tmp_path / "x.parquet"
    assert run("query", data, "--parquet", str(target)).err == f"busway: {target} has 11 rows\n"
    assert pq.read_table(target).num_rows == 11
    result = run("query", data, "--parquet", str(target))
    assert (result.code, "exists already" in result.err) == (2, True)


def test_a_file_that_another_program_makes_in_the_meantime_is_left_alone(
    run: Callable[..., Any], data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow.parquet")
    target = tmp_path / "x.parquet"
    target.write_text("of another program")
    there = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: path != target and there(path))
    result = run("query", data, "--parquet", str(target))
    assert (result.code, "exists already" in result.err) == (2, True)
    assert target.read_text() == "of another program"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nothing"], "there is no store in this folder"),
        (["DATA", "meter-9"], "names no point of this store"),
        (["DATA", "--since", "soon"], "'soon' is no time"),
        (["DATA", "--bucket", "big"], "a bucket is 1ms to 366d"),
        (["DATA", "--json", "--csv"], "one of --json, --csv and --parquet"),
    ],
)
def test_wrong_use_is_one_sentence(run: Callable[..., Any], data: str, arguments: list[str], says: str) -> None:
    result = run("query", *(data if argument == "DATA" else argument for argument in arguments))
    assert (result.code, result.out) == (2, "")
    assert says in result.err


def test_a_store_is_checked_backed_up_and_restored(run: Callable[..., Any], data: str, tmp_path: Path) -> None:
    assert run("store", "check", data).out == f"{data} is whole\n"
    assert run("store", "backup", data, str(tmp_path / "copy")).out == f"1 part is in {tmp_path / 'copy'}\n"
    assert run("store", "restore", str(tmp_path / "copy"), str(tmp_path / "again")).code == 0
    assert run("query", str(tmp_path / "again")).out == run("query", data).out
    next((tmp_path / "copy" / SEGMENTS).iterdir()).write_bytes(b"no database" * 1000)
    result = run("store", "check", str(tmp_path / "copy"))
    assert (result.code, "cannot be read" in result.err) == (6, True)
    assert f"{tmp_path / 'copy'} has 1 problem:" in result.err
    assert run("store", "mend", data).code == 2
    assert run("store", "backup", data).code == 2
