"""Which samples are handed on: the rule of the sink, or else of the point; and the same again after a crash."""

import random
from collections.abc import Sequence
from pathlib import Path

import pytest
from collected import METER, PUMP, at, read_of
from deliveries import RecordingSink, delivery_to, run_until

from busway.apps.collector.samples import Reason
from busway.apps.collector.sinks.delivery import Delivery, DeliveryOptions
from busway.apps.collector.sinks.documents import documents, sample_key
from busway.apps.collector.sinks.interface import SinkDown, SinkRefused
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule

EVERY = ReportRule()
CHANGE = ReportRule("change")
SAMPLES = [(0, 100.0, 0), (1, 100.0, 0), (2, 100.5, 0), (3, 103.0, 0), (4, 103.0, 3), (5, 103.0, 0), (30, 103.0, 0)]


async def handed_on(folder: Path, sink_rule: ReportRule | None, point_rule: ReportRule) -> list[int]:
    """Seconds of the samples that a sink gets of `SAMPLES`, each in a commit of its own."""
    with StoreWriter(folder, now=at(-1)) as writer:
        for second, value, reason in SAMPLES:
            writer.commit([read_of(PUMP, second, value, reasons=reason)], [], at(second))
        last = writer.commit([], [], at(31)).number
        sink = RecordingSink()
        delivery = delivery_to(sink, writer, DeliveryOptions(age=0.0, report=sink_rule))
        delivery.set_points(None, {("pump-1", "speed"): point_rule})
        await run_until(delivery, lambda: delivery.status().cursor >= last)
        return [(sample.time - at(0)) // 1_000_000_000 for sample in sink.taken]


@pytest.mark.parametrize(
    ("sink", "point", "seconds"),
    [
        (None, EVERY, [0, 1, 2, 3, 4, 5, 30]),
        (None, CHANGE, [0, 2, 3, 4, 5]),
        (EVERY, CHANGE, [0, 1, 2, 3, 4, 5, 30]),
        (CHANGE, EVERY, [0, 2, 3, 4, 5]),
        (CHANGE, ReportRule("change", deadband=5.0), [0, 2, 3, 4, 5]),
        (ReportRule("change", deadband=0.5), EVERY, [0, 3, 4, 5]),
        (None, ReportRule("change", deadband=1.0), [0, 3, 4, 5]),
        (None, ReportRule("change", deadband=3.0, percent=True), [0, 4, 5]),
        (ReportRule("change", max_silence=25.0), CHANGE, [0, 2, 3, 4, 5, 30]),
        (ReportRule("change", max_silence=25.1), CHANGE, [0, 2, 3, 4, 5]),
        (ReportRule("change_or_period", period=20.0), EVERY, [0, 2, 3, 4, 5, 30]),
        (ReportRule("change", deadband=1e9), EVERY, [0, 4, 5]),
    ],
)
async def test_the_rule_of_the_sink_holds_or_else_that_of_the_point(
    tmp_path: Path, sink: ReportRule | None, point: ReportRule, seconds: list[int]
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
        await run_until(delivery, lambda: len(sink.taken) >= 5)
        assert [sample.reason for sample in sink.taken] == [0, Reason.TIMEOUT, Reason.NO_CONNECTION, 256 + 2, 0]


async def test_a_sink_that_has_all_again_begins_to_compare_anew(tmp_path: Path) -> None:
    key = ("pump-1", "speed")
    with StoreWriter(tmp_path, now=at(-1)) as writer:
        sink = RecordingSink()
        delivery = delivery_to(sink, writer)
        for second, (rule, value) in enumerate(
            ((CHANGE, 1.0), (CHANGE, 1.0), (EVERY, 2.0), (CHANGE, 1.0), (CHANGE, 1.0))
        ):
            delivery.set_points(None, {key: rule})
            writer.commit([read_of(PUMP, second, value)], [], at(second))
            await finished(delivery)
        assert [sample.value for sample in sink.taken] == [1.0, 2.0, 1.0]


class ChancySink(RecordingSink):
    """Refuses, or fails after it has taken a batch, by chance; notes the content of each key."""

    def __init__(self, chance: random.Random) -> None:
        super().__init__()
        self.chance = chance
        self.contents: dict[str, set[object]] = {}

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        if len(samples) > 1 and self.chance.random() < 0.1:
            raise SinkRefused("the batch is too large")
        for document in documents(samples):
            self.contents.setdefault(document.key, set()).add(document.encode())
        for sample in samples:
            self.contents.setdefault(sample_key(sample), set()).add(sample)
        await super().send(samples)
        if self.chance.random() < 0.3:
            raise SinkDown("the connection ended before the answer")


async def finished(delivery: Delivery) -> None:
    while True:
        try:
            if not await delivery.step():
                return
        except SinkDown:
            await delivery._down(SinkDown("again"))


@pytest.mark.parametrize("seed", range(6))
async def test_after_crashes_the_same_samples_come_again_under_the_same_keys(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    rules = {("meter-7", "voltage"): ReportRule("change", deadband=2.0), ("meter-7", "state"): CHANGE}
    with StoreWriter(tmp_path, now=at(-1)) as writer:
        for second in range(60):
            reads = [
                read_of(METER, second + part / 4, chance.randrange(6), second, chance.choice(("on", "on", "off")))
                for part in range(3)
            ]
            writer.commit(reads, [], at(second + 0.9))
        plain = RecordingSink()
        undisturbed = delivery_to(plain, writer, DeliveryOptions(age=0.0), "plain")
        undisturbed.set_points(None, rules)
        await finished(undisturbed)
        sink = ChancySink(chance)
        for _ in range(200):  # each is a process that ends somewhere
            options = DeliveryOptions(age=0.0, most=chance.choice((1, 7, 30, 500)))
            delivery = delivery_to(sink, writer, options)
            delivery.set_points(None, rules)
            try:
                if not await delivery.step():
                    break
            except SinkDown:
                continue
    assert all(len(contents) == 1 for contents in sink.contents.values())
    assert list(dict.fromkeys(sink.taken)) == plain.taken
    assert len(plain.taken) < 540


def test_halves_of_a_read_have_keys_of_their_own() -> None:
    read = [CommittedSample(7, "meter-7", point, at(1), 5, 1.0, 0) for point in ("a", "b", "c")]
    keys = [document.key for part in (read, read[:1], read[1:]) for document in documents(part)]
    assert len(set(keys)) == 3
    assert keys == [document.key for part in (read, read[:1], read[1:]) for document in documents(part)]
