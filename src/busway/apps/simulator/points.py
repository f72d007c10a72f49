"""Named points of a served device for the program that serves it, read and written in their unit of measure.

Knows points and the device that holds them; knows no connection.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from ...config.devices import put_value
from ...config.files.points import PointSection
from ...errors import InvalidRequest
from ...server.device import Device
from ...values.unfit_values import shown


class Points:
    """The named points of a device, read and set by name: ``points["tank.level"] = 1.5``. May be used in any thread.

    Args:
        device: the device that has the points.
        sections: the points, as the device's file declares them.
    """

    def __init__(self, device: Device, sections: Sequence[PointSection]) -> None:
        self._device = device
        self._sections = {section.name: section for section in sections}

    @property
    def sections(self) -> Mapping[str, PointSection]:
        """The declarations of the device's points by name, in the order of the file."""
        return self._sections

    def __iter__(self) -> Iterator[str]:
        return iter(self._sections)

    def __getitem__(self, name: str) -> Any:  # what the point's type says
        """Return the value of a point in its unit of measure.

        Raises:
            InvalidRequest: there is no such point.
            BadReply: its registers hold no valid value of its type.
        """
        section = self._section(name)
        return section.physical(self._device.read(section.place, section.form))

    def __setitem__(self, name: str, value: Any) -> None:
        """Set a point to a value in its unit of measure.

        Raises:
            InvalidRequest: there is no such point, or the value does not fit its type or range.
        """
        section = self._section(name)
        put_value(self._device, section, value, self._sections.get(section.scale_from))

    def update(self) -> AbstractContextManager[None]:
        """Return a context manager that groups changes of the device: clients see all of these changes, or none."""
        return self._device.update()

    def _section(self, name: str) -> PointSection:
        section = self._sections.get(name)
        if section is None:
            raise InvalidRequest(f"there is no point {shown(name)}; there are {', '.join(self._sections)}")
        return section
