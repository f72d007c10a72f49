"""Judges what came back for a request: which facets of the exchange are wrong.

Knows requests, frames and what a check accepts; knows no connection and no time.

1. Every finding belongs to one facet. If there is no reply, or it cannot be read as one, later facets are not judged.
2. The limits and lengths of replies are those of the project's own functions, so no rule is written twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ...pdu.functions import STANDARD
from ...pdu.malformed_pdu import MalformedPdu
from ...pdu.message import Request
from ...values.counts import counted
from .check import Accepts, Ask, Facet
from .frames import Frame

_NO_MATTER = (0, 255)
"""Unit identifiers of requests on TCP to which the reply may carry any unit identifier.

Messaging on TCP/IP V1.0b §4.4.2.1.
"""


@dataclass(frozen=True, slots=True)
class CheckedExchange:
    """One request of a check as it was sent, and what came back in time.

    Attributes:
        ask: the step of the check: the request, and the accepted answers.
        unit: unit identifier that was sent.
        transaction: transaction identifier that was sent; without meaning on serial lines.
        sent: the frame that was sent; empty if no connection could be made.
        frames: the frames that came back, in order.
        rest: received bytes that are in no whole frame.
        closed: whether the device closed or refused the connection.
        is_deaf: True if a correct read that followed the request was not answered, although the device had to answer
            it.
    """

    ask: Ask
    unit: int
    transaction: int
    sent: bytes
    frames: tuple[Frame, ...]
    rest: bytes = b""
    closed: bool = False
    is_deaf: bool = False


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of an exchange: the facet that is wrong, and a sentence that says what is wrong."""

    facet: Facet
    words: str


def judge(exchange: CheckedExchange, *, framing: str) -> list[Finding]:
    """Return the faults of an exchange; an empty list if the check accepts it.

    Args:
        exchange: the request and what came back.
        framing: ``mbap``, ``rtu`` or ``ascii``.
    """
    accepts = exchange.ask.accepts
    if exchange.is_deaf:
        return [Finding(Facet.ANSWERED, "the read behind the request was not answered")]
    frames, faults = _without_strangers(exchange, framing)
    if not frames:
        return faults or _nothing_came(exchange, accepts)
    frame = frames[0]
    if frame.protocol:
        faults.append(Finding(Facet.PROTOCOL, f"the protocol identifier of the reply is {frame.protocol}, not 0"))
    asked_any = framing == "mbap" and exchange.unit in _NO_MATTER
    if frame.unit != exchange.unit and not asked_any:
        faults.append(Finding(Facet.UNIT, f"unit {frame.unit} answers where unit {exchange.unit} was asked"))
    return faults + _of_pdu(exchange.ask.pdu, frame.pdu, accepts)


def is_refused_function(exchange: CheckedExchange) -> bool:
    """Whether the reply is exception 01: the device does not have the function of the request."""
    own = [one for one in exchange.frames if one.transaction in (0, exchange.transaction)]
    return bool(own) and own[0].pdu == bytes((exchange.ask.pdu[0] | 0x80, 1))


def _without_strangers(exchange: CheckedExchange, framing: str) -> tuple[Sequence[Frame], list[Finding]]:
    """Return the frames that may be the reply, and the findings for all other frames and bytes that came.

    On MBAP the reply has the transaction identifier of the request; on a line an echo of the request is left out.
    """
    faults = []
    frames = list(exchange.frames)
    if framing == "mbap":
        strange = [one for one in frames if one.transaction != exchange.transaction]
        if strange:
            words = f"a reply has the transaction identifier {strange[0].transaction}, not {exchange.transaction}"
            faults.append(Finding(Facet.TRANSACTION, words))
        frames = [one for one in frames if one.transaction == exchange.transaction]
    elif len(frames) > 1 and exchange.sent.endswith(frames[0].raw):
        faults.append(Finding(Facet.CLEAN, "the bytes of the request came back before the reply"))
        frames = frames[1:]
    if exchange.rest and frames:
        faults.append(Finding(Facet.CLEAN, f"outside of frames {counted(len(exchange.rest), 'byte')} came"))
    elif len(frames) > 1:
        faults.append(Finding(Facet.CLEAN, f"{len(frames)} replies came to one request"))
    return frames, faults


def _nothing_came(exchange: CheckedExchange, accepts: Accepts) -> list[Finding]:
    if exchange.closed:
        if accepts.closed:
            return []
        return [Finding(Facet.ANSWERED, f"the device closed the connection, where {accepts} is right")]
    if exchange.rest:
        return [Finding(Facet.FORM, f"{counted(len(exchange.rest), 'byte')} came, and no whole frame")]
    return [] if accepts.silence else [Finding(Facet.ANSWERED, f"no reply came in time, where {accepts} is right")]


def _of_pdu(asked: bytes, pdu: bytes, accepts: Accepts) -> list[Finding]:
    if asked[0] < 0x80 and pdu[0] & 0x7F != asked[0]:
        return [Finding(Facet.FORM, f"the reply has function code {pdu[0]:02X}, where {asked[0]:02X} was asked")]
    if pdu[0] & 0x80:
        return _of_exception(pdu, accepts)
    if not accepts.reply:
        return [Finding(Facet.CONTENT, f"the request was executed, where {accepts} is right")]
    wrong = _wrong_form(asked, pdu)
    if wrong:
        return [Finding(Facet.FORM, wrong)]
    if accepts.exact is not None and pdu != accepts.exact:
        return [Finding(Facet.CONTENT, f"the reply is {pdu.hex(' ')}, where {accepts.exact.hex(' ')} is right")]
    wrong = accepts.wrong_with(pdu) if accepts.wrong_with is not None else ""
    return [Finding(Facet.CONTENT, wrong)] if wrong else []


def _of_exception(pdu: bytes, accepts: Accepts) -> list[Finding]:
    if len(pdu) != 2:
        return [Finding(Facet.FORM, f"the exception reply has {len(pdu)} bytes, not 2")]
    if pdu[1] in accepts.exceptions:
        return []
    return [Finding(Facet.CONTENT, f"exception {pdu[1]:02X} came, where {accepts} is right")]


def _wrong_form(asked: bytes, pdu: bytes) -> str:
    """Return what is wrong with the length or the limits of a normal reply, in words; empty if nothing is.

    Args:
        asked: the PDU of the request. If it is invalid, the result is empty.
        pdu: the PDU of the reply.
    """
    request = STANDARD.decode_request(asked) if asked[0] < 0x80 else None
    if not isinstance(request, Request):
        return ""
    try:
        request.prepare()
        request.accept(pdu)
    except MalformedPdu as error:
        return error.reason
    return ""
