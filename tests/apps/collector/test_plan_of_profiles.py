"""Plans of the ready-made profiles: never dearer than a usual rule, and figures to compare with."""

import random
from dataclasses import replace

import pytest
from read_rules import USUAL_RULES, by_joining, seconds_of

from busway.apps.collector.cost import ReadCost, baud_cost, network_cost
from busway.apps.collector.plan import PlainItem, plan_reads
from busway.codes import Table
from busway.config.profiles import DEVICES, PREFIX
from busway.config.profiles.loading import load_profile
from busway.points import ReadRules

BRIDGED = ReadRules(bridge=True)
COSTS = {"9600": baud_cost(9600), "115200": baud_cost(115_200, response_time=0.005), "tcp": network_cost(0.005)}


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


RULES = ("one read each", "touching", "gap 16", "gap 50", "no gap limit")
PUBLISHED_SDM630 = {
    *range(0x00, 0x24, 2),
    *(0x34, 0x38, 0x3C, 0x3E, 0x42),
    *range(0x46, 0x50, 2),
    *(0xEA, 0xEC, 0xEE, 0xF8),
    *range(0x156, 0x17E, 2),
}
"""The 52 values of an SDM630 that usual programs read, of 85: phases, sums, energies, distortion of voltages."""


def milliseconds(items: list[PlainItem], rules: ReadRules, cost: ReadCost) -> tuple[int, ...]:
    """What a scan takes by each of `RULES`, and by the plan."""
    usual = [seconds_of(by_joining(items, rules, USUAL_RULES[name]), cost) for name in RULES]
    return tuple(round(1000 * seconds) for seconds in (*usual, plan_reads(items, rules, cost).seconds))


@pytest.mark.parametrize(
    ("cost", "wanted", "below_16"),
    [
        ("9600", (1950, 535, 410, 410, 621, 407), 407),
        ("115200", (526, 108, 55, 55, 73, 55), 62),
        ("tcp", (260, 45, 15, 15, 15, 15), 20),
    ],
)
def test_fifty_two_values_of_an_sdm630_in_milliseconds_of_the_line(
    cost: str, wanted: tuple[int, ...], below_16: int
) -> None:
    """The table of others, to the millisecond: their gap 16 joins over fewer than 16 registers, ours over 16 too."""
    items = [each for each in places("sdm630", Table.INPUT_REGISTERS) if each.start in PUBLISHED_SDM630]
    assert len(items) == 52
    assert milliseconds(items, BRIDGED, COSTS[cost]) == wanted
    assert round(1000 * seconds_of(by_joining(items, BRIDGED, lambda gap: gap < 16), COSTS[cost])) == below_16


@pytest.mark.parametrize(
    ("cost", "wanted"),
    [
        ("9600", (3188, 850, 678, 678, 678, 641)),
        ("115200", (860, 169, 91, 91, 91, 88)),
        ("tcp", (425, 70, 25, 25, 25, 25)),
    ],
)
def test_all_values_of_an_sdm630_in_milliseconds_of_the_line(cost: str, wanted: tuple[int, ...]) -> None:
    items = places("sdm630", Table.INPUT_REGISTERS)
    assert len(items) == 85
    own = load_profile(PREFIX + "sdm630", unit=1).read.rules()
    assert milliseconds(items, replace(own, bridge=True), COSTS[cost]) == wanted


def test_values_of_a_sunspec_inverter_in_milliseconds_over_tcp() -> None:
    """Without scale factors and pads, which a program may know: what is left touches seldom."""
    every = places("inverter", Table.HOLDING_REGISTERS)
    values = [each for each in every if not str(each.key).lower().endswith(("_sf", "pad"))]
    assert (len(every), len(values)) == (85, 62)
    assert milliseconds(every, BRIDGED, COSTS["tcp"]) == (425, 10, 10, 10, 10, 10)
    assert milliseconds(values, BRIDGED, COSTS["tcp"]) == (310, 115, 10, 10, 10, 10)


SUNSPEC_RUNS = {
    0: (2, 1, 1, 16, 16, 8, 8, 16, 1),  # the marker; 1 (common)
    70: (1,) * 6,  # 103 (inverter, three phases)
    77: (1,) * 6,
    **dict.fromkeys((84, 86, 88, 90, 92), (1,)),
    94: (2,),
    **dict.fromkeys((97, 99, 101), (1,)),
    103: (1,) * 4,
    108: (1, 1, *(2,) * 6, *(1,) * 23),  # 123 (immediate controls)
    148: (1,) * 18,  # 124 (storage)
    174: (1, 1),  # 160 (several inputs)
    180: (2, 1, 1, *(1, 8, 1, 1, 1, 2, 2, 1, 1, 2) * 3),  # its events, and three inputs
}
"""Width of each value by the first register of those that touch: SunSpec's models 1, 103, 123, 124 and 160 with three
inputs, behind each other as an inverter with a battery has them, without scale factors and pads."""


def test_118_values_of_a_sunspec_inverter_in_milliseconds_over_tcp() -> None:
    items = []
    for start, widths in SUNSPEC_RUNS.items():
        for place, width in enumerate(widths):
            first = start + sum(widths[:place])
            items.append(PlainItem(Table.HOLDING_REGISTERS, first, width, first))
    assert (len(items), max(each.start + each.width for each in items)) == (118, 244)
    assert milliseconds(items, BRIDGED, COSTS["tcp"]) == (590, 85, 10, 10, 10, 10)


def test_two_hundred_values_over_3100_registers_in_milliseconds_over_tcp() -> None:
    """125 places with one value or two touching ones."""
    chance = random.Random(0)
    starts = sorted(chance.sample(range(0, 3100, 4), 125))
    pairs = set(chance.sample(starts, 75))
    items = [
        PlainItem(Table.HOLDING_REGISTERS, start + more, 1, start + more)
        for start in starts
        for more in range(1 + (start in pairs))
    ]
    assert len(items) == 200
    assert milliseconds(items, BRIDGED, COSTS["tcp"]) == (1000, 625, 305, 125, 110, 110)
