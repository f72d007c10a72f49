"""Keys of simulation files for behaviours: what makes the value of a simulated point change.

Knows the keys of each kind and which values they can have; computes no value (`apps.simulator.behaviours` does) and
parses no expression (the simulator, which knows the points, does).

An example is in `docs/simulator.md`.

1. ``rate``, ``target`` and ``formula`` take an expression, a text; the first two also a number.
2. Numbers are in the point's unit of measure. One bit is on where the value is 0.5 or more.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from ...options.declaration import Name, Range
from ...values.unfit_values import shown
from .section import FileProblems, Section
from .toml_source import read_section

FASTEST: Final = 0.01
"""Fewest seconds between two changes: below, the timers of a system are no longer exact."""
SLOWEST: Final = 86_400.0

KIND: Final = "what makes the value."
FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Range(0.001, 1e9)]
Degrees = Annotated[float, Range(-360, 360)]


def _as_expression(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"must be a number, or an expression in a text, not {shown(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"must be a finite number, not {value:g}")
    return value


ExpressionField = Annotated[float | str, BeforeValidator(_as_expression, json_schema_input_type=float | str)]


class BehaviourSection(Section):
    """Keys that behaviours of all kinds have: how often the value changes, how long a written value stays."""

    expressions: ClassVar[tuple[str, ...]] = ()
    """Names of the keys of this kind whose value can be an expression."""
    begins: ClassVar[bool] = False
    """Whether the behaviour starts from the key ``value`` of the point; otherwise a point must not have the key."""

    every: Annotated[
        float,
        Range(FASTEST, SLOWEST),
        "seconds between two values. Moments are whole multiples of it, counted from the beginning: nothing drifts.",
    ] = 1.0
    resume_after: Annotated[
        float | None,
        Range(0, 1e9),
        "seconds after which a written value gives way to the behaviour again, 0 at once; None: it holds.",
    ] = None


class ConstantSection(BehaviourSection):
    """Behaviour ``constant``: the value never changes."""

    kind: Annotated[Literal["constant"], KIND]
    value: Annotated[FiniteNumber | bool, "the value."]


class RampSection(BehaviourSection):
    """Behaviour ``ramp``: the value rises or falls linearly."""

    kind: Annotated[Literal["ramp"], KIND]
    first: Annotated[FiniteNumber, "value at the beginning."] = 0.0
    last: Annotated[FiniteNumber, "value at the end."]
    duration: Annotated[Seconds, "seconds from the first to the last."]
    at_end: Annotated[Literal["hold", "repeat", "return"], "what comes then; `return`: the way it came."] = "repeat"


class SineSection(BehaviourSection):
    """Behaviour ``sine``: the value follows a sine wave."""

    kind: Annotated[Literal["sine"], KIND]
    mean: Annotated[FiniteNumber, "value in the middle."] = 0.0
    amplitude: Annotated[FiniteNumber, "how far it goes up and down from there."]
    period: Annotated[Seconds, "seconds once around."]
    phase: Annotated[Degrees, "degrees at the beginning."] = 0.0


class SquareSection(BehaviourSection):
    """Behaviour ``square``: the value alternates between two values."""

    kind: Annotated[Literal["square"], KIND]
    low: Annotated[FiniteNumber, "the lower value."] = 0.0
    high: Annotated[FiniteNumber, "the upper value, which comes first."] = 1.0
    period: Annotated[Seconds, "seconds once around."]
    duty: Annotated[float, Range(0, 1), "the part of a period for which it is high."] = 0.5
    phase: Annotated[Degrees, "degrees at the beginning."] = 0.0


class NoiseSection(BehaviourSection):
    """Behaviour ``noise``: random values around a mean, with a uniform or a normal distribution."""

    kind: Annotated[Literal["noise"], KIND]
    mean: Annotated[FiniteNumber, "value in the middle."] = 0.0
    spread: Annotated[
        FiniteNumber, Range(0, math.inf), "how far a value may be from it; of `gauss` the standard deviation."
    ]
    distribution: Annotated[Literal["uniform", "gauss"], "how values are distributed."] = "uniform"


class RandomWalkSection(BehaviourSection):
    """Behaviour ``random-walk``: the value goes up and down in random steps."""

    begins: ClassVar[bool] = True

    kind: Annotated[Literal["random-walk"], KIND]
    step: Annotated[FiniteNumber, Range(0, math.inf, above=True), "the longest step up or down."]
    low: Annotated[FiniteNumber | None, "where it turns back; None: at the minimum of the point."] = None
    high: Annotated[FiniteNumber | None, "where it turns back; None: at the maximum of the point."] = None

    @model_validator(mode="after")
    def _check(self) -> "RandomWalkSection":
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise FileProblems([(("high",), f"must be above low, {self.low:g}, not {self.high:g}")])
        return self


class CounterSection(BehaviourSection):
    """Behaviour ``counter``: the value is a sum over time."""

    begins: ClassVar[bool] = True
    expressions: ClassVar[tuple[str, ...]] = ("rate",)

    kind: Annotated[Literal["counter"], KIND]
    rate: Annotated[ExpressionField, "what is added in a second."]
    rollover: Annotated[
        FiniteNumber | None,
        Range(0, math.inf, above=True),
        "value at which it begins again from 0; None: where a whole-number type ends, from `offset` of the point. A",
        "type with a sign then goes on below 0.",
    ] = None


class LagSection(BehaviourSection):
    """Behaviour ``lag``: the value follows another one with a first-order lag."""

    begins: ClassVar[bool] = True
    expressions: ClassVar[tuple[str, ...]] = ("target",)

    kind: Annotated[Literal["lag"], KIND]
    target: Annotated[ExpressionField, "the value that it follows."]
    time_constant: Annotated[Seconds, "seconds for 63 % of the way."]


class FormulaSection(BehaviourSection):
    """Behaviour ``formula``: the value is an expression over other points and time."""

    expressions: ClassVar[tuple[str, ...]] = ("formula",)

    kind: Annotated[Literal["formula"], KIND]
    formula: Annotated[str, "the expression."]


class ReplaySection(BehaviourSection):
    """Behaviour ``replay``: the value follows recorded values of a file."""

    kind: Annotated[Literal["replay"], KIND]
    file: Annotated[str, Name("the path of a file"), "the file, of lines `time,value`."]
    at_end: Annotated[Literal["repeat", "hold"], "what comes behind the last line."] = "repeat"
    between: Annotated[Literal["step", "line"], "what it is between two lines; `line`: on a straight line."] = "step"


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
"""The sections by kind. To add a kind: its section here, and what it does in `busway.apps.simulator.behaviours`."""


def _as_behaviour(value: object) -> object:
    """Return a behaviour as an object of the section class of its ``kind``.

    So an error names the wrong key itself; a union of pydantic would report the errors of all kinds. Raises
    `FileProblems` or `ValueError`.
    """
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
    """Return a behaviour as text, with the keys that the file gives: ``sine: amplitude 4, period 60, every 0.1``.

    ``resume_after`` is left out; without other keys the text is the kind alone. A key named as its kind has its value
    alone: ``formula: voltage * current``.
    """
    common = BehaviourSection.model_fields
    names = [name for name in type(section).model_fields if name not in common] + ["every"]
    own: dict[str, Any] = {  # Any: of the types of the keys
        name: getattr(section, name) for name in names if name in section.model_fields_set and name != "kind"
    }
    kind = next(name for name, each in KINDS.items() if each is type(section))
    if not own:
        return kind
    words = (_number(value) if name == kind else f"{name} {_number(value)}" for name, value in own.items())
    return f"{kind}: {', '.join(words)}"


def _number(value: Any) -> str:  # of any key
    """Return a value as text; a float with six digits if they are all that it has."""
    if not isinstance(value, float):
        return str(value)
    short = f"{value:g}"
    return short if float(short) == value else repr(value)
