"""Requests for registers wider than two bytes, of devices that answer 4…12 bytes for each register.

Knows how the reply differs from that of functions 03 and 04 (libmodbus#695); knows no link. The specification has no
such registers (MODBUS Application Protocol V1.1b3 §6.3), so a client uses these requests only where it is told to.
"""

from functools import cache
from typing import Any, Final, TypeVar

from ..codes import MAX_READ_REGISTERS
from .fields import rest, rest_length, u16
from .read_items import ReadRegisters

NARROW: Final = 2
"""Bytes of a register by the specification."""
WIDEST: Final = 12
"""Bytes of the widest registers that have been seen in devices."""
MAX_DATA: Final = 2 * MAX_READ_REGISTERS
"""Most bytes of data in a reply, whatever the width of its registers: 250, as with 125 usual registers."""

Read = TypeVar("Read", bound=ReadRegisters)


def wide(kind: type[Read], width: int) -> type[Read]:
    """Return a request class of function 03 or 04 whose reply has ``width`` bytes for each register.

    Its ``count`` is 1…250 divided by ``width``, as many registers as fit into 250 bytes. ``registers`` of the reply has
    one unsigned number, of all its bytes, for each register. The classes are cached.

    Args:
        kind: `ReadHoldingRegisters` or `ReadInputRegisters`.
        width: bytes of a register, 2…12 and even; for 2 the result is ``kind`` itself. It is not checked.
    """
    return kind if width == NARROW else _widened(kind, width)


@cache
def _widened(kind: Any, width: int) -> Any:  # a class and one derived from it
    most = MAX_DATA // width

    class WideReply(kind.Reply):  # type: ignore[misc]  # the class is a value here
        byte_count = rest_length(1, width, most * width, width)
        data: bytes = rest(width, most * width, width)

        @property
        def registers(self) -> list[int]:
            """The registers of the reply as unsigned numbers, each made of all ``width`` bytes of the register."""
            return [int.from_bytes(self.data[at : at + width], "big") for at in range(0, len(self.data), width)]

    class Wide(kind):  # type: ignore[misc]  # the class is a value here
        code = kind.code
        count: int = u16(1, most)
        Reply = WideReply

        def reply_shape(self) -> tuple[int, bytes]:
            return 2 + width * self.count, bytes((self.code, width * self.count))

    Wide.__name__ = Wide.__qualname__ = f"{kind.__name__}{8 * width}"
    Wide.__doc__ = f"`{kind.__name__}` of registers with {width} bytes each."
    return Wide
