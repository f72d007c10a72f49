"""What one sink of a stream gets: its points, by report rules."""

from collections.abc import Mapping, Sequence

import pytest

from busway.apps.collector.samples import NANOSECONDS, Reason
from busway.apps.collector.sinks.interface import DeviceGap, SinkDown
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.chosen_samples import ChosenSamples
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.codes import Table
from busway.options.sinks import DeliveryOptions
from busway.points.point import Point
from busway.points.point_rules import ReportRule

CHANGE = ReportRule("change", deadband=1.0)


class Taken:
    """A sink that remembers, and can be down."""

    def __init__(self) -> None:
        self.values: list[object] = []
        self.is_down = False

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        if self.is_down:
            raise SinkDown("away")
        self.values += [each.value for each in samples]

    async def close(self) -> None:
        pass


def samples(*values: float, begin: int = 100, point: str = "level") -> list[CommittedSample]:
    return [
        CommittedSample(begin + place, "tank", point, (begin + place) * NANOSECONDS, 0, value, 0, "m")
        for place, value in enumerate(values)
    ]


async def test_a_rule_of_a_point_holds_across_batches() -> None:
    taken = Taken()
    chosen = ChosenSamples(taken, DeliveryOptions(), {("tank", "level"): CHANGE})
    await chosen.send(samples(1.0, 1.5, 2.5))
    await chosen.send(samples(2.6, 3.4, 9.0, begin=200))
    assert taken.values == [1.0, 2.5, 9.0]


async def test_the_rule_of_the_sink_goes_before_that_of_the_point_and_others_get_all() -> None:
    taken = Taken()
    every = ReportRule("change_or_period", period=2.0, deadband=100.0)
    chosen = ChosenSamples(taken, DeliveryOptions(report=every), {("tank", "level"): CHANGE})
    await chosen.send(samples(1.0, 5.0, 2.0, 3.0, 4.0))
    assert taken.values == [1.0, 2.0, 4.0]
    plain = Taken()
    await ChosenSamples(plain, DeliveryOptions(), {}).send(samples(1.0, 1.0))
    assert plain.values == [1.0, 1.0]


async def test_what_a_sink_did_not_take_is_chosen_again() -> None:
    taken = Taken()
    chosen = ChosenSamples(taken, DeliveryOptions(), {("tank", "level"): CHANGE})
    taken.is_down = True
    with pytest.raises(SinkDown):
        await chosen.send(samples(1.0, 5.0))
    taken.is_down = False
    await chosen.send(samples(1.0, 5.0))
    assert taken.values == [1.0, 5.0]


async def test_samples_from_before_the_last_one_are_passed_on_and_change_nothing() -> None:
    taken = Taken()
    chosen = ChosenSamples(taken, DeliveryOptions(), {("tank", "level"): CHANGE})
    await chosen.send(samples(1.0))
    await chosen.send(samples(1.0, 1.0, begin=50))
    await chosen.send(samples(1.0, begin=101))
    assert taken.values == [1.0, 1.0, 1.0]


async def test_only_named_points_reach_the_sink() -> None:
    taken = Taken()
    chosen = ChosenSamples(taken, DeliveryOptions(points=("tank/level",)), {})
    await chosen.send([*samples(1.0), *samples(2.0, point="flow")])
    assert taken.values == [1.0]


def test_a_sink_that_describes_points_to_its_receiver_is_told_those_of_the_configuration() -> None:
    class Described(Taken):
        points: Mapping[tuple[str, str], Point] | None = None

        def describe(self, points: Mapping[tuple[str, str], Point]) -> None:
            self.points = points

    sink, points = Described(), {("tank", "level"): Point("level", Table.HOLDING_REGISTERS, 0)}
    ChosenSamples(sink, DeliveryOptions(), {}, points)
    assert sink.points is points


async def test_the_end_of_an_ownership_that_comes_late_is_passed_on_and_changes_no_comparison() -> None:
    taken = Taken()
    chosen = ChosenSamples(taken, DeliveryOptions(), {("tank", "level"): CHANGE})
    (late,) = samples(0.0, begin=99)
    await chosen.send(samples(1.0))
    await chosen.send([late._replace(value=None, reason=int(Reason.OWNERSHIP))])
    await chosen.send(samples(1.5, begin=101))
    assert taken.values == [1.0, None]


class TakenWithGaps(Taken):
    async def send_gaps(self, gaps: Sequence[DeviceGap]) -> None:
        self.values += [(each.begin // NANOSECONDS, each.end // NANOSECONDS) for each in gaps]


@pytest.mark.parametrize(("kind", "told"), [(Taken, None), (TakenWithGaps, (100, 110))])
async def test_the_first_sample_after_a_gap_of_ownership_passes_every_rule(kind: type[Taken], told: object) -> None:
    """Without it the receiver would not know whether the value from before the gap still held after it."""
    taken, points = kind(), {("tank", "level"): Point("level", Table.HOLDING_REGISTERS, 0)}
    chosen = ChosenSamples(taken, DeliveryOptions(), {("tank", "level"): CHANGE}, points)
    gap = OwnershipGap("hall", Epoch(1, 7), 7, ("tank",), 95 * NANOSECONDS, 110 * NANOSECONDS)
    await chosen.send(samples(1.0))
    await chosen.send(await chosen.send_gap(gap))
    await chosen.send(samples(1.0, 1.0, begin=111))
    await chosen.send_gap(gap)  # it comes again, and nothing after it is forgotten
    await chosen.send(samples(1.0, begin=113))
    assert taken.values == [1.0, told, 1.0, *([told] if told else [])]
