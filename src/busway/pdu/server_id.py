"""Splits the data of function 17 into the parts of the specification: identification, run indicator, additional data.

Knows bytes; knows no message. The specification leaves the length of the identification to the device and does not say
how to find its end: here the first byte that is 00 or FF is taken for the run indicator.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServerId:
    """What a device reports about itself by function 17 (MODBUS Application Protocol V1.1b3 §6.13).

    Attributes:
        identification: the bytes before the run indicator; all bytes if there is none.
        is_running: the run indicator: True for FF, False for 00, None if there is none.
        additional: the bytes after the run indicator.
    """

    identification: bytes
    is_running: bool | None
    additional: bytes

    @classmethod
    def of(cls, data: bytes) -> "ServerId":
        """Split the data of a reply into its parts: ``ServerId.of(unit.report_server_id())``.

        The first byte that is 00 or FF is taken for the run indicator, so an identification that contains such a byte
        is cut there.

        Args:
            data: as `report_server_id` returns it.
        """
        for place, byte in enumerate(data):
            if byte in (0x00, 0xFF):
                return cls(data[:place], byte == 0xFF, data[place + 1 :])
        return cls(data, None, b"")
