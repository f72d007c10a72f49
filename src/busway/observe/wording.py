"""Describes a PDU in one line of words, for lists of frames.

Knows the describer of PDUs; knows no frame and no connection.
"""

from ..framing.received import Direction
from ..pdu.describe import Description, describe_reply, describe_request
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.message import Message


def described(
    pdu: bytes, direction: Direction, *, request: Message | None = None, functions: FunctionTable = STANDARD
) -> Description:
    """Return the description of a PDU: function and fields in words, and what is wrong.

    Args:
        pdu: function code and data.
        direction: whether it is a reply; anything else is described as a request.
        request: the request that a reply answers, if known.
        functions: the table of functions.
    """
    if direction is Direction.REPLY:
        return describe_reply(pdu, functions, request=request)
    return describe_request(pdu, functions)


def in_words(description: Description) -> str:
    """Return function, direction and all fields of a PDU in one line; faults come last, after an exclamation mark."""
    fields = [f"{part.name} {part.text or part.data.hex(' ')}".rstrip() for part in description.parts[1:]]
    sentence = description.title
    if fields:
        sentence += f": {'; '.join(fields)}"
    if description.problems:
        sentence += f" ! {'; '.join(description.problems)}"
    return sentence
