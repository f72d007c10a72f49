"""Builds the devices, points and behaviours that a simulation file declares.

Knows declarations, devices and behaviours; knows no time. It reads the recordings that behaviours name, and no other
file.

1. An expression names a point of its own unit, or ``UNIT/NAME`` of another. Errors at the line of the expression: a
   name that is no point, a point whose value is no number, a circle of formulas.
2. A counter and a lag use the values that other points had at the moment before, so points may depend on each other in
   a circle if one of them is a counter or a lag.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from ...config.devices import build_device
from ...config.file_text import read_named_text
from ...config.files.behaviours import BehaviourSection, FormulaSection, ReplaySection
from ...config.files.file_error import FileError, in_order
from ...config.files.key_lines import KeyPath
from ...config.files.simulation import SimulatedPointSection
from ...config.paths import within
from ...errors import ConfigError
from ...points.expression import Expression, Number, parse_expression
from ...values.unfit_values import shown
from .behaviours.behaviour import Behaviour
from .behaviours.builder import Surroundings, make_behaviour
from .behaviours.replay import Recording, parse_recording
from .engine import Driven
from .includes import DeclaredUnit, Reader
from .point_encoding import begin_of, form_of, goes_below_begin, largest_of, limits_of
from .simulated import SimulatedPoint, SimulatedUnit


@dataclass(frozen=True, slots=True)
class BuiltUnits:
    """The devices, points and behaviours built from a simulation file.

    Attributes:
        units: the units by number.
        points: the points of all units by ``UNIT/NAME``.
        driven: the points that have a behaviour, each after the points that its formula needs.
    """

    units: Mapping[int, SimulatedUnit]
    points: Mapping[str, SimulatedPoint]
    driven: Sequence[Driven]


def build_simulation(declared: Sequence[DeclaredUnit], seed: int, *, read: Reader = read_named_text) -> BuiltUnits:
    """Build the units that a simulation file declares, with the initial values of their points.

    Args:
        declared: the declarations of the units.
        seed: seed of all random numbers.
        read: returns the text of a recording by its path.

    Raises:
        FileError: a behaviour is invalid; the error has all problems, each with file, line and key.
    """
    plans = _plans(declared, read)
    units: dict[int, SimulatedUnit] = {}
    planned: dict[SimulatedPoint, _Plan] = {}
    for unit in declared:
        forms = [
            form_of(each.section) for each in unit.section.stored if isinstance(each.section, SimulatedPointSection)
        ]
        sections = {form.section.name: form.section for form in forms}
        for number in unit.section.unit:
            device = build_device(unit.section)
            points = [SimulatedPoint(number, form, device, sections.get(form.section.scale_from)) for form in forms]
            planned |= {point: plan for point in points if (plan := plans.get(id(point.section))) is not None}
            units[number] = SimulatedUnit(
                number,
                unit.section.name,
                unit.section.description,
                device,
                {point.name: point for point in points},
            )
    points_by_key = {point.key: point for unit in units.values() for point in unit.points.values()}
    needed = _needed(units, planned)
    driven = [
        _driven(point, planned[point], units, seed, rank, order)
        for order, (point, rank) in enumerate(_in_order(planned, needed).items())
    ]
    return BuiltUnits(units, points_by_key, driven)


@dataclass(frozen=True, slots=True)
class _Plan:
    """The parts of a point's behaviour that are the same for all units built from one section of a file.

    Attributes:
        section: the behaviour's section in the file.
        problem: returns an error about a key of that section; takes the path of the key in the section and a message.
        expressions: the parsed expressions of the section, by key of the section.
        recording: the recording of a replay; None for other behaviours.
    """

    section: BehaviourSection
    problem: Callable[[KeyPath, str], ConfigError]
    expressions: dict[str, Expression] = field(default_factory=dict)
    recording: Recording | None = None


def _plans(declared: Sequence[DeclaredUnit], read: Reader) -> dict[int, _Plan]:
    """Return the shared parts of each declared behaviour, by ``id()`` of the section of its point.

    Raises:
        FileError: an expression or a recording is invalid; the error has all problems.
    """
    problems: list[ConfigError] = []
    plans: dict[int, _Plan] = {}
    recordings: dict[str, Recording] = {}
    for unit in declared:
        for placed in unit.section.stored:
            point = placed.section
            if isinstance(point, SimulatedPointSection) and point.behaviour is not None:
                problem = _problems_at(unit, (*placed.path, "behaviour"))
                try:
                    plans[id(point)] = _plan(point.behaviour, problem, unit.source.name, read, recordings)
                except FileError as error:
                    problems += error.problems
    if problems:
        raise FileError(in_order(problems))
    return plans


def _problems_at(unit: DeclaredUnit, path: KeyPath) -> Callable[[KeyPath, str], ConfigError]:
    return lambda inner, sentence: unit.problem((*path, *inner), sentence)


def _plan(
    section: BehaviourSection,
    problem: Callable[[KeyPath, str], ConfigError],
    name: str,
    read: Reader,
    recordings: dict[str, Recording],
) -> _Plan:
    expressions: dict[str, Expression] = {}
    for key in section.expressions:
        text = getattr(section, key)
        if isinstance(text, str):
            try:
                expressions[key] = parse_expression(text)
            except ConfigError as error:
                raise FileError([problem((key,), error.message)]) from None
    recording = None
    if isinstance(section, ReplaySection):
        path = within(name, section.file)
        try:
            recording = recordings.get(path) or recordings.setdefault(path, parse_recording(read(path), path))
        except FileError:
            raise
        except ConfigError as error:
            raise FileError([problem(("file",), f"{path}: {error.message}")]) from None
    return _Plan(section, problem, expressions, recording)


def _needed(
    units: Mapping[int, SimulatedUnit], planned: Mapping[SimulatedPoint, _Plan]
) -> dict[SimulatedPoint, list[SimulatedPoint]]:
    """For each point with a formula, return the points whose values the formula needs at the same moment.

    The expressions of counters and lags are checked, too, but not returned.

    Raises:
        FileError: an expression names a point that does not exist or is no number; the error has all problems.
    """
    problems: list[ConfigError] = []
    found: dict[SimulatedPoint, list[SimulatedPoint]] = {}
    for point, plan in planned.items():
        for key, expression in plan.expressions.items():
            inputs = []
            for name in expression.names:
                other = find_point(units, point.unit, name)
                if other is None:
                    problems.append(plan.problem((key,), _absent(units, point.unit, name)))
                elif not _is_number(other.section):
                    problems.append(plan.problem((key,), f"{shown(name)} holds no number, but {other.type}"))
                else:
                    inputs.append(other)
            if isinstance(plan.section, FormulaSection):
                found[point] = inputs
    if problems:
        raise FileError(in_order(problems))
    return found


def find_point(units: Mapping[int, SimulatedUnit], unit: int, name: str) -> SimulatedPoint | None:
    """Return the point that a name in a formula refers to; None if there is no such point.

    Args:
        units: all units by number.
        unit: number of the unit with the formula.
        name: name of a point of that unit, or ``UNIT/NAME`` for a point of any unit.
    """
    own = units[unit].points.get(name)
    if own is not None:
        return own
    number, slash, rest = name.partition("/")
    other = units.get(int(number)) if slash and number.isascii() and number.isdecimal() else None
    return None if other is None else other.points.get(rest)


def _absent(units: Mapping[int, SimulatedUnit], unit: int, name: str) -> str:
    there = list(units[unit].points)
    more = ", …" if len(there) > _SHOWN_NAMES else ""
    return f"there is no point {shown(name)}; there are {', '.join(there[:_SHOWN_NAMES])}{more}"


_SHOWN_NAMES: Final = 12


def _is_number(section: SimulatedPointSection) -> bool:
    return section.is_number or section.form is None


def _in_order(
    planned: Mapping[SimulatedPoint, _Plan], needed: Mapping[SimulatedPoint, Sequence[SimulatedPoint]]
) -> dict[SimulatedPoint, int]:
    """Return the points with behaviours in an order in which formulas can be computed, each with its rank.

    The rank is the largest number of changes of unit along a chain of formulas that ends with the point's formula.

    Args:
        planned: the points with behaviours.
        needed: for each point with a formula, the points that the formula needs at the same moment.

    Raises:
        FileError: a formula depends on itself.
    """
    ranks: dict[SimulatedPoint, int] = {point: 0 for point in planned if point not in needed}
    for first in planned:
        if first in ranks:
            continue
        path: dict[SimulatedPoint, Iterator[SimulatedPoint]] = {first: iter(needed[first])}
        while path:
            point = next(reversed(path))
            other = next((each for each in path[point] if each in planned and each not in ranks), None)
            if other is None:
                handed = (ranks.get(each, 0) + (each.unit != point.unit) for each in needed[point])
                ranks[point] = max(handed, default=0)
                del path[point]
            elif other in path:
                circle = [*list(path)[list(path).index(other) :], other]
                names = " → ".join(each.key if _spans(circle) else each.name for each in circle)
                raise FileError([planned[other].problem(("formula",), f"depends on itself: {names}")])
            else:
                path[other] = iter(needed[other])
    return ranks


def _spans(points: Sequence[SimulatedPoint]) -> bool:
    """Whether the points are in more than one unit."""
    return len({point.unit for point in points}) > 1


def _driven(
    point: SimulatedPoint, plan: _Plan, units: Mapping[int, SimulatedUnit], seed: int, rank: int, order: int
) -> Driven:
    def source(name: str) -> Callable[[], Number]:
        other = find_point(units, point.unit, name)
        assert other is not None  # `_needed` has seen it
        return lambda: other.number

    section = point.section
    around = Surroundings(
        point.key,
        seed,
        _start(section, point.number),
        *limits_of(section),
        begin_of(point.form),
        largest_of(point.form),
        goes_below_begin(point.form),
        plan.expressions,
        plan.recording,
        source,
    )
    behaviour: Behaviour = make_behaviour(plan.section, around)
    return Driven(point, behaviour, plan.section.every, rank, order)


def _start(section: SimulatedPointSection, number: float) -> float:
    """Return the initial value of a point, not rounded to its register type."""
    value = section.value
    return float(value) if isinstance(value, int | float) else number
