"""What sinks write: documents, files, lines for InfluxDB, and last values for Prometheus."""

import asyncio
import csv
import json
import math
import os
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from collected import METER, NOON, PUMP, SECOND, at, filled, meter_read, read_of
from deliveries import commit_reads, delivery_to, run_until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch, StateInterval, exception_reason
from busway.apps.collector.sinks.delivery import DeliveryOptions
from busway.apps.collector.sinks.documents import documents, sample_document
from busway.apps.collector.sinks.files import FileSink
from busway.apps.collector.sinks.influxdb import InfluxSink, line_of
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.prometheus import LastValues, PrometheusPage
from busway.apps.collector.store.committed_samples import CommittedAlarm, CommittedSample
from busway.apps.collector.store.writer import Commit
from busway.errors import ConfigError, MissingExtra


def sample(point: str, value: object, reason: int = 0, *, commit: int = 1, device: str = "d") -> CommittedSample:
    return CommittedSample(commit, device, point, at(1), 5, value, reason)  # type: ignore[arg-type]


def test_a_document_has_one_device_and_commit_and_says_what_is_not_good() -> None:
    found = list(
        documents(
            [
                sample("a", 1.5),
                sample("b", 2, Reason.HELD),
                sample("c", None, exception_reason(2)),
                sample("a", math.nan, device="e"),
                sample("a", 3, commit=2),
            ]
        )
    )
    assert [(each.device, each.content["reads"][0]["values"]) for each in found] == [
        ("d", {"a": 1.5, "b": 2}),
        ("e", {"a": "nan"}),
        ("d", {"a": 3}),
    ]
    first = json.loads(found[0].encode())["reads"][0]
    assert first["uncertain"] == {"b": "held"}
    assert first["bad"]["c"].startswith("exception 02")
    assert len({each.key for each in found}) == 3


def test_a_document_of_a_fleet_has_the_revision_of_its_configuration() -> None:
    one = CommittedSample(7, "pump", "speed", 1, 0, 2.0, 0, "rpm")
    other = one._replace(revision=12, value=3.0)
    plain, fleet = documents([other, one])
    assert "revision" not in plain.content
    assert (plain.content["reads"][0]["values"], fleet.content["reads"][0]["values"]) == (
        {"speed": 2.0},
        {"speed": 3.0},
    )
    assert fleet.content["revision"] == 12
    assert plain.key != fleet.key
    assert ("revision" in sample_document(one), sample_document(other)["revision"]) == (False, 12)


def test_the_key_of_a_document_is_the_same_at_a_repetition() -> None:
    samples = [sample("a", 1), sample("b", 2)]
    assert [each.key for each in documents(samples)] == [each.key for each in documents(samples)]


async def test_lines_are_appended_and_a_cut_line_is_ended_first(tmp_path: Path) -> None:
    target = tmp_path / "out" / "samples-{date}.csv"
    with filled(tmp_path / "store", 2) as writer:
        delivery = delivery_to(FileSink(target), writer)
        await run_until(delivery, lambda: delivery.status().sent == 6)
        (path,) = target.parent.iterdir()
        assert path.name == "samples-2027-01-15.csv"
        with path.open("a") as file:
            file.write("18000000020000")  # a crash in the middle of a line
        commit_reads(writer, 2, 1)
        await run_until(delivery, lambda: delivery.status().sent == 9)
    rows = [row for row in csv.DictReader(path.read_text().splitlines()) if row["device"]]
    assert [row["value"] for row in rows if row["point"] == "current"] == ["0", "1", "2"]
    assert rows[0]["quality"] == "good"


