"""Messages that belong to no single function: exceptions, requests and replies of unknown functions, broken requests.

Knows their bytes; knows no function.
"""

from dataclasses import dataclass

from ..codes import FunctionCode, MeiType, exception_meaning
from .fields import rest, u8
from .malformed import MalformedPdu
from .message import UNKNOWN_LENGTH, Message, Request, SelfCoded


class ExceptionResponse(SelfCoded):
    """The exception reply of any function: its code + 0x80 and an exception code (Application Protocol §7).

    Attributes:
        function: function code of the request, 0…127, without 0x80.
        exception: the exception code, 0…255.
    """

    exception_bit = True
    function: int = u8(0, 0x7F)
    exception: int = u8()

    @property
    def meaning(self) -> str:
        """The meaning of the exception code in words; for an unknown code, a text that says so."""
        return exception_meaning(self.exception)


def decode_exception(pdu: bytes) -> ExceptionResponse:
    """Decode the PDU of an exception reply.

    For function 43 the form ``AB 0E cc`` is accepted too: the specification's figure has the MEI type between function
    and exception code (Application Protocol V1.1b3 §6.21).

    Raises:
        MalformedPdu: the bytes are no exception reply: not two bytes, or the first is below 0x80.
    """
    if len(pdu) == 3 and pdu[0] == FunctionCode.ENCAPSULATED_INTERFACE | 0x80 and pdu[1] in tuple(MeiType):
        pdu = pdu[:1] + pdu[2:]
    return ExceptionResponse.decode(pdu)


class OpaqueReply(SelfCoded):
    """A reply whose function or sub-function is not in the table of functions; its content is kept as bytes.

    Attributes:
        function: function code, 0…127.
        data: the bytes after the function code, 0…252 of them.
    """

    function: int = u8(0, 0x7F)
    data: bytes = rest()


class OpaqueRequest(Request):
    """A request whose function or sub-function is not in the table of functions; kept as bytes, to be forwarded.

    It counts as a write, because its effect is not known. Its reply is an `OpaqueReply`.

    Attributes:
        function: function code, 0…127.
        data: the bytes after the function code, 0…252 of them.
    """

    self_coded = True
    is_write = True
    function: int = u8(0, 0x7F)
    data: bytes = rest()

    def reply_shape(self) -> tuple[int, bytes]:
        return UNKNOWN_LENGTH, bytes((self.function,))

    def accept(self, pdu: bytes) -> Message:
        if pdu[0] != self.function:
            raise MalformedPdu(f"function {pdu[0]} where {self.function} answers the request")
        return OpaqueReply.decode(pdu)


@dataclass(frozen=True, slots=True)
class MalformedRequest:
    """A received request that breaks a rule of its function; with an unknown function, one that is too long.

    Attributes:
        function: the function code.
        kind: the request class of the function; `OpaqueRequest` if it is unknown.
        data: the PDU as it was received.
        reason: which rule is broken, in words.
        code: the exception code with which a server refuses the request.
    """

    function: int
    kind: type[Request]
    data: bytes
    reason: str
    code: int

    def encode(self) -> bytes:
        """Return the PDU of the broken request as it was received."""
        return self.data
