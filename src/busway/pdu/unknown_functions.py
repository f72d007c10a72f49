"""Messages of functions and sub-functions that are not in the table of functions: their content is kept as bytes.

Knows the function code only.
"""

from .fields import rest, u8
from .malformed_pdu import MalformedPdu
from .message import UNKNOWN_LENGTH, Message, Request, SelfCoded


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
