"""Data of a running simulation: a simulated point, its unit, and a change of its value.

Knows the device that holds the point, and of its behaviour only the declaration; knows no clock: times are seconds of
the simulation since its beginning.

1. The value of a point is always read from its registers: ``value`` is what a client would read.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from ...codes import Table
from ...config.devices import put_value
from ...config.files.behaviours import described
from ...config.files.points import PointSection
from ...config.files.simulation import SimulatedPointSection
from ...errors import BadReply, InvalidRequest
from ...server.device import Device
from ...server.memory_runs import BitRun, RegisterRun
from ...values import format_address
from ...values.unfit_values import shown
from .point_encoding import PointForm, place_of

SIMULATION: Final = "simulation"
"""Name of the writer (`SimulatedPoint.last_writer`) of values that come from a behaviour, or from the file."""


class SimulatedPoint:
    """One named value of a simulated device, with its place in the registers and its behaviour.

    Args:
        unit: number of the unit, 0…255.
        form: how the point's value is encoded.
        device: the device that has the point.
        scale: the declaration of the point that ``scale_from`` names; None without one.

    Attributes:
        key: ``UNIT/NAME``, the name of the point in the simulation.
        unit: number of the unit.
        device: the device that has the point.
        form: how the point's value is encoded.
        memory: the block of the device's memory that holds the value.
        offset: where the value begins in that block, in bytes (for one bit: in bits).
        held: number of the latest setting by hand or by a Modbus client, 1 or more, while the point keeps that value; 0
            while it follows its behaviour, and always 0 without a behaviour.
        number: the value in the unit of measure, as formulas use it; 0 or 1 for one bit, NaN if it is no number.
        stored: the value before scaling, as the registers hold it: a value of the type, or ``bool``; None if the
            registers hold no valid value of the type.
        changed_at: when the value changed or was set last, in seconds of the simulation.
        last_writer: ``simulation``, ``api``, or the address of a Modbus client.
    """

    __slots__ = (
        "_scale",
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

    def __init__(self, unit: int, form: PointForm, device: Device, scale: PointSection | None = None) -> None:
        place = place_of(form, device)
        self._scale = scale
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
        """The name of the simulated point in its unit."""
        return self.form.section.name

    @property
    def table(self) -> Table:
        """The table that the point is in."""
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
        """Address of the point as people write it, counted from 1: ``4x101``."""
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
        """The factor between registers and unit of measure: value = number in the registers × scale (+ an offset)."""
        return self.form.section.scale

    @property
    def unit_of_measure(self) -> str:
        """Unit of measure of the point, such as ``V`` or ``°C``; empty if the file gives none."""
        return self.form.section.unit_of_measure

    @property
    def description(self) -> str:
        """Description of the point in words, from its file; empty if it has none."""
        return self.form.section.description

    @property
    def access(self) -> str:
        """What Modbus clients may do with the point: ``read`` or ``read-write``."""
        return "read-write" if self.form.section.is_writable else "read"

    @property
    def minimum(self) -> float | None:
        """The smallest value that may be written to the point, in its unit of measure; None for no limit."""
        return self.form.section.minimum

    @property
    def maximum(self) -> float | None:
        """The largest value that may be written to the point, in its unit of measure; None for no limit."""
        return self.form.section.maximum

    @property
    def enumeration(self) -> Mapping[str, int]:
        """Numbers by name, for points whose values have names; empty for other points."""
        return self.form.section.enumeration

    @property
    def behaviour(self) -> str:
        """Short description of the point's behaviour; empty if it has none."""
        section = self.form.section.behaviour
        return "" if section is None else described(section)

    @property
    def is_held(self) -> bool:
        """Whether the point was set by hand or by a Modbus client, and keeps that value against its behaviour.

        False for a point without a behaviour.
        """
        return self.held > 0

    @property
    def value(self) -> Any:  # what its type says
        """The value in the unit of measure, read from the registers now; None if they hold no valid value."""
        try:
            return self.section.physical(self._decoded())
        except BadReply:
            return None

    @property
    def label(self) -> str | None:
        """The name of the point's current value; None if the value has no name."""
        value = self.value
        return next((name for name, number in self.enumeration.items() if number == value), None)

    @property
    def raw(self) -> str:
        """Registers of the point in hexadecimal, ``4366 8000``; for one bit ``0`` or ``1``."""
        if self.form.form is None:
            return str(int(self._decoded()))
        return (self.device.peek(self.table, self.address, self.form.size) or b"").hex(" ", 2).upper()

    def look(self) -> None:
        """Update ``stored`` and ``number`` from the point's registers. Call this after the registers were written."""
        try:
            self.stored = self._decoded()
        except BadReply:
            self.stored = None
        value = None if self.stored is None else self.section.physical(self.stored)
        self.number = float(value) if isinstance(value, int | float) else math.nan

    def _decoded(self) -> Any:  # what its type says
        """Return the content of the point's registers, decoded by its type. Raises `BadReply` for invalid content."""
        form, offset = self.form.form, self.offset
        if form is None:
            return bool(self.memory.data[offset >> 3] >> (offset & 7) & 1)
        return form.decode(self.memory.data[offset : offset + 2 * form.registers])[0]

    def put(self, value: Any) -> None:  # what its type says
        """Set the point's registers to a value in its unit of measure, or to a value given by its name.

        The point goes on following its behaviour; `Simulation.set` makes it keep the value.

        Raises:
            InvalidRequest: the value does not fit the type or the range, or is no name of a value.
        """
        try:
            put_value(self.device, self.section, value, self._scale)
        except InvalidRequest as error:
            raise InvalidRequest(f"{self.key}: {error.message}") from None
        self.look()

    def __repr__(self) -> str:
        return f"<{self.key} {self.notation} = {shown(self.value)}>"


@dataclass(frozen=True, slots=True)
class SimulatedUnit:
    """One unit of a simulation with its device and points.

    Attributes:
        unit: number of the unit, 0…255.
        name: name of the unit; empty if the file gives none.
        description: description of the unit, from the file; empty if the file gives none.
        device: the device to serve.
        points: the points by their name in the unit, in the order of the file.
    """

    unit: int
    name: str
    description: str
    device: Device
    points: Mapping[str, SimulatedPoint]


@dataclass(frozen=True, slots=True)
class PointChanged:
    """A new value of a simulated point, with its time and its writer.

    Attributes:
        point: the point.
        value: the new value, in the unit of measure. A float may be more exact here than in the point's registers.
        at: when the value changed, in seconds of the simulation.
        who: the writer: ``simulation``, ``api``, or the address of a Modbus client.
    """

    point: SimulatedPoint
    value: Any  # what the point's type says
    at: float
    who: str

    @property
    def key(self) -> str:
        """The key of the changed point: ``UNIT/NAME``."""
        return self.point.key
