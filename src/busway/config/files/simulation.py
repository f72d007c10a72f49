"""The schema of simulation files: device files whose points have ranges, names for numbers, and behaviours.

Knows what can be written and what fits together; knows no device that behaves (`apps.simulator`). Every device file and
every configuration file is a simulation file too.

An example is in `docs/simulator.md`.

Rules:

1. If a point has a range or names, its first value lies in the range and has a name. A value that Modbus writes must
   too, else it is refused with 04.
2. Names stand for numbers: ``value = "auto"`` where ``enumeration = { auto = 1 }``.
3. A hole is an address between the first and the last item of a table that no point takes. It is refused (02), or is
   read as a value and cannot be written. A table that is declared has no holes.
4. A behaviour that begins somewhere (counter, random-walk, lag) goes on from ``value``; with the others, ``value``
   would never be seen and is refused.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field, model_validator

from ...access.notation import parse_units
from ...codes import Table
from ...errors import InvalidRequest
from ...options.declaration import Name, Range
from ...points.expression import parse_expression
from ...values.unfit_values import shown
from .behaviours import ConstantSection, DeclaredBehaviour, RandomWalkSection
from .device import OF_GROUP, GroupSection, UnitSection, Whole
from .fault_sections import FaultSection
from .key_lines import KeyPath
from .points import PointSection, checked, resolved
from .section import NO_LIST, NO_TABLE, Section, json_schema, keys_of
from .system import DEFAULT_LISTEN, SystemFile

REFUSE: Final = "refuse"


def _as_hole(value: object) -> object:
    if value == REFUSE or (isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 0xFFFF):
        return value
    raise ValueError(f'must be "{REFUSE}", or the value that is read, 0…65535, not {shown(value)}')


def _as_holes(value: object) -> object:
    return value if isinstance(value, dict) else dict.fromkeys((table.value for table in Table), value)


Hole = Annotated[str | int, BeforeValidator(_as_hole, json_schema_input_type=Whole | str)]


class HolesSection(Section):
    """``holes`` of a simulated unit: what is read at addresses between its points, by table."""

    holding_registers: Annotated[Hole, "`refuse` (exception 02), or the value that is read."] = REFUSE
    input_registers: Annotated[Hole, "the same of input registers."] = REFUSE
    coils: Annotated[Hole, "the same of coils."] = REFUSE
    discrete_inputs: Annotated[Hole, "the same of discrete inputs."] = REFUSE

    def value(self, table: Table) -> int | None:
        """Return the value that is read at addresses between the points of a table; None if such reads are refused.

        It is 0 or 1 for a table of bits.
        """
        declared = getattr(self, table.value)
        if not isinstance(declared, int):
            return None
        return int(declared != 0) if table.holds_bits else declared


DeclaredHoles = Annotated[HolesSection, BeforeValidator(_as_holes, json_schema_input_type=Hole | HolesSection)]


class SimulatedPointSection(PointSection):
    """``[[unit.point]]`` of a simulation: one named value and the behaviour that changes it."""

    behaviour: Annotated[
        DeclaredBehaviour | None, "what makes the value of a number or a single bit change; None: it is written alone."
    ] = None

    def faults(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield the errors of keys of this point that do not go together, each as path and sentence.

        If the keys of the point itself have no errors, those of its behaviour are yielded.
        """
        faults = list(super().faults())
        yield from faults or self._behaviour_faults()

    def moved(self, prefix: str, by: int, known: Sequence[str]) -> "SimulatedPointSection":
        """Return a copy of the point for one repetition of its group, with full names of points also in its behaviour.

        Args:
            prefix: text before its name: ``string.1.``.
            by: number of items to add to its address.
            known: full names of points around it, those of the nearest group first, which names in it can mean.

        Raises:
            InvalidRequest, ValidationError: the point would not lie in its table.
        """
        moved = super().moved(prefix, by, known)
        assert isinstance(moved, SimulatedPointSection)
        if moved.behaviour is None:
            return moved
        changes = {
            key: parse_expression(text).renamed(lambda name: resolved(name, known))
            for key in moved.behaviour.expressions
            if isinstance(text := getattr(moved.behaviour, key), str)
        }
        return moved.model_copy(update={"behaviour": moved.behaviour.model_copy(update=changes)}) if changes else moved

    def _behaviour_faults(self) -> Iterator[tuple[KeyPath, str]]:
        if self.behaviour is None:
            return
        if self.is_computed:
            yield ("behaviour",), f"{shown(self.name)} is computed and has no behaviour"
            return
        if self.form is not None and not self.is_number:
            yield ("behaviour",), f"{self.form.name} is no number and has no behaviour"
            return
        if isinstance(self.behaviour, ConstantSection) and self.is_number:
            constant = float(self.behaviour.value)
            try:
                self.raw(int(constant) if constant.is_integer() else constant)
            except InvalidRequest as error:
                yield ("behaviour", "value"), error.message
        if isinstance(self.behaviour, RandomWalkSection):
            low = self.minimum if self.behaviour.low is None else self.behaviour.low
            high = self.maximum if self.behaviour.high is None else self.behaviour.high
            if low is not None and high is not None and not low < high:
                key = "low" if self.behaviour.high is None else "high"
                yield ("behaviour", key), f"low, {low:g}, must be below high, {high:g}"
        if self.value is not None and not self.behaviour.begins:
            yield ("value",), f"would never be seen: the behaviour, {self.behaviour.kind}, gives the value at once"


