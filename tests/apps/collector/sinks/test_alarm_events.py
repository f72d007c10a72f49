"""Events of alarms on their way to sinks: behind their samples, at least once, with a key that is the same again."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import pytest
from collected import PUMP, at, read_of
from deliveries import RecordingSink, delivery_to, run_until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind, alarms_after
from busway.apps.collector.sinks.delivery import ASIDE, Delivery, DeliveryOptions
from busway.apps.collector.sinks.documents import alarm_document
from busway.apps.collector.sinks.interface import SinkDown, SinkRefused
from busway.apps.collector.sinks.prometheus import LastValues, PrometheusPage
from busway.apps.collector.store.committed_samples import CommittedAlarm
from busway.apps.collector.store.writer import StoreWriter

RAISED = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(1), 90.0, "", True, "above 80 rpm")
ACKNOWLEDGED = replace(RAISED, kind=AlarmEventKind.ACKNOWLEDGED, at=at(2), value=None, by="anna")
CLEARED = replace(RAISED, kind=AlarmEventKind.CLEARED, at=at(3), value=70.0)


class AlarmRecordingSink(RecordingSink):
    """Takes events of alarms too."""

    def __init__(self) -> None:
        super().__init__()
        self.order: list[str] = []
        self.alarms: list[CommittedAlarm] = []
        self.fails_with: list[Exception] = []
        self.refused: AlarmEvent | None = None

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        if self.refused in [each.event for each in alarms]:
            raise SinkRefused("no stream")
        self.order += [f"{each.event.kind} after {len(self.taken)}" for each in alarms]
        self.alarms += alarms
        if self.fails_with:
            raise self.fails_with.pop(0)


def journalled(folder: Path) -> StoreWriter:
    writer = StoreWriter(folder, now=at(0))
    writer.commit([read_of(PUMP, 1, 90.0)], [], at(1), [RAISED])
    writer.commit([], [], at(2), [ACKNOWLEDGED])
    writer.commit([read_of(PUMP, 3, 70.0)], [], at(3), [CLEARED])
    return writer


@pytest.mark.parametrize("state", ["open", "closed", "sealed"])
async def test_events_come_once_behind_their_samples_whatever_the_segment_is(tmp_path: Path, state: str) -> None:
    if state == "sealed":
        pytest.importorskip("pyarrow")
    with journalled(tmp_path) as writer:
        if state != "open":
            writer.roll()
        if state == "sealed":
            writer.seal_closed()
        sink = AlarmRecordingSink()
        await run_until(delivery_to(sink, writer), lambda: len(sink.alarms) == 3)
        assert [each.event for each in sink.alarms] == [RAISED, ACKNOWLEDGED, CLEARED]
        assert len(sink.taken) == 2
        writer.commit([], [], at(4), [RAISED])
        await run_until(delivery_to(sink, writer), lambda: len(sink.alarms) == 4)


async def test_an_event_comes_again_with_the_same_key_where_the_answer_was_lost(tmp_path: Path) -> None:
    with journalled(tmp_path) as writer:
        sink = AlarmRecordingSink()
        sink.fails_with = [SinkDown("gone")]
        await run_until(delivery_to(sink, writer), lambda: len(sink.alarms) == 6)
        keys = [alarm_document(each).key for each in sink.alarms]
        assert keys[:3] == keys[3:]
        assert len(set(keys)) == 3


async def delivered_but_for_one(writer: StoreWriter) -> Delivery:
    """The delivery to a sink that refuses one event, after all others have arrived."""
    sink = AlarmRecordingSink()
    sink.refused = ACKNOWLEDGED
    delivery = delivery_to(sink, writer)
    await run_until(delivery, lambda: len(sink.alarms) == 2)
    assert [each.event for each in sink.alarms] == [RAISED, CLEARED]
    return delivery


async def test_an_event_that_is_refused_is_found_and_set_aside_and_all_others_arrive(tmp_path: Path) -> None:
    with journalled(tmp_path) as writer:
        delivery = await delivered_but_for_one(writer)
        (line,) = map(json.loads, (tmp_path / ASIDE / "sink.jsonl").read_text().splitlines())
        assert (line["event"], line["error"]) == ("acknowledged", "no stream")
        assert (delivery.status().set_aside, delivery.status().error) == (1, "no stream")


async def test_an_event_that_is_refused_and_cannot_be_set_aside_holds_no_other(tmp_path: Path) -> None:
    (tmp_path / ASIDE).write_text("no folder, so nothing can be written into it")
    with journalled(tmp_path) as writer:
        delivery = await delivered_but_for_one(writer)
        assert delivery.status().set_aside == 1
        assert (delivery.status().error or "").startswith("no stream; it cannot be set aside: ")


async def test_a_sink_gets_events_of_its_points_only_and_one_that_takes_none_gets_samples(tmp_path: Path) -> None:
    with journalled(tmp_path) as writer:
        other, plain = AlarmRecordingSink(), RecordingSink()
        delivery = delivery_to(other, writer, DeliveryOptions(age=0.0, points=("meter-7/*",)), "other")
        await run_until(delivery, lambda: delivery.status().cursor >= 4)
        assert other.alarms == []
        await run_until(delivery_to(plain, writer, name="plain"), lambda: len(plain.taken) == 2)


def test_a_document_of_an_event_says_what_happened_when_and_by_whom() -> None:
    assert json.loads(alarm_document(CommittedAlarm(7, 1, ACKNOWLEDGED)).encode()) == {
        "device": "pump-1",
        "point": "speed",
        "limit": "H",
        "event": "acknowledged",
        "time": at(2),
        "value": None,
        "text": "above 80 rpm",
        "by": "anna",
        "key": "alarm-7-1-cb7cb4d1d7a24a31",
    }


def test_prometheus_sees_active_and_unacknowledged_alarms_of_its_points() -> None:
    pytest.importorskip("prometheus_client")
    alarms = list(alarms_after([RAISED, CLEARED, replace(RAISED, limit="HH"), replace(RAISED, device="x")]).values())
    page = PrometheusPage("127.0.0.1:0", ["pump-1/*"], LastValues(), alarms=lambda: alarms)
    try:
        shown = urlopen(page.url, timeout=60).read().decode()
    finally:
        page.close()
    assert 'busway_alarm_active{device="pump-1",limit="HH",point="speed"} 1.0' in shown
    assert 'busway_alarm_active{device="pump-1",limit="H"' not in shown
    assert 'busway_alarm_unacknowledged{device="pump-1",limit="H",point="speed"} 1.0' in shown
    assert 'device="x"' not in shown
