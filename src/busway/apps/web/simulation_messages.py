"""Requests and responses of a simulation's HTTP API, as data classes.

Durations are in seconds, times in seconds since 1970 UTC unless a field is described as a time of the simulation. Knows
the form of messages; knows no simulation. A request with an unknown key is refused. Responses may gain keys in later
versions.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import Field

from .messages import Answer, Asked, Plain, plain_value

_NOT_IN_JSON: Final = ("NaN", "Infinity", "-Infinity")


class Nothing(Answer):
    """Response: the request was executed, and there is nothing to return."""

    done: bool = True


# Points.


class PointAnswer(Answer):
    """Response: a point of the simulation and its value."""

    index: int = Field(description="its place among all points, as the stream numbers them")
    key: str = Field(description="UNIT/NAME")
    unit: int
    name: str
    table: str = Field(description="coils, discrete_inputs, input_registers or holding_registers")
    address: str = Field(description="notation, 1-based: 4x1")
    type: str = Field(description="bit, uint16, float32, …")
    order: str = ""
    scale: float = 1.0
    unit_of_measure: str = ""
    description: str = ""
    access: str = Field("read", description="what Modbus may do: read or read-write")
    minimum: float | None = None
    maximum: float | None = None
    enumeration: dict[str, int] = Field(default_factory=dict, description="numbers by name")
    behaviour: str = ""
    value: Plain = None
    raw: str = Field("", description="as on the wire, hexadecimal")
    held: bool = Field(False, description="set by hand: its behaviour waits")
    changed_at: float = Field(0.0, description="seconds of the simulation")
    last_writer: str = ""


class PointsMessage(Answer):
    """Response: points of the simulation, in the order of the file."""

    points: list[PointAnswer]
    total: int = Field(description="how many there are with these filters, without the limit")


class PointsQuery(Asked):
    """Query: which points of the simulation are wanted."""

    unit: Annotated[int, Field(ge=0, le=255)] | None = Field(None, description="only this unit")
    search: str | None = Field(None, description="only where key, description, unit of measure or address has this")
    limit: Annotated[int, Field(ge=1, le=100_000)] = 100_000
    skip: Annotated[int, Field(ge=0)] = 0


class NewValue(Asked):
    """Request to write one point: a value in its unit of measure, or the name of a value."""

    value: Plain


class Values(Answer):
    """Response: values by key of the point."""

    values: dict[str, Plain]


class NewValues(Asked):
    """Request to write several points: values by key of the point."""

    values: Annotated[dict[str, Plain], Field(max_length=100_000)]


class Written(Answer):
    """Response: how many of several values were set, and why others were not."""

    written: int
    refused: dict[str, str] = Field(default_factory=dict, description="sentences by key")


class UnitAnswer(Answer):
    """Response: a unit of the simulation."""

    unit: int
    name: str = ""
    points: int


class Units(Answer):
    """Response: the units of the simulation."""

    units: list[UnitAnswer]


# Faults.


class ParameterAnswer(Answer):
    """Response: a parameter of a fault profile, with its default."""

    name: str
    default: Plain = None
    kind: str = Field("", description="float, int or bool; empty if anything is taken")
    meaning: str = ""
    range: str = ""


class FaultyAnswer(Answer):
    """Response: a fault profile that can be added."""

    name: str
    happens: str
    answer: str = Field("", description="what a client that is up to it does")
    carriers: list[str] = Field(default_factory=list, description="where it is met: tcp, serial, connection")
    parameters: list[ParameterAnswer] = Field(default_factory=list)


class FaultAnswer(Answer):
    """Response: a fault that was added."""

    name: str
    fault_profile: str
    happens: str = ""
    on: bool
    struck: int = Field(0, description="requests that it has struck, connections that it has refused or closed")
    parameters: dict[str, Plain] = Field(default_factory=dict)
    selection: dict[str, Any] = Field(default_factory=dict, description="what it is chosen by")


class FaultsMessage(Answer):
    """Response: the faults that were added, and the fault profiles that can be."""

    faults: list[FaultAnswer]
    fault_profiles: list[FaultyAnswer]


class NewSchedule(Asked):
    """Request: when a new fault is active, in seconds since it was switched on."""

    after: Annotated[float, Field(ge=0)] = 0.0
    lasts: Annotated[float, Field(ge=0)] | None = None
    every: Annotated[float, Field(gt=0)] | None = None
    skip: Annotated[int, Field(ge=0)] = 0
    times: Annotated[int, Field(ge=0)] | None = None


class NewFault(Asked):
    """Request to add a fault; a filter that is left out selects everything."""

    fault_profile: str
    name: str = Field("", max_length=100, description="what to call it; by default as its fault profile")
    parameters: dict[str, Plain] = Field(default_factory=dict)
    units: list[Annotated[int, Field(ge=0, le=255)]] | None = None
    functions: list[Annotated[int, Field(ge=1, le=127)]] | None = None
    first: Annotated[int, Field(ge=0, le=65535)] | None = Field(None, description="of the addresses, 0-based")
    last: Annotated[int, Field(ge=0, le=65535)] | None = None
    probability: Annotated[float, Field(ge=0, le=1)] = 1.0
    schedule: NewSchedule = Field(default_factory=NewSchedule)
    on: bool = True


class Switch(Asked):
    """Request to switch a fault on or off."""

    on: bool


# The server.


class Connections(Answer):
    """Response: the open Modbus connections, the oldest first."""

    connections: list[dict[str, Any]] = Field(description="as `busway status` shows them")


class LinesMessage(Answer):
    """Response: listeners, with their status indicators and diagnostic counters."""

    lines: list[dict[str, Any]]


class CountersMessage(Answer):
    """Response: counters of the server since the start or the last reset."""

    counters: dict[str, Any]


# Traffic.


class FieldAnswer(Answer):
    """Response: one field of a Modbus message, explained."""

    name: str
    data: str = Field(description="hexadecimal")
    text: str = ""
    problem: str = ""


class FrameAnswer(Answer):
    """Response: one frame of the Modbus traffic."""

    number: int = Field(description="counts up by one")
    at: float
    direction: str = Field(description="request, reply, or damaged")
    peer: str
    unit: int | None = None
    transaction: int | None = None
    function: int | None = None
    raw: str = Field(description="the PDU, hexadecimal; of damaged bytes those")
    title: str
    text: str = Field(description="all fields in one line")
    fields: list[FieldAnswer] = Field([])
    problems: list[str] = Field([])
    exception: bool = False
    seconds: float | None = Field(None, description="of a reply: since its request")


class TrafficMessage(Answer):
    """Response: frames of the Modbus traffic, the oldest first."""

    frames: list[FrameAnswer]
    last: int = Field(description="number of the last frame that passed; ask with `after` for what comes next")
    lost: int = Field(description="frames after `after` that are not kept any more")


class TrafficQuery(Asked):
    """Query: which frames of the Modbus traffic are wanted."""

    limit: Annotated[int, Field(ge=1, le=2000)] = 100
    after: Annotated[int, Field(ge=0)] | None = Field(None, description="only those with a higher number")


# The simulation.


class SimulationAnswer(Answer):
    """Response: the state of the simulation."""

    name: str
    version: str
    endpoints: list[str]
    units: int
    points: int
    uptime: float
    time: float = Field(description="seconds of the simulation since it began")
    seed: int
    speed: float = Field(description="seconds of the simulation in a second")
    paused: bool


class SimulationChange(Asked):
    """Request to change settings of the simulation; those left out stay."""

    speed: Annotated[float, Field(gt=0, le=100_000)] | None = None
    paused: bool | None = None


def plain_values(values: Mapping[str, Any]) -> dict[str, Plain]:
    """Return values by name in a form that JSON can represent (`Plain`)."""
    return {str(name): plain_value(value) for name, value in values.items()}


def given_value(value: Plain) -> Plain:
    """Return a value of a request, with ``"NaN"``, ``"Infinity"`` and ``"-Infinity"`` turned into those numbers."""
    return float(value) if isinstance(value, str) and value in _NOT_IN_JSON else value
