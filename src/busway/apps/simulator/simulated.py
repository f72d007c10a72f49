"""Data of a running simulation: a simulated point, its unit, and a change of its value.

Knows the device that holds the point; knows no behaviour beyond its name, and no clock: times are seconds of the
simulation since its beginning.

1. The registers are the truth: ``value`` is what a client would read.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from ...codes import Table
from ...config.devices import put_value
from ...config.files.behaviours import described
from ...config.files.simulation import SimulatedPointSection
from ...errors import BadReply, InvalidRequest
from ...server.blocks import BitRun, RegisterRun
from ...server.device import Device
from ...values import format_address
from ...values.refusal import shown
from .registers import PointForm, place_of

SIMULATION: Final = "simulation"
"""Who has written what a behaviour gave, or the file."""


class SimulatedPoint:
    """One named value of a simulated device, with its place in the registers and its behaviour.

    Attributes:
        key: ``UNIT/NAME``, its name in the simulation.
        unit: number of its unit.
        device: the device that has it.
        form: how its value is encoded.
        memory: the run that holds its bytes.
        offset: where they begin in it, in bytes (one bit: in bits).
        held: the number of the hold under which it was set by hand, or 0 while it follows its behaviour.
        number: its value as formulas see it; NaN for what is no number.
        stored: what the registers were last given, a number of the type or ``bool``.
        changed_at: when its value changed last, in seconds of the simulation.
        last_writer: ``simulation``, ``api``, or the address of a Modbus client.
    """

    __slots__ = (
        "changed_at",
        "device",
        "form",
        "held",
        "key",
        "last_writer",
        "memory",
        "number",
        "offset",
        "stored",
        "unit",
    )

    def __init__(self, unit: int, form: PointForm, device: Device) -> None:
        place = place_of(form, device)
        self.unit: int = unit
        self.key: str = f"{unit}/{form.section.name}"
        self.device: Device = device
        self.form: PointForm = form
        self.memory: RegisterRun | BitRun = place.memory
        self.offset: int = place.offset
        self.held: int = 0
        self.stored: Any = None  # a number of the type, or bool
        self.number: float = 0.0
        self.changed_at: float = 0.0
        self.last_writer: str = SIMULATION
        self.look()

    @property
    def section(self) -> SimulatedPointSection:
        """The declaration of the point in its file."""
        return self.form.section

    @property
    def name(self) -> str:
        """Name of the simulated point in its unit."""
        return self.form.section.name

    @property
    def table(self) -> Table:
        """Table that the point is in."""
        return self.form.table

    @property
    def address(self) -> int:
        """Address of the point's first item, 0-based as on the wire."""
        return self.form.address

    @property
    def bit(self) -> int | None:
        """Bit number of the point in its register, 0…15; None for whole items."""
        return self.form.bit

    @property
    def notation(self) -> str:
        """Address of the point as people write it: ``4x101``."""
        return format_address(self.form.section.place)

    @property
    def type(self) -> str:
        """Name of the point's value type, or ``bit``."""
        return "bit" if self.form.form is None else self.form.form.name

    @property
    def order(self) -> str:
        """Byte and register order of the point in letters; empty for one bit."""
        return "" if self.form.form is None else self.form.form.order

    @property
    def scale(self) -> float:
        """Change of the value, in the unit of measure, for one step of the raw number."""
        return self.form.section.scale

    @property
    def unit_of_measure(self) -> str:
        """Unit of measure of the point, such as ``V`` or ``°C``."""
        return self.form.section.unit_of_measure

    @property
    def description(self) -> str:
        """Description of the point in words, from its file."""
        return self.form.section.description

    @property
    def access(self) -> str:
        """What Modbus clients may do with the point: ``read`` or ``read-write``."""
        return "read-write" if self.form.section.is_writable else "read"

    @property
    def minimum(self) -> float | None:
        """Smallest value that may be written to the point."""
        return self.form.section.minimum

    @property
    def maximum(self) -> float | None:
        """Largest value that may be written to the point."""
        return self.form.section.maximum

    @property
    def enumeration(self) -> Mapping[str, int]:
        """Names of the point's values; empty if they have none."""
        return self.form.section.enumeration

    @property
    def behaviour(self) -> str:
        """Short description of the point's behaviour; empty if it has none."""
        section = self.form.section.behaviour
        return "" if section is None else described(section)

    @property
    def is_held(self) -> bool:
        """Whether the point was set by hand and keeps that value instead of following its behaviour."""
        return self.held > 0

    @property
    def value(self) -> Any:  # what its type says
        """Value of the point in its unit of measure, as a client reads it; None if the registers are invalid in its
        type.
        """
        try:
            return self.section.physical(self._decoded())
        except BadReply:
            return None

    @property
    def label(self) -> str | None:
        """Name of the point's current value, if it has one."""
        value = self.value
        return next((name for name, number in self.enumeration.items() if number == value), None)

    @property
    def raw(self) -> str:
        """Registers of the point in hexadecimal, ``4366 8000``; for one bit ``0`` or ``1``."""
        if self.form.form is None:
            return str(int(self._decoded()))
        return (self.device.peek(self.table, self.address, self.form.size) or b"").hex(" ", 2).upper()

    def look(self) -> None:
        """Read the point's value from its registers again, because a client has written them."""
        try:
            self.stored = self._decoded()
        except BadReply:
            self.stored = None
        value = None if self.stored is None else self.section.physical(self.stored)
        self.number = float(value) if isinstance(value, int | float) else math.nan

    def _decoded(self) -> Any:  # what its type says
        """Return the content of the point's registers, decoded by its type."""
        form, offset = self.form.form, self.offset
        if form is None:
            return bool(self.memory.data[offset >> 3] >> (offset & 7) & 1)
        return form.decode(self.memory.data[offset : offset + 2 * form.registers])[0]

    def put(self, value: Any) -> None:  # what its type says
        """Set the simulated point to a value in its unit of measure, or to a named value.

        Raises:
            InvalidRequest: it does not fit the type, the range or the names.
        """
        try:
            put_value(self.device, self.section, value)
        except InvalidRequest as error:
            raise InvalidRequest(f"{self.key}: {error.message}") from None
        self.look()

    def __repr__(self) -> str:
        return f"<{self.key} {self.notation} = {shown(self.value)}>"


@dataclass(frozen=True, slots=True)
class SimulatedUnit:
    """One unit of a simulation with its device and points.

    Attributes:
        unit: its number, 0…255.
        name: its name; empty if the file gives it none.
        description: the description of the unit.
        device: the device to serve.
        points: its points by their name in the unit, in the order of the file.
    """

    unit: int
    name: str
    description: str
    device: Device
    points: Mapping[str, SimulatedPoint]


@dataclass(frozen=True, slots=True)
class PointChanged:
    """A new value of a simulated point, with its time and who set it.

    Attributes:
        point: which.
        value: what it holds now, in the unit of measure; in a float, not yet rounded to the registers.
        at: when, in seconds of the simulation.
        who: ``simulation``, ``api``, or the address of a Modbus client.
    """

    point: SimulatedPoint
    value: Any  # what the point's type says
    at: float
    who: str

    @property
    def key(self) -> str:
        """Key of the changed point: ``UNIT/NAME``."""
        return self.point.key