@pytest.mark.parametrize("name", ["samples.csv", "parquet"])
async def test_new_files_and_folders_are_durable_by_their_names_too(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    synced: list[str] = []
    fsync = os.fsync

    def noted(file: int) -> None:
        synced.append(os.path.relpath(os.readlink(f"/proc/self/fd/{file}"), tmp_path))
        fsync(file)

    monkeypatch.setattr(os, "fsync", noted)
    sink = FileSink(tmp_path / "a" / "b" / name, "csv" if name.endswith("csv") else "parquet")
    await sink.send([sample("p", 1.0)])
    folder = "a/b" if name.endswith("csv") else f"a/b/{name}"
    assert {".", "a", folder} <= set(synced)
    assert synced[-1] == folder, "the name comes after the content"
    if name.endswith("csv"):
        synced.clear()
        await sink.send([sample("p", 2.0)])
        assert synced == ["a/b/samples.csv"]


def test_files_in_parquet_need_pyarrow_at_once_and_lines_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"busway\[store\]") as caught:
        FileSink(tmp_path, "parquet")
    assert caught.value.package == "pyarrow"
    FileSink(tmp_path / "samples.csv")
    FileSink(tmp_path / "samples.jsonl")


async def test_json_lines(tmp_path: Path) -> None:
    target = tmp_path / "samples.jsonl"
    with filled(tmp_path / "store", 2) as writer:
        delivery = delivery_to(FileSink(target), writer)
        await run_until(delivery, lambda: delivery.status().sent == 6)
    lines = [json.loads(line) for line in target.read_text().splitlines()]
    assert [line["value"] for line in lines if line["point"] == "state"] == ["on", "on"]


