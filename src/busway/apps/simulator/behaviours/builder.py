"""Builds behaviours from the sections of a simulation file.

Knows every kind of behaviour; knows no device: the caller gives a function that reads other points.
"""

from collections.abc import Callable
from dataclasses import dataclass

from ....config.files.behaviours import (
    BehaviourSection,
    ConstantSection,
    CounterSection,
    FormulaSection,
    LagSection,
    NoiseSection,
    RampSection,
    RandomWalkSection,
    ReplaySection,
    SineSection,
    SquareSection,
)
from ....points.expression import Expression, Number
from .behaviour import Behaviour
from .chance import Noise, RandomWalk, stream_of
from .formula import Formula
from .replay import Recording, Replay
from .sums import Counter, Lag, SteadyCounter, SteadyLag
from .waves import Constant, Ramp, Sine, Square


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a behaviour depends on besides its section: the point's range and first value, seed, other points.

    Attributes:
        key: the key of the point, ``UNIT/NAME``.
        seed: the seed of the simulation.
        start: the point's first value, in its unit of measure.
        low, high: smallest and largest value of the point; None for no limit.
        begin, rollover: the value with which a counter of the point's type starts again, and the value at which it does
            so; None for never.
        goes_below: whether a counter of the point's type goes on below ``begin``, because the type has a sign.
        expressions: the parsed expressions of the section, by key of the section.
        recording: the recording of a replay; None for other behaviours.
        source: takes the name of a point and returns a function that reads the point's present value.
    """

    key: str
    seed: int
    start: float
    low: float | None
    high: float | None
    begin: float
    rollover: float | None
    goes_below: bool
    expressions: dict[str, Expression]
    recording: Recording | None
    source: Callable[[str], Callable[[], Number]]


def make_behaviour(section: BehaviourSection, around: Surroundings) -> Behaviour:
    """Create the behaviour of a simulated point that a section of a simulation file declares.

    Args:
        section: the section, of any kind.
        around: the other data that the behaviour needs: range and first value of the point, seed, other points.
    """
    match section:
        case ConstantSection():
            return Constant(section)
        case RampSection():
            return Ramp(section)
        case SineSection():
            return Sine(section)
        case SquareSection():
            return Square(section)
        case NoiseSection():
            return Noise(section, stream_of(around.seed, around.key))
        case RandomWalkSection():
            low = around.low if section.low is None else section.low
            high = around.high if section.high is None else section.high
            return RandomWalk(section, stream_of(around.seed, around.key), around.start, low, high)
        case CounterSection():
            return _counter(section, around)
        case LagSection():
            return _lag(section, around)
        case FormulaSection():
            return Formula(around.expressions["formula"].bind(around.source))
        case ReplaySection():
            assert around.recording is not None  # read before anything is made
            return Replay(around.recording, section.at_end, section.between)
    raise AssertionError(section)


def _counter(section: CounterSection, around: Surroundings) -> Behaviour:
    begin, rollover = (around.begin, around.rollover) if section.rollover is None else (0.0, section.rollover)
    below = around.goes_below and section.rollover is None
    if not isinstance(section.rate, str):
        return SteadyCounter(section.rate, rollover, around.start, begin, goes_below=below)
    return Counter(around.expressions["rate"].bind(around.source), rollover, around.start, begin, goes_below=below)


def _lag(section: LagSection, around: Surroundings) -> Behaviour:
    if not isinstance(section.target, str):
        return SteadyLag(section.target, section.time_constant, around.start)
    return Lag(around.expressions["target"].bind(around.source), section.time_constant, around.start)
