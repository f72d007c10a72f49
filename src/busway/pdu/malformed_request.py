"""A received request that breaks a rule of its function: its bytes, the rule, and the exception code for it.

Knows no rule; the message classes have them.
"""

from dataclasses import dataclass

from .message import Request


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
