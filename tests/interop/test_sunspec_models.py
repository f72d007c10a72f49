"""All 112 models of the SunSpec repository become device files, and what is not carried over is reported.

The models are those of pysunspec2 (Apache-2.0), which ships the files of the repository.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from foreign import CHECKOUT, missing

from busway.apps.importers.formats import import_file
from busway.apps.importers.imported import ImportedDevice
from busway.apps.importers.sunspec import FIRST_MODEL
from busway.config.files.device import parse_device_file
from busway.errors import ConfigError

COUNTED = {705, 706, 707, 708, 709, 710, 712, 64410, 64411}
"""Models with points behind a group whose size a device says: how often the group is there has to be given."""
POINTS = 3766
"""Points of all models, those of a group once."""


@cache
def models() -> dict[int, Path]:
    """The files of the models by their numbers."""
    folders = list((CHECKOUT / ".peers").glob("lib/python3*/site-packages/sunspec2/models/json"))
    if not folders:
        missing("no pysunspec2 in .peers: run make peers")
    return {int(path.stem.removeprefix("model_")): path for path in folders[0].glob("model_*.json")}


def converted(number: int) -> tuple[ImportedDevice, Any]:
    """What a model becomes: the import, and the unit of its device file as it is read again."""
    path = models()[number]
    found = import_file(str(path), counts={"NPt": 4} if number in COUNTED else {})
    (unit,) = parse_device_file(found.text(path.name), path.name).unit
    return found, unit


def declared(group: Mapping[str, Any], at: int | None) -> Iterator[tuple[str, int | None]]:
    """Names of a model's points and their offsets; None behind a group of a size that is not known here."""
    for point in group.get("points", []):
        if point["type"] != "pad":
            yield point["name"], at
        at = None if at is None else at + point["size"]
    for each in group.get("groups", []):
        inside = list(declared(each, at))
        yield from inside
        at = None


def said(section: Any) -> Iterator[tuple[str, str | None]]:
    """Names and addresses of the points of a unit or group of a device file, with those of its groups."""
    for point in section.point or ():
        yield point.name, point.address
    for each in section.group or ():
        yield from said(each)


def test_every_model_becomes_a_device_file_and_nothing_is_lost_in_silence() -> None:
    assert len(models()) == 112
    points = 0
    for number, path in models().items():
        found, unit = converted(number)
        wanted = list(declared(json.loads(path.read_text("utf-8"))["group"], FIRST_MODEL))
        names, has = Counter(name for name, _ in wanted), Counter(name for name, _ in said(unit))
        reported = Counter(each.where for each in found.omissions if each.where)
        assert names - has == reported, number
        assert all(name.endswith("_count") for name in has - names), number
        places = dict(said(unit))
        for name, at in wanted:
            if at is not None and names[name] == 1 and name not in reported:
                assert places[name] == f"holding:{at}", (number, name)
        points += len(wanted)
    assert points == POINTS


def test_what_is_not_carried_over_are_the_texts_of_150_registers_of_one_model() -> None:
    omitted = {number: [each for each in converted(number)[0].omissions if each.where] for number in models()}
    assert {number for number, found in omitted.items() if found} == {64411}
    assert all("'string:300' needs a length in bytes" in each.why for each in omitted[64411])
    assert len(omitted[64411]) == 9


def test_103_models_need_no_count_and_the_others_say_which() -> None:
    assert set(models()) > COUNTED
    for number, path in models().items():
        if number in COUNTED:
            with pytest.raises(ConfigError, match="--count NPt=N"):
                import_file(str(path))
        else:
            import_file(str(path))


@pytest.mark.parametrize("number", [103, 160, 705, 802])
def test_a_converted_model_has_the_types_of_its_points(number: int) -> None:
    """A model of an inverter, of several inputs, of a curve, and of a battery."""
    _, unit = converted(number)
    types = {
        point["name"]: point["type"] for point in json.loads(models()[number].read_text("utf-8"))["group"]["points"]
    }
    for point in unit.point:
        if point.name in types and types[point.name] in ("int16", "uint32", "sunssf", "acc32", "bitfield32"):
            same = {"sunssf": "int16", "acc32": "uint32", "bitfield32": "uint32"}
            assert point.type == same.get(types[point.name], types[point.name]), point.name
