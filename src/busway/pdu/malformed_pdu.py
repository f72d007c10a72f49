"""The error for a received message that breaks a rule of its function, with the exception code to reply."""

from ..codes import ExceptionCode


class MalformedPdu(ValueError):
    """Error: a received message breaks a rule of its function.

    Attributes:
        reason: which rule is broken, in words.
        code: exception code with which a server refuses the message if it is a request; 03 for quantities and lengths.
    """

    def __init__(self, reason: str, code: int = ExceptionCode.ILLEGAL_DATA_VALUE) -> None:
        super().__init__(reason)
        self.reason = reason
        self.code = code
