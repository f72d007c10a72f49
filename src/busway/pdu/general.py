"""Messages that are not of one function: exceptions, and what the table of functions does not know.

Knows their bytes; knows no function.
"""

from dataclasses import dataclass

from ..codes import exception_meaning
from .fields import rest, u8
from .message import Request, SelfCoded


class ExceptionResponse(SelfCoded):
    """The negative answer of any function: its code + 0x80 and an exception code (Application Protocol §7)."""

    exception_bit = True
    function: int = u8(0, 0x7F)
    exception: int = u8()

    @property
    def meaning(self) -> str:
        """The exception code in words."""
        return exception_meaning(self.exception)


class OpaqueRequest(SelfCoded):
    """A request whose function is not in the table: carried as bytes, so that a gateway can forward it."""

    function: int = u8(0, 0x7F)
    data: bytes = rest()


class OpaqueReply(SelfCoded):
    """A reply whose function is not in the table."""

    function: int = u8(0, 0x7F)
    data: bytes = rest()


@dataclass(frozen=True, slots=True)
class MalformedRequest:
    """A request of a known function that breaks one of its rules; what a server answers with ``code``."""

    function: int
    kind: type[Request]
    data: bytes
    reason: str
    code: int

    def encode(self) -> bytes:
        """The PDU as it came."""
        return self.data
