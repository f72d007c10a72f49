"""Which events of alarms a store forgets when they are old."""

from dataclasses import replace
from pathlib import Path

from collected import METER, at, read_of

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.store.alarm_events import forget_old_alarms
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter


def test_events_of_a_point_that_is_not_listed_cost_no_event_of_an_active_alarm(tmp_path: Path) -> None:
    raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, at(1), 250.0)
    other = replace(raised, point="current")
    with StoreWriter(tmp_path, now=at(0)) as writer:
        writer.commit([read_of(METER, 1, 250.0, 9.0, "on")], [], at(1), [other, raised])
        writer.roll()
        with writer.manifest.transaction() as database:
            database.execute("DELETE FROM points WHERE point = 'current'")
        assert forget_old_alarms(writer.manifest, at(100)) == 1
        assert Store(tmp_path).alarms() == [raised]