async def test_a_parquet_batch_that_comes_again_replaces_its_file(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    with filled(tmp_path / "store", 4) as writer:
        sink = FileSink(tmp_path / "files", "parquet")
        for _ in range(2):
            delivery = delivery_to(sink, writer, DeliveryOptions(age=0, most=6))
            await run_until(delivery, lambda delivery=delivery: delivery.status().sent == 12)  # type: ignore[misc]
            writer.manifest.set_cursor("sink", 0, 0)
    table = pq.read_table(tmp_path / "files")
    assert table.num_rows == 12
    assert sorted(set(table["text"].to_pylist()) - {None}) == ["on"]


async def test_a_parquet_batch_that_comes_again_with_another_end_replaces_its_file(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    with filled(tmp_path / "store", 4) as writer:
        for most in (6, 100):
            delivery = delivery_to(FileSink(tmp_path / "files", "parquet"), writer, DeliveryOptions(age=0, most=most))
            assert await delivery.step() is (most == 6)
            writer.manifest.set_cursor("sink", 0, 0)
    assert pq.read_table(tmp_path / "files").num_rows == 12


@pytest.mark.parametrize("name", ["samples-{date}.csv", "samples.jsonl", "samples.parquet"])
def test_events_of_alarms_have_files_of_their_own(tmp_path: Path, name: str) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    raised = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(1), 90.5, "", True, 'above "80"')
    off = replace(raised, kind=AlarmEventKind.ACKNOWLEDGED, value=None, by="anna")
    sink = FileSink(tmp_path / name)
    for _ in range(2):  # they come again
        asyncio.run(sink.send_alarms([CommittedAlarm(7, 0, raised), CommittedAlarm(7, 1, off)]))
    if name.endswith("parquet"):
        rows = pq.read_table(tmp_path / name / "alarms").to_pylist()
        assert [(row["event"], row["value"], row["by"]) for row in rows] == [
            ("raised", 90.5, ""),
            ("acknowledged", None, "anna"),
        ]
        return
    (path,) = tmp_path.iterdir()
    assert path.name == ("samples-2027-01-15-alarms.csv" if "csv" in name else "samples-alarms.jsonl")
    lines = path.read_text().splitlines()
    rows = list(csv.DictReader(lines)) if "csv" in name else list(map(json.loads, lines))
    assert [(row["limit"], row["event"], row["text"], row["by"]) for row in rows] == 2 * [
        ("H", "raised", 'above "80"', ""),
        ("H", "acknowledged", 'above "80"', "anna"),
    ]


async def test_parquet_batches_of_another_length_leave_no_sample_twice(tmp_path: Path) -> None:
    """As after a crash that took the cursor: what was sent by five, then five, then five comes again by eight."""
    pq = pytest.importorskip("pyarrow.parquet")
    samples = [sample("a", number, commit=number) for number in range(1, 16)]
    before, after = FileSink(tmp_path, "parquet"), FileSink(tmp_path, "parquet")
    for start in (0, 5, 10):
        await before.send(samples[start : start + 5])
    for start in (0, 8):
        await after.send(samples[start : start + 8])
        values = pq.read_table(tmp_path)["value"].to_pylist()
        assert len(values) == len(set(values))
    assert sorted(values) == list(range(1, 16))
    assert sorted(os.listdir(tmp_path)) == ["000000000001.parquet", "000000000009.parquet"]


async def test_a_folder_that_cannot_be_written_is_a_sink_that_is_down(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SinkDown, match="cannot be written"):
        await FileSink(tmp_path / "file" / "x.csv").send([sample("a", 1)])


@pytest.mark.parametrize(
    ("point", "value", "reason", "line"),
    [
        ("a", 1.5, 0, "m,device=d,point=a value=1.5,reason=0i"),
        ("a b,c=d", 7, 0, "m,device=d,point=a\\ b\\,c\\=d value=7.0,reason=0i"),
        ("a", True, Reason.HELD, "m,device=d,point=a value=1.0,reason=1i"),
        ("a", 'say "x"\\\n', 0, 'm,device=d,point=a text="say \\"x\\"\\\\\\n",reason=0i'),
        ("a", None, Reason.TIMEOUT, "m,device=d,point=a reason=16i"),
        ("a", math.inf, 0, "m,device=d,point=a reason=0i"),
    ],
)
def test_a_sample_in_line_protocol(point: str, value: object, reason: int, line: str) -> None:
    assert line_of(sample(point, value, reason), "m") == f"{line} {at(1)}"


class LineServer(ThreadingHTTPServer):
    """Answers as InfluxDB does: 204, 400 for a batch with a refused line, 503 while it is told to be down."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), LineHandler)
        self.lines: list[str] = []
        self.asked: list[tuple[str, str | None]] = []
        self.is_down = False


class LineHandler(BaseHTTPRequestHandler):
    server: LineServer

    def do_POST(self) -> None:
        lines = self.rfile.read(int(self.headers["Content-Length"])).decode().split("\n")
        self.server.asked.append((self.path, self.headers["Authorization"]))
        refused = any("poison" in line for line in lines)
        status = 503 if self.server.is_down else 400 if refused else 204
        if status == 204:
            self.server.lines += lines
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def lines() -> Iterator[LineServer]:
    with LineServer() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


async def test_lines_arrive_over_http_and_a_server_that_was_busy_gets_all(lines: LineServer, tmp_path: Path) -> None:
    pytest.importorskip("httpx")
    lines.is_down = True
    url = f"http://127.0.0.1:{lines.server_port}/api/v2/write?org=o&bucket=b"
    with filled(tmp_path, 5) as writer:
        writer.commit([read_of(PUMP, 3, "poison")], [], at(6))
        delivery = delivery_to(InfluxSink(url, token="t0ken"), writer)
        await run_until(delivery, lambda: delivery.status().error is not None)
        assert "503" in (delivery.status().error or "")
        lines.is_down = False
        await run_until(delivery, lambda: delivery.status().sent == 15 and delivery.status().set_aside == 1)
    assert len(lines.lines) == 15
    assert lines.asked[0] == ("/api/v2/write?org=o&bucket=b&precision=ns", "Token t0ken")
    assert lines.lines[0].startswith("samples,device=meter-7,point=voltage value=230.0,reason=0i ")


async def test_a_server_that_does_not_answer_in_time_is_told_by_the_kind_of_the_error() -> None:
    httpx = pytest.importorskip("httpx")

    def stays_silent(request: object) -> None:
        raise httpx.ReadTimeout("")

    sink = InfluxSink("http://127.0.0.1:1/write")
    sink._client = httpx.AsyncClient(transport=httpx.MockTransport(stays_silent))
    with pytest.raises(SinkDown, match=r"the server cannot be reached: ReadTimeout$"):
        await sink.send([sample("a", 1.5)])
    await sink.close()


def test_prometheus_gets_last_values_of_listed_points_that_are_neither_bad_nor_stale() -> None:
    pytest.importorskip("prometheus_client")
    values = LastValues()
    values.update(Commit(1, at(1), [meter_read(1, 5), read_of(PUMP, 1, 900)], []))
    values.update(Commit(2, at(2), [meter_read(2, 6)], []))
    moment = at(3)
    page = PrometheusPage("127.0.0.1:0", ["meter-7/*", "pump-1/*"], values, stale=60, now=lambda: moment)
    try:
        text = urllib.request.urlopen(page.url, timeout=60).read().decode()
        assert 'busway_point_value{device="meter-7",point="voltage"} 236.0' in text
        assert 'busway_point_value{device="pump-1",point="speed"} 900.0' in text
        assert "state" not in text, "a text has no number"
        values.update(Commit(3, at(3), [read_of(PUMP, 3, None, reasons=Reason.TIMEOUT)], []))
        assert "pump-1" not in urllib.request.urlopen(page.url, timeout=60).read().decode()
        moment = at(100)
        assert "voltage" not in urllib.request.urlopen(page.url, timeout=60).read().decode()
    finally:
        page.close()
    with pytest.raises(ConfigError, match="names no point"):
        PrometheusPage("127.0.0.1:0", [], values)


def test_a_device_alone_means_all_its_points_on_a_page_for_prometheus() -> None:
    pytest.importorskip("prometheus_client")
    values = LastValues()
    values.update(Commit(1, at(1), [meter_read(1, 5), read_of(PUMP, 1, 900)], []))
    page = PrometheusPage("127.0.0.1:0", ["meter-7"], values, now=lambda: at(2))
    try:
        text = urllib.request.urlopen(page.url, timeout=60).read().decode()
    finally:
        page.close()
    assert 'busway_point_value{device="meter-7",point="voltage"} 235.0' in text
    assert "pump-1" not in text


def test_a_device_alone_means_all_its_points_also_after_the_file_was_read_again() -> None:
    pytest.importorskip("prometheus_client")
    values = LastValues()
    values.update(Commit(1, at(1), [meter_read(1, 5), read_of(PUMP, 1, 900)], []))
    page = PrometheusPage("127.0.0.1:0", ["pump-1"], values, now=lambda: at(2))
    try:
        page.configure(["meter-7"], 60.0)
        text = urllib.request.urlopen(page.url, timeout=60).read().decode()
    finally:
        page.close()
    assert 'busway_point_value{device="meter-7",point="voltage"} 235.0' in text
    assert "pump-1" not in text


def test_a_scrape_needs_no_file_of_the_program_any_more() -> None:
    """An update while the program runs puts other files into their place, and the old program cannot load these."""
    pytest.importorskip("prometheus_client")
    program = """
import sys, urllib.request
from busway.apps.collector.sinks.prometheus import LastValues, PrometheusPage
page = PrometheusPage("127.0.0.1:0", ["*"], LastValues())
before = set(sys.modules)
for accept in ("text/plain", "application/openmetrics-text; version=1.0.0"):
    urllib.request.urlopen(urllib.request.Request(page.url, headers={"Accept": accept}), timeout=60).read()
page.close()
print(*sorted(name for name in set(sys.modules) - before if name.startswith(("busway", "prometheus"))))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == []


def test_last_values_are_bad_while_the_store_cannot_be_written() -> None:
    behind = [False]
    values = LastValues(lambda: behind[0])
    group = PointGroup("meter-7", ("power", "state"))
    values.update(Commit(1, 0, [SampleBatch(group, 5, 0, [1.5, None], [0, Reason.TIMEOUT])], []))
    assert [reason for *_, reason, _ in values.samples()] == [0, Reason.TIMEOUT]
    behind[0] = True
    assert [reason for *_, reason, _ in values.samples()] == [Reason.LOST, Reason.TIMEOUT]
    assert values.last("meter-7", "power") == (1.5, Reason.LOST, 5)


def test_last_values_that_were_not_read_again_when_due_are_held_and_uncertain_for_prometheus() -> None:
    pytest.importorskip("prometheus_client")
    moment = [0.0]
    values = LastValues(limits={("meter-7", "power"): 3.0}, moment=lambda: moment[0])
    group = PointGroup("meter-7", ("power", "load", "state"))
    values.update(Commit(1, 0, [SampleBatch(group, 5, 0, [1.5, 2, None], [0, 0, Reason.TIMEOUT])], []))
    moment[0] = 3.0
    assert [reason for *_, reason, _ in values.samples()] == [0, 0, Reason.TIMEOUT]
    moment[0] = 3.1
    assert [reason for *_, reason, _ in values.samples()] == [0, Reason.HELD, Reason.TIMEOUT]
    assert values.last("meter-7", "power") == (1.5, Reason.HELD, 5)
    page = PrometheusPage("127.0.0.1:0", ["*"], values, now=lambda: 10)
    try:
        text = urllib.request.urlopen(page.url, timeout=60).read().decode()
        assert 'busway_point_uncertain{device="meter-7",point="power"} 1.0' in text
        assert 'busway_point_uncertain{device="meter-7",point="load"}' not in text
    finally:
        page.close()
    values.update(Commit(2, 0, [SampleBatch(group, 6, 0, [1.5, 2, 3], 0)], [], moment=moment[0]))
    assert values.last("meter-7", "power") == (1.5, 0, 6)


def test_a_value_whose_commit_had_to_wait_is_held_by_the_time_of_its_read() -> None:
    moment = [100.0]
    values = LastValues(limits={("meter-7", "power"): 3.0}, moment=lambda: moment[0])
    late = SampleBatch(PointGroup("meter-7", ("power",)), NOON, SECOND, [1.5])
    values.update(Commit(1, NOON + 4 * SECOND, [late], [], moment=100.0))
    assert values.last("meter-7", "power") == (1.5, 0, NOON), "its transaction ended 3 s ago"
    moment[0] += 0.1
    assert values.last("meter-7", "power") == (1.5, Reason.HELD, NOON)


@pytest.mark.parametrize("shift", [-3600 * SECOND, 3600 * SECOND])
def test_last_values_of_before_the_clock_was_set_move_and_later_ones_replace_them(shift: int) -> None:
    values = LastValues()
    alone, other = PointGroup("meter-7", ("power",)), PointGroup("meter-7", ("power", "load"))
    values.update(Commit(1, 0, [SampleBatch(other, NOON, 0, [1.5, 2], Reason.CLOCK)], []))
    values.update(Commit(2, 0, [], [StateInterval("meter-7", NOON - 9, NOON - 1, Reason.SUSPENDED)]))
    correction = ClockCorrection(shift, NOON - 9, NOON + 5)
    values.update(Commit(3, 0, [SampleBatch(alone, NOON + shift + 1, 0, [7])], [], correction=correction))
    assert values.last("meter-7", "power") == (7, 0, NOON + shift + 1)
    assert values.last("meter-7", "load") == (2, 0, NOON + shift)
    assert [reason for *_, reason, _ in values.samples()] == [0, 0]


def test_a_point_that_is_no_longer_in_the_configuration_has_no_last_value() -> None:
    values = LastValues()
    group = PointGroup("meter-7", ("power", "load"))
    values.update(
        Commit(1, 0, [SampleBatch(group, 5, 0, [1.5, 2]), SampleBatch(PointGroup("old", ("a",)), 5, 0, [1])], [])
    )
    values.configure({}, [("meter-7", "load")])
    values.update(
        Commit(2, 0, [SampleBatch(group, 6, 0, [1.5, 2]), SampleBatch(PointGroup("old", ("a",)), 6, 0, [1])], [])
    )
    assert list(values.samples()) == [("meter-7", "load", 2, 0, 6)]
    assert values.last("old", "a") is None
    assert values.last("meter-7", "power") is None


def test_last_values_hold_one_batch_for_each_group() -> None:
    values = LastValues()
    for second in range(100):
        values.update(Commit(second, at(second), [meter_read(second, second)], []))
    assert [found[2] for found in values.samples()] == [99, "on", 329.0]
    assert METER.points == ("voltage", "current", "state")