class SimulatedGroupSection(GroupSection):
    """``[[unit.group]]`` of a simulation: a group of points with behaviours."""

    point: Annotated[Sequence[SimulatedPointSection], OF_GROUP] = NO_LIST
    group: Annotated["Sequence[SimulatedGroupSection]", "groups in it."] = NO_LIST


class SimulatedUnitSection(UnitSection):
    """``[[unit]]`` of a simulation: a device whose points have behaviours."""

    point: Annotated[Sequence[SimulatedPointSection], "its points."] = NO_LIST
    group: Annotated[Sequence[SimulatedGroupSection], "points that belong together."] = NO_LIST
    holes: Annotated[
        DeclaredHoles,
        "what is answered for the addresses between the first and the last item of a table that no point takes:",
        "`refuse` (exception 02), a value that is read there, or a table that says it for each table. A table that is",
        "declared has none.",
    ] = HolesSection()

    def hole(self, table: Table) -> int | None:
        """Return the value that is read at addresses between the points of a table; None if such reads are refused."""
        return self.holes.value(table)


Parameter = int | float | bool | str
"""Type of the value of a file's parameter."""


class IncludeSection(Section):
    """``[[include]]``: adds the units of another file, or one unit of it several times."""

    file: Annotated[str, Name("the path of a file"), "the file, relative to this one."]
    units: Annotated[
        str | None, 'which units are made of its one unit, `"1-100"`; None: all of its units, with their numbers.'
    ] = None
    with_: Annotated[dict[str, Parameter], "its parameters: `with = { base = 231.5 }`."] = Field(
        default_factory=dict, alias="with"
    )

    def numbers(self) -> list[int] | None:
        """Return the numbers of the units that the include creates, ascending; None to take those of the included file.

        Raises:
            ConfigError: ``units`` is invalid.
        """
        return None if self.units is None else sorted(parse_units(self.units))

    @model_validator(mode="after")
    def _check(self) -> "IncludeSection":
        checked("units", self.numbers)
        return self


class ParameterKeys(Section):
    """Keys of an included file for its parameters and its own includes."""

    parameters: Annotated[dict[str, Parameter], "parameters with their defaults, for `${name}` in texts."] = NO_TABLE
    required: Annotated[list[str], "names of parameters without a default."] = NO_LIST
    include: Annotated[list[IncludeSection], "other files whose units are added."] = NO_LIST


class ProfileFile(ParameterKeys):
    """The contents of an included file; its units are checked one by one as they are created."""

    # Any: they may hold parameters still
    unit: Annotated[list[dict[str, Any]], "its units."] = NO_LIST


class SimulationSection(Section):
    """``[simulation]``: options that apply to the whole simulation."""

    keep: Annotated[
        str | None, Name("the path of a file"), "file that keeps values over a restart; None: they are not kept."
    ] = None
    keep_every: Annotated[float, Range(0.1, 86_400), "seconds after which it is written again."] = 10.0
    seed: Annotated[int, Range(0, math.inf), "what chance depends on: the same seed gives the same values."] = 0


class SimulationFile(SystemFile, ParameterKeys):
    """The checked contents of a simulation file."""

    simulation: Annotated[SimulationSection, "options that apply to the whole simulation."] = SimulationSection()
    fault: Annotated[list[FaultSection], "faults that its devices have."] = NO_LIST
    unit: Annotated[Sequence[SimulatedUnitSection], "the devices."] = NO_LIST

    def places(self) -> list[tuple[KeyPath, str]]:
        """Return the URLs to listen on, each with its path in the file.

        If the file names none, the only one is the default URL `DEFAULT_LISTEN`; a file that has neither units nor
        includes then has none.
        """
        return super().places() or ([(("include",), DEFAULT_LISTEN)] if self.include else [])

    def _whole_faults(self) -> Iterator[tuple[KeyPath, str]]:
        missing = [(("unit",), "is missing")] if not self.unit and not self.include else []
        yield from missing
        yield from (each for each in super()._whole_faults() if each != (("unit",), "is missing"))


def simulation_schema(title: str) -> dict[str, Any]:  # Any: what JSON has
    """Return the JSON Schema of simulation files and the profiles they include.

    In place of a number, true or false it also allows a text with a parameter, ``${name}``.
    """
    document = json_schema(SimulationFile, title)
    document["$defs"]["SimulatedUnitSection"]["required"].remove("unit")
    found: dict[str, Any] = _or_parameter(document)
    return found


def _or_parameter(node: Any) -> Any:
    if isinstance(node, list):
        return [_or_parameter(each) for each in node]
    if not isinstance(node, dict):
        return node
    if node.get("type") in ("integer", "number", "boolean"):
        return {"anyOf": [node, {"type": "string", "pattern": r"\$\{"}]}
    return {key: each if key == "default" else _or_parameter(each) for key, each in node.items()}


_OF_A_UNIT: Final = re.compile(r"(?P<part>unit\[\d+\]\.(point\[\d+\]\.)?)?(?P<key>\w+)")


def is_only_of_simulations(key: str) -> bool:
    """Whether a key is allowed in simulation files only, such as ``include`` or ``unit[0].point[2].behaviour``."""
    found = _OF_A_UNIT.fullmatch(key)
    if found is None:
        return False
    here, plain = _SECTIONS[(found["part"] or "").count(".")]
    return found["key"] in keys_of(here).keys() - keys_of(plain).keys()


_SECTIONS: Final[tuple[tuple[type[Section], type[Section]], ...]] = (
    (SimulationFile, SystemFile),
    (SimulatedUnitSection, UnitSection),
    (SimulatedPointSection, PointSection),
)
