"""The exception reply of any function, and its decoder.

Knows its bytes; knows no function but 43, whose exceptions may be a byte longer.
"""

from ..codes import FunctionCode, MeiType, exception_meaning
from .fields import u8
from .message import SelfCoded


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
