"""The plant of the demonstration, as three devices: a tank with pump and consumers, a meter, and a thermometer.

Knows the physics of the plant as functions of state and time, and its points; knows no clock and no connection.

1. A second of the demonstration is a minute of the plant, so that a level can be seen to move.
2. The pump keeps the level around ``tank.target`` while ``pump.enabled`` is on. Clients can write both by Modbus.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

from ...config.devices import build_device
from ...config.files.device import parse_device_file
from ...server.device import Device
from .points import Points

PLANT_FILE: Final = """\
listen = ["tcp://127.0.0.1:5020"]

[[unit]]
unit = 1
name = "tank"
identification = { vendor_name = "busway", product_code = "tank", revision = "1.0" }
server_id = "tank"

[[unit.point]]
name = "tank.level"
address = "3x1"
type = "float32"
unit_of_measure = "m"

[[unit.point]]
name = "tank.target"
address = "4x1"
type = "float32"
value = 2.0
unit_of_measure = "m"
description = "The level that the pump keeps."

[[unit.point]]
name = "pump.enabled"
address = "0x1"
value = true

[[unit.point]]
name = "pump.running"
address = "1x1"

[[unit.point]]
name = "pump.speed"
address = "3x4"
type = "uint16"
unit_of_measure = "rpm"

[[unit]]
unit = 2
name = "meter"

[[unit.point]]
name = "meter.flow"
address = "3x5"
type = "float32"
order = "CDAB"
unit_of_measure = "m³/h"
description = "Its registers come low word first, as many meters have them."

[[unit.point]]
name = "meter.volume"
address = "3x7"
type = "uint32"
unit_of_measure = "L"

[[unit.point]]
name = "meter.power"
address = "3x9"
type = "uint32"
unit_of_measure = "W"

[[unit]]
unit = 3
name = "thermometer"

[[unit.point]]
name = "tank.temperature"
address = "3x1"
type = "int16"
scale = 0.1
unit_of_measure = "°C"
"""
"""The text of the plant's device file, in the form of files for `busway serve`."""

TANK: Final = 1
METER: Final = 2
THERMOMETER: Final = 3
"""Unit identifier of the thermometer; `TANK` and `METER` are those of the other two devices."""
HASTE: Final = 60.0
"""Seconds of the plant in one second of the clock."""
TANK_AREA: Final = 1.5
"""Area of the tank in square metres."""
TANK_HEIGHT: Final = 4.0
"""Height of the tank in metres: the level cannot rise above it."""
PUMP_FLOW: Final = 36.0
"""Flow of the running pump into an empty tank, cubic metres per hour."""
PUMP_SPEED: Final = 1450
"""Speed of the running pump, revolutions per minute."""
PUMP_POWER: Final = 4000
"""Rated power of the pump in watts; depending on the level of the tank, the pump takes 0.9 to 1.02 times that."""
IDLE_POWER: Final = 35
"""Power in watts that the controls take all the time, also while the pump stands."""
BAND: Final = 0.3
"""Metres below the target at which the pump starts, and above it at which it stops."""
_LONGEST_STEP: Final = 0.2
"""Longest step in seconds of the clock: longer ones are divided, so that the pump still switches in time."""


@dataclass(frozen=True, slots=True)
class Controls:
    """The two values that an operator may set in the plant.

    Attributes:
        target: the level that the pump keeps, in metres.
        pump_enabled: whether the pump may run.
    """

    target: float = 2.0
    pump_enabled: bool = True


@dataclass(frozen=True, slots=True)
class PlantState:
    """The state of the plant: time, level of the tank, whether the pump runs, volume delivered.

    Attributes:
        time: seconds of the clock since the plant began.
        level: level of the tank, in metres.
        is_pumping: whether the pump runs.
        volume: litres that the pump has delivered, plus 1000 at the start; starts again from 0 at 2³².
    """

    time: float = 0.0
    level: float = 1.8
    is_pumping: bool = True
    volume: float = 1000.0


def advance(state: PlantState, controls: Controls, seconds: float) -> PlantState:
    """Return the state of the plant some seconds later.

    Args:
        state: the state now.
        controls: the values that the operator has set.
        seconds: seconds of the clock, one of which is a minute of the plant.
    """
    while seconds > 0:
        step = min(seconds, _LONGEST_STEP)
        seconds -= step
        state = _step(state, controls, step)
    return state


def _step(state: PlantState, controls: Controls, seconds: float) -> PlantState:
    hours = seconds * HASTE / 3600
    state = replace(state, is_pumping=_pumps(state, controls))
    rise = (flow(state) - consumption(state.time)) * hours / TANK_AREA
    return replace(
        state,
        time=state.time + seconds,
        level=min(max(state.level + rise, 0.0), TANK_HEIGHT),
        volume=(state.volume + 1000 * flow(state) * hours) % 2**32,
    )


def _pumps(state: PlantState, controls: Controls) -> bool:
    """Whether the pump runs from now on: it starts at `BAND` metres below the target level, and stops `BAND` above it.

    Between the two levels the pump goes on running or standing. It never runs while it is not enabled.
    """
    if not controls.pump_enabled or state.level >= controls.target + BAND:
        return False
    return state.is_pumping or state.level <= controls.target - BAND


def flow(state: PlantState) -> float:
    """Return the flow of the pump in cubic metres per hour: slightly less into a full tank, 0 while the pump stands."""
    return PUMP_FLOW * (1 - 0.04 * state.level) if state.is_pumping else 0.0


def consumption(time: float) -> float:
    """Return the flow to the consumers in cubic metres per hour, ``time`` seconds of the clock after the start."""
    return 15.0 + 5.0 * math.sin(time * 2 * math.pi / 7)


def temperature(time: float) -> float:
    """Return the temperature of the tank in °C, in steps of 0.1, ``time`` seconds of the clock after the start."""
    return round(18.0 + 1.5 * math.sin(time * 2 * math.pi / 30), 1)


def power(state: PlantState) -> int:
    """Return the electrical power of the plant in watts: the controls, and the pump while it runs."""
    return IDLE_POWER + (round(PUMP_POWER * (0.9 + 0.03 * state.level)) if state.is_pumping else 0)


class Plant:
    """The plant of the demonstration, and the three simulated devices that show its state.

    Attributes:
        devices: the devices to serve, by unit.
        points: by unit, the named points of its device.
        state: the present state of the plant; replaced by `tick`.
    """

    def __init__(self) -> None:
        sections = parse_device_file(PLANT_FILE, "plant").unit
        self.devices: dict[int, Device] = {section.unit[0]: build_device(section) for section in sections}
        self.points: dict[int, Points] = {
            section.unit[0]: Points(self.devices[section.unit[0]], section.point) for section in sections
        }
        self.state: PlantState = PlantState()
        self.tick(0.0)

    def tick(self, seconds: float) -> None:
        """Advance the plant by some seconds of the clock, with the controls that clients have written.

        The points of each device get their new values at once, so that clients see all of them or none.
        """
        tank, meter = self.points[TANK], self.points[METER]
        controls = Controls(tank["tank.target"], tank["pump.enabled"])
        self.state = state = advance(self.state, controls, seconds)
        with tank.update():
            tank["tank.level"] = state.level
            tank["pump.running"] = state.is_pumping
            tank["pump.speed"] = PUMP_SPEED if state.is_pumping else 0
        with meter.update():
            meter["meter.flow"] = flow(state)
            meter["meter.volume"] = int(state.volume)
            meter["meter.power"] = power(state)
        self.points[THERMOMETER]["tank.temperature"] = temperature(state.time)
