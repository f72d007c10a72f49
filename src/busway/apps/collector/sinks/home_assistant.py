"""Describes a point to Home Assistant: kind of entity, device class and state class.

Pure. Knows points and units of measure; knows no topics.

1. The device class follows from the unit of measure (`DEVICE_CLASSES`), where Home Assistant documents the two together
   and no other class has the unit. Home Assistant refuses an entity whose unit does not go with its class.
2. Numbers are measurements. Counters with a rollover and energies are totals that only grow; the energy dashboard takes
   no others. Texts, states, and numbers that stand for names have no state class.
3. ``meta`` of the point overrides device class and state class, by the keys ``device_class`` and ``state_class``; an
   empty text leaves the class out.

Home Assistant, Sensor entity: "Available device classes", "Available state classes". MQTT sensor, MQTT binary sensor.
"""

from collections.abc import Mapping
from enum import Enum, auto
from typing import Any, Final

from ....points.point import Point
from ..samples import SampleValue

UNITS: Final[Mapping[str, tuple[str, ...]]] = {
    "apparent_power": ("VA",),
    "current": ("mA", "A"),
    "distance": ("mm", "cm", "m", "km"),
    "duration": ("ms", "s", "min", "h", "d"),
    "energy": ("J", "kJ", "MJ", "GJ", "mWh", "Wh", "kWh", "MWh", "GWh", "TWh"),
    "frequency": ("Hz", "kHz", "MHz", "GHz"),
    "illuminance": ("lx",),
    "irradiance": ("W/m²",),
    "power": ("W", "kW", "MW", "GW", "TW"),
    "pressure": ("Pa", "hPa", "kPa", "mbar", "bar", "psi"),
    "reactive_power": ("var",),
    "speed": ("mm/s", "m/s", "km/h"),
    "temperature": ("°C", "°F"),
    "voltage": ("mV", "V", "kV", "MV"),
    "volume_flow_rate": ("L/min", "m³/h"),
    "weight": ("mg", "g", "kg"),
}
"""Units of measure by device class.

Left out: ``K``, because temperature differences have it, and a display in °C would show them wrong; ``%``, ``ppm``,
``L`` and ``m³``, because several classes have them; ``kVA``, ``kvar`` and ``varh``, because older versions refuse them.
"""
DEVICE_CLASSES: Final[Mapping[str, str]] = {unit: name for name, units in UNITS.items() for unit in units}
"""The device class of each unit of measure."""
_GROWING_UNITS: Final = frozenset({"varh", "kvarh", "Mvarh", "VAh", "kVAh", "MVAh"})
"""Units of energies that get no device class here; a number with such a unit counts as a total that only grows."""
_STATE_CLASSES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("energy", "gas", "reactive_energy", "volume", "water"), "total_increasing"),
    "monetary": "total",
    **dict.fromkeys(("date", "enum", "timestamp", "wind_direction"), ""),
}
"""State classes by device class, for classes whose numbers are not measurements; empty for no state class."""


class EntityKind(Enum):
    """Kinds of values that a point can have for Home Assistant, such as a number or a state."""

    STATE = auto()
    NUMBER = auto()
    TOTAL = auto()
    """A number that only grows."""
    CODE = auto()
    """A number that stands for a name, or whose bits have names."""
    TEXT = auto()


def kind_of(point: Point) -> EntityKind:
    """Return the kind of value that a point has for Home Assistant, by the point's type, conversion and rollover."""
    if point.type == "bit":
        return EntityKind.STATE
    if not point.is_number:
        return EntityKind.TEXT
    if point.conversion.names or point.conversion.flags:
        return EntityKind.CODE
    return EntityKind.NUMBER if point.rollover is None else EntityKind.TOTAL


def kind_of_value(value: SampleValue | None) -> EntityKind | None:
    """Return the kind of a point by one of its values, for a point without description; None if there is no value."""
    if value is None:
        return None
    if isinstance(value, bool):
        return EntityKind.STATE
    return EntityKind.NUMBER if isinstance(value, int | float) else EntityKind.TEXT


def entity(kind: EntityKind, unit_of_measure: str, meta: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """Return how Home Assistant shows a point: the component, and the options of its entity that depend on the kind.

    Args:
        kind: the kind of the value.
        unit_of_measure: such as ``kWh``; empty for none.
        meta: free facts of the point; only ``device_class`` and ``state_class`` are used (rule 3). Any: what TOML has.

    Returns:
        ``binary_sensor`` for a state, else ``sensor``; and those of ``unit_of_measurement``, ``device_class`` and
        ``state_class`` that apply: for a state the device class alone, a unit for numbers alone.
    """
    is_number = kind in (EntityKind.NUMBER, EntityKind.TOTAL)
    device_class = _text(meta, "device_class", DEVICE_CLASSES.get(unit_of_measure, "") if is_number else "")
    if kind is EntityKind.STATE:
        return "binary_sensor", _said({"device_class": device_class})
    usual = _state_class(kind, unit_of_measure, device_class) if is_number else ""
    return "sensor", _said(
        {
            "unit_of_measurement": unit_of_measure if is_number else "",  # with one, a text is refused
            "device_class": device_class,
            "state_class": _text(meta, "state_class", usual),
        }
    )


def _state_class(kind: EntityKind, unit_of_measure: str, device_class: str) -> str:
    if kind is EntityKind.TOTAL or unit_of_measure in _GROWING_UNITS:
        return "total_increasing"
    return _STATE_CLASSES.get(device_class, "measurement")


def _text(meta: Mapping[str, Any], key: str, usual: str) -> str:
    found = meta.get(key)
    return found if isinstance(found, str) else usual


def _said(content: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in content.items() if value}
