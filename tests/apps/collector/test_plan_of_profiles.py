"""Plans of the ready-made profiles: never dearer than a usual rule, and figures to compare with."""

import pytest
from read_rules import USUAL_RULES, by_joining, seconds_of

from busway.apps.collector.cost import ReadCost, baud_cost, network_cost
from busway.apps.collector.plan import PlainItem, plan_reads
from busway.codes import Table
from busway.config.profiles import DEVICES, PREFIX
from busway.config.profiles.loading import load_profile
from busway.points import ReadRules

BRIDGED = ReadRules(bridge=True)
COSTS = {"9600": baud_cost(9600), "115200": baud_cost(115_200, turnaround=0.005), "tcp": network_cost(0.005)}


def places(profile: str, table: Table | None = None) -> list[PlainItem]:
    points = load_profile(PREFIX + profile, unit=1).described()
    return [
        PlainItem(each.table, each.start, each.width, each.name, each.group)
        for each in points
        if not each.formula and (table is None or each.table is table)
    ]


@pytest.mark.parametrize("profile", DEVICES)
@pytest.mark.parametrize("cost", COSTS)
def test_no_usual_rule_is_cheaper_for_a_real_device(profile: str, cost: str) -> None:
    items = [PlainItem(each.table, each.start, each.width, each.key) for each in places(profile)]
    own = load_profile(PREFIX + profile, unit=1).read.rules()
    for rules in (own, BRIDGED):
        best = plan_reads(items, rules, COSTS[cost])
        assert not best.unreadable
        for name, joins in USUAL_RULES.items():
            assert best.seconds <= seconds_of(by_joining(items, rules, joins), COSTS[cost]) * (1 + 1e-9), name


@pytest.mark.parametrize(
    ("cost", "one_each", "touching", "gap_16", "gap_50", "no_limit", "best"),
    [
        (COSTS["9600"], 1500, 480, 355, 355, 533, 352),
        (COSTS["115200"], 405, 103, 51, 51, 58, 51),
        (COSTS["tcp"], 200, 45, 15, 15, 10, 10),
    ],
)
def test_the_forty_values_of_an_sdm630_in_milliseconds_of_the_line(
    cost: ReadCost, one_each: int, touching: int, gap_16: int, gap_50: int, no_limit: int, best: int
) -> None:
    items = places("sdm630", Table.INPUT_REGISTERS)
    assert len(items) == 40
    found = {
        name: round(1000 * seconds_of(by_joining(items, BRIDGED, joins), cost)) for name, joins in USUAL_RULES.items()
    }
    assert found["one read each"] == one_each
    assert found["touching"] == touching
    assert found["gap 16"] == gap_16
    assert found["gap 50"] == gap_50
    assert found["no gap limit"] == no_limit
    assert round(1000 * plan_reads(items, BRIDGED, cost).seconds) == best
