"""When samples are handed on: the rule of the sink and that of the point, deadbands, silence, changes of quality."""

from pathlib import Path

import pytest
from collected import PUMP, at, read_of
from deliveries import RecordingSink, delivery_to, run_until

from busway.apps.collector.samples import Reason
from busway.apps.collector.sinks.delivery import DeliveryOptions
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule

EVERY = ReportRule()
CHANGE = ReportRule("change")
SAMPLES = [(0, 100.0, 0), (1, 100.0, 0), (2, 100.5, 0), (3, 103.0, 0), (4, 103.0, 3), (5, 103.0, 0), (30, 103.0, 0)]


async def handed_on(folder: Path, sink_rule: ReportRule, point_rule: ReportRule) -> list[int]:
    """Seconds of the samples that a sink gets of `SAMPLES`, each in a commit of its own."""
    with StoreWriter(folder, now=at(-1)) as writer:
        for second, value, reason in SAMPLES:
            writer.commit([read_of(PUMP, second, value, reasons=reason)], [], at(second))
        last = writer.commit([], [], at(31)).number
        sink = RecordingSink()
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0.0, report=sink_rule))
        delivery.set_point_rules({("pump-1", "speed"): point_rule})
        await run_until(delivery, lambda: delivery.status().cursor >= last)
        return [(sample.time - at(0)) // 1_000_000_000 for sample in sink.taken]


@pytest.mark.parametrize(
    ("sink", "point", "seconds"),
    [
        (EVERY, EVERY, [0, 1, 2, 3, 4, 5, 30]),
        (CHANGE, EVERY, [0, 2, 3, 4, 5]),
        (EVERY, CHANGE, [0, 2, 3, 4, 5]),
        (ReportRule("change", deadband=1.0), EVERY, [0, 3, 4, 5]),
        (EVERY, ReportRule("change", deadband=1.0), [0, 3, 4, 5]),
        (CHANGE, ReportRule("change", deadband=2.0, percent=True), [0, 3, 4, 5]),
        (ReportRule("change", deadband=5.0), CHANGE, [0, 4, 5]),
        (ReportRule("change", max_silence=20.0), CHANGE, [0, 2, 3, 4, 5, 30]),
        (CHANGE, ReportRule("change", max_silence=20.0), [0, 2, 3, 4, 5, 30]),
        (ReportRule("change_or_period", period=20.0), EVERY, [0, 2, 3, 4, 5, 30]),
        (ReportRule("change_or_period", period=20.0), CHANGE, [0, 2, 3, 4, 5]),
        (ReportRule("change", deadband=1e9), ReportRule("change", deadband=1e9), [0, 4, 5]),
    ],
)
async def test_a_sample_is_handed_on_where_the_sink_and_its_point_say_so(
    tmp_path: Path, sink: ReportRule, point: ReportRule, seconds: list[int]
) -> None:
    assert await handed_on(tmp_path, sink, point) == seconds


async def test_a_change_of_the_quality_always_passes_also_from_bad_to_bad(tmp_path: Path) -> None:
    still = ReportRule("change", deadband=1e9)
    with StoreWriter(tmp_path, now=at(-1)) as writer:
        for second, reason in enumerate((0, Reason.TIMEOUT, Reason.TIMEOUT, Reason.NO_CONNECTION, 256 + 2, 0)):
            value = None if reason else 1.0
            writer.commit([read_of(PUMP, second, value, reasons=int(reason))], [], at(second))
        sink = RecordingSink()
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0.0, report=still))
        delivery.set_point_rules({("pump-1", "speed"): still})
        await run_until(delivery, lambda: len(sink.taken) >= 5)
        assert [sample.reason for sample in sink.taken] == [0, Reason.TIMEOUT, Reason.NO_CONNECTION, 256 + 2, 0]
