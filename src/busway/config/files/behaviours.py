"""Keys of simulation files for behaviours: what makes the value of a simulated point change.

Knows the keys of each kind and what they may be; computes no value (`apps.simulator.behaviours` does) and reads no
formula (only their position; the simulator, which knows the points, checks them).

::

    behaviour = { kind = "sine", mean = 230.0, amplitude = 4.0, period = 60 }

==================  ==============================================================================
kind                value, ``t`` seconds after the beginning
==================  ==============================================================================
``constant``        ``value``
``ramp``            ``first`` → ``last`` in ``duration`` seconds; then as ``at_end`` says
``sine``            ``mean`` ± ``amplitude``, once around in ``period`` seconds
``square``          ``low`` and ``high`` in turn; ``high`` for the part ``duty`` of each ``period``
``noise``           ``mean`` ± ``spread``, each step by itself: ``uniform`` or ``gauss``
``random-walk``     a step of at most ``step`` up or down each time, within ``low``…``high``
``counter``         the sum of ``rate`` per second; begins again from 0 at ``rollover``
``lag``             towards ``target``, 63 % of the way in ``time_constant`` seconds
``formula``         an expression over other points of the unit, of other units, and ``t``
``replay``          what stands in a file of lines ``time,value``
==================  ==============================================================================

1. ``rate``, ``target`` and ``formula`` take an expression, a text; the first two also a number.
2. Numbers are in the point's unit of measure. One bit is on where the value is 0.5 or more.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from ...values.refusal import shown
from .schema import FileProblems, Section, read_section

FASTEST: Final = 0.01
"""Seconds between two changes, at least: below, the timers of a system are no longer exact."""
SLOWEST: Final = 86_400.0

Number = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0.001, le=1e9)]
Degrees = Annotated[float, Field(ge=-360, le=360)]


def _as_expression(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"must be a number, or an expression in a text, not {shown(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"must be a finite number, not {value:g}")
    return value


Expression = Annotated[float | str, BeforeValidator(_as_expression, json_schema_input_type=float | str)]


class BehaviourSection(Section):
    """Keys that behaviours of all kinds have: how often the value changes, how long a written value stays."""

    expressions: ClassVar[tuple[str, ...]] = ()
    """Keys that may hold an expression."""
    begins: ClassVar[bool] = False
    """Whether it goes on from the point's first value."""

    every: float = Field(default=1.0, ge=FASTEST, le=SLOWEST)
    resume_after: float | None = Field(default=None, ge=0, le=1e9)


class ConstantSection(BehaviourSection):
    """Behaviour ``constant``: the value never changes."""

    kind: Literal["constant"]
    value: Number | bool


class RampSection(BehaviourSection):
    """Behaviour ``ramp``: the value rises or falls linearly."""

    kind: Literal["ramp"]
    first: Number = 0.0
    last: Number
    duration: Seconds
    at_end: Literal["hold", "repeat", "return"] = "repeat"


class SineSection(BehaviourSection):
    """Behaviour ``sine``: the value follows a sine wave."""

    kind: Literal["sine"]
    mean: Number = 0.0
    amplitude: Number
    period: Seconds
    phase: Degrees = 0.0


class SquareSection(BehaviourSection):
    """Behaviour ``square``: the value alternates between two values."""

    kind: Literal["square"]
    low: Number = 0.0
    high: Number = 1.0
    period: Seconds
    duty: float = Field(default=0.5, ge=0, le=1)
    phase: Degrees = 0.0


class NoiseSection(BehaviourSection):
    """Behaviour ``noise``: random values around a mean, uniform within ``spread``, or normal with it as standard
    deviation.
    """

    kind: Literal["noise"]
    mean: Number = 0.0
    spread: float = Field(ge=0, allow_inf_nan=False)
    distribution: Literal["uniform", "gauss"] = "uniform"


class RandomWalkSection(BehaviourSection):
    """Behaviour ``random walk``: the value goes up and down in random steps."""

    begins: ClassVar[bool] = True

    kind: Literal["random-walk"]
    step: float = Field(gt=0, allow_inf_nan=False)
    low: Number | None = None
    high: Number | None = None

    @model_validator(mode="after")
    def _check(self) -> "RandomWalkSection":
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise FileProblems([(("high",), f"must be above low, {self.low:g}, not {self.high:g}")])
        return self


class CounterSection(BehaviourSection):
    """Behaviour ``counter``: the value is a sum over time."""

    begins: ClassVar[bool] = True
    expressions: ClassVar[tuple[str, ...]] = ("rate",)

    kind: Literal["counter"]
    rate: Expression
    rollover: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None


class LagSection(BehaviourSection):
    """Behaviour ``lag``: the value follows another one with a first-order lag."""

    begins: ClassVar[bool] = True
    expressions: ClassVar[tuple[str, ...]] = ("target",)

    kind: Literal["lag"]
    target: Expression
    time_constant: Seconds


class FormulaSection(BehaviourSection):
    """Behaviour ``formula``: the value is an expression over other points and time."""

    expressions: ClassVar[tuple[str, ...]] = ("formula",)

    kind: Literal["formula"]
    formula: str


class ReplaySection(BehaviourSection):
    """Behaviour ``replay``: the value follows recorded values of a file."""

    kind: Literal["replay"]
    file: str = Field(min_length=1)
    at_end: Literal["repeat", "hold"] = "repeat"
    between: Literal["step", "line"] = "step"


AnyBehaviour = (
    ConstantSection
    | RampSection
    | SineSection
    | SquareSection
    | NoiseSection
    | RandomWalkSection
    | CounterSection
    | LagSection
    | FormulaSection
    | ReplaySection
)
KINDS: Final[Mapping[str, type[BehaviourSection]]] = {
    "constant": ConstantSection,
    "ramp": RampSection,
    "sine": SineSection,
    "square": SquareSection,
    "noise": NoiseSection,
    "random-walk": RandomWalkSection,
    "counter": CounterSection,
    "lag": LagSection,
    "formula": FormulaSection,
    "replay": ReplaySection,
}
"""The kinds by name. To add one: its section here, and what it does in `busway.apps.simulator.behaviours`."""


def _as_behaviour(value: object) -> object:
    """Read a behaviour by the keys of its kind, so that errors name them; pydantic's union would not."""
    if isinstance(value, BehaviourSection):
        return value
    if not isinstance(value, dict):
        raise ValueError(f'must be a table such as {{ kind = "sine", … }}, not {shown(value)}')
    kind = value.get("kind")
    section = KINDS.get(kind) if isinstance(kind, str) else None
    if section is None:
        there = ", ".join(KINDS)
        said = f"must be one of {there}, not {shown(kind)}" if "kind" in value else f"is missing; there are {there}"
        raise FileProblems([(("kind",), said)])
    return read_section(section, value)


DeclaredBehaviour = Annotated[
    AnyBehaviour,
    BeforeValidator(_as_behaviour, json_schema_input_type=Annotated[AnyBehaviour, Field(discriminator="kind")]),
]


def described(section: BehaviourSection) -> str:
    """Return a short description of a behaviour: ``sine: amplitude 4, period 60``."""
    own: dict[str, Any] = {  # Any: of the types of the keys
        name: getattr(section, name)
        for name in type(section).model_fields
        if name in section.model_fields_set and name not in ("kind", "resume_after")
    }
    kind = next(name for name, each in KINDS.items() if each is type(section))
    if not own:
        return kind
    words = (f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in own.items())
    return f"{kind}: {', '.join(words)}"
