"""What Home Assistant is told about points, as files say them; combinations that it documents, and no others."""

import pytest

from busway.apps.collector.sinks.home_assistant import DEVICE_CLASSES, UNITS, entity, kind_of
from busway.config.files.device import parse_device_file
from busway.config.profiles import DEVICES, PREFIX
from busway.config.profiles.loading import load_profile
from busway.points import Point

MEASURED = {"power", "voltage", "current", "frequency", "temperature", "reactive_power", "apparent_power", "irradiance"}
MEASURED |= {"pressure", "illuminance", "speed", "volume_flow_rate"}
ANY = {"distance", "duration", "weight"}
"""Device classes that Home Assistant takes as a measurement only, and those that it takes with any state class."""


def point(keys: str, address: str = "4x1") -> Point:
    text = f'[[unit]]\nunit = 1\npoint = [{{ name = "a", address = "{address}"{", " if keys else ""}{keys} }}]\n'
    return parse_device_file(text, "x.toml").unit[0].described()[0]


def told(point: Point) -> tuple[str, dict[str, str]]:
    return entity(kind_of(point), point.unit_of_measure, point.meta)


def classes(keys: str) -> tuple[str | None, str | None]:
    component, content = told(point(keys))
    assert component == "sensor"
    return content.get("device_class"), content.get("state_class")


@pytest.mark.parametrize(
    ("unit", "device_class", "state_class"),
    [
        ("W", "power", "measurement"),
        ("kW", "power", "measurement"),
        ("Wh", "energy", "total_increasing"),
        ("kWh", "energy", "total_increasing"),
        ("MWh", "energy", "total_increasing"),
        ("V", "voltage", "measurement"),
        ("mA", "current", "measurement"),
        ("Hz", "frequency", "measurement"),
        ("°C", "temperature", "measurement"),
        ("var", "reactive_power", "measurement"),
        ("VA", "apparent_power", "measurement"),
        ("W/m²", "irradiance", "measurement"),
        ("h", "duration", "measurement"),
        ("kvarh", None, "total_increasing"),
        ("kvar", None, "measurement"),
        ("K", None, "measurement"),
        ("m³", None, "measurement"),
        ("%", None, "measurement"),
        ("rpm", None, "measurement"),
        ("", None, "measurement"),
    ],
)
def test_classes_follow_from_the_unit_of_measure(unit: str, device_class: str | None, state_class: str) -> None:
    assert classes(f'type = "float32", unit_of_measure = "{unit}"') == (device_class, state_class)


def test_a_unit_has_one_device_class() -> None:
    assert len(DEVICE_CLASSES) == sum(map(len, UNITS.values()))


@pytest.mark.parametrize(("unit", "device_class"), [("", None), ("h", "duration"), ("m³", None)])
def test_a_counter_that_rolls_over_is_a_total_that_only_grows(unit: str, device_class: str | None) -> None:
    assert classes(f'rollover = true, unit_of_measure = "{unit}"') == (device_class, "total_increasing")


def test_a_point_says_otherwise_by_its_meta() -> None:
    energy = 'type = "float32", unit_of_measure = "kWh"'
    assert classes(f'{energy}, meta = {{ state_class = "total" }}') == ("energy", "total")
    assert classes(f'{energy}, meta = {{ device_class = "energy_storage" }}') == ("energy_storage", "measurement")
    assert classes(f'{energy}, meta = {{ device_class = "", state_class = "" }}') == (None, None)
    assert classes(f"{energy}, meta = {{ device_class = 7, room = 'hall' }}") == ("energy", "total_increasing")
    assert classes('unit_of_measure = "m³", meta = { device_class = "water" }') == ("water", "total_increasing")
    assert classes('unit_of_measure = "%", meta = { device_class = "battery" }') == ("battery", "measurement")
    assert classes('unit_of_measure = "°", meta = { device_class = "wind_direction" }') == ("wind_direction", None)
    assert told(point('meta = { device_class = "door" }', "0x1")) == ("binary_sensor", {"device_class": "door"})


@pytest.mark.parametrize(
    "keys",
    [
        'type = "string:8", unit_of_measure = "kWh"',
        'type = "ipv4"',
        "enumeration = { off = 0, on = 1 }",
        "flags = { door = 0 }",
    ],
)
def test_texts_and_numbers_that_stand_for_names_have_neither_unit_nor_class(keys: str) -> None:
    assert told(point(keys)) == ("sensor", {})


@pytest.mark.parametrize("address", ["0x1", "1x1", "4x1.3"])
def test_a_bit_is_a_binary_sensor(address: str) -> None:
    assert told(point("", address)) == ("binary_sensor", {})


def test_a_computed_point_has_classes_too() -> None:
    text = '[[unit]]\nunit = 1\npoint = [{ name = "a", address = "4x1" },'
    text += ' { name = "b", formula = "a * 2", unit_of_measure = "W" }]\n'
    (_, computed) = parse_device_file(text, "x.toml").unit[0].described()
    assert told(computed)[1] == {"unit_of_measurement": "W", "device_class": "power", "state_class": "measurement"}


@pytest.mark.parametrize("profile", DEVICES)
def test_points_of_real_devices_get_only_what_home_assistant_takes_together(profile: str) -> None:
    for each in load_profile(PREFIX + profile, unit=1).described():
        _, content = told(each)
        device_class, state_class = content.get("device_class"), content.get("state_class")
        assert device_class is None or content["unit_of_measurement"] in UNITS[device_class]
        if device_class in MEASURED:
            assert state_class == "measurement", each.name
        elif device_class == "energy":
            assert state_class == "total_increasing", each.name
        else:
            assert device_class is None or device_class in ANY, each.name
