"""Which points of a store patterns mean, and of which devices points are read for that."""

from itertools import product
from pathlib import Path
from random import Random

import pytest
from collected import NOON, at, read_of

from busway.apps.collector.samples import PointDescription, PointGroup
from busway.apps.collector.store.selection import chosen_devices, chosen_points
from busway.apps.collector.store.writer import StoreWriter
from busway.errors import InvalidRequest

DEVICES = (
    "meter-7",
    "meter-70",
    "meter",
    "m",
    "hall/meter-7",
    "hall",
    "meter-7/east",
    "t[1]",
    "q*",
    "a?",
    "Ω",
    "Ω\U0001f600",
)
POINTS = ("power", "p", "east/p", "t[1]", "*", "?x", "Ω")


@pytest.fixture
def store(tmp_path: Path) -> StoreWriter:
    writer = StoreWriter(tmp_path, now=NOON)
    writer.commit([read_of(PointGroup(device, POINTS), 1, *[1.0] * len(POINTS)) for device in DEVICES], [], at(1))
    return writer


def patterns() -> list[str]:
    chance = Random(5)
    whole = [f"{device}/{point}" for device, point in product(DEVICES, POINTS)]
    found = [
        *whole,
        *DEVICES,
        "*",
        "*/*",
        "m*",
        "*7/p*",
        "meter-?/*",
        "hall/*",
        "hall/meter-7/*",
        "/",
        "?",
        "nothing/here",
    ]
    for name in whole:
        place = chance.randrange(len(name))
        found += [name[:place] + "*", name[:place] + "?" + name[place + 1 :], "*" + name[place:]]
    return found


def test_points_of_the_chosen_devices_give_what_those_of_all_devices_give(store: StoreWriter) -> None:
    with store:
        every = store.manifest.points()
        for pattern in patterns():
            some = store.manifest.points(chosen_devices(pattern))
            try:
                expected = chosen_points(pattern, every, [])
            except InvalidRequest:
                with pytest.raises(InvalidRequest):
                    chosen_points(pattern, some, [])
                continue
            assert chosen_points(pattern, some, []) == expected, pattern


def test_points_of_other_devices_are_not_read(store: StoreWriter) -> None:
    with store:
        for pattern in ("meter-7/power", "meter-7/p*", "meter-7"):
            found = {point.device for point in store.manifest.points(chosen_devices(pattern))}
            assert found <= {"meter-7", "meter-7/east"}, pattern
        assert {point.device for point in store.manifest.points(chosen_devices(["t[1]/*", "m/p"]))} == {"t[1]", "m"}


def test_a_former_name_of_a_point_is_found_among_those_of_its_device(store: StoreWriter) -> None:
    with store:
        store.describe_points([PointDescription("hall", "force", was="power")])
        former = store.manifest.former_names()
        some = store.manifest.points(chosen_devices("hall/power"))
        assert [point.name for point in chosen_points("hall/power", some, former)] == ["hall/force"]


@pytest.mark.parametrize("pattern", ["*", "*/power", "?eter/*", "\udcff/*", "a\0b/*"])
def test_patterns_that_name_no_device_by_its_first_characters_choose_all(pattern: str) -> None:
    assert chosen_devices(pattern) is None
    assert chosen_devices(["meter-7/*", pattern]) is None


def test_very_many_patterns_choose_all_devices() -> None:
    assert chosen_devices([f"meter-{number}/*" for number in range(101)]) is None
