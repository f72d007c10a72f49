"""Fault profiles of devices whose replies have wrong contents, or arrive in unusual pieces."""

from dataclasses import replace
from typing import Annotated

from ...codes import FunctionCode
from ...options.declaration import Range
from ..fault import Emission, Exchange, Fault
from ..profile import SECONDS, FaultProfile

_READS_REGISTERS = frozenset({FunctionCode.READ_HOLDING_REGISTERS, FunctionCode.READ_INPUT_REGISTERS})
_ECHOES = frozenset(
    {
        FunctionCode.WRITE_SINGLE_COIL,
        FunctionCode.WRITE_SINGLE_REGISTER,
        FunctionCode.WRITE_MULTIPLE_COILS,
        FunctionCode.WRITE_MULTIPLE_REGISTERS,
        FunctionCode.MASK_WRITE_REGISTER,
    }
)
_LARGEST_BYTE_COUNT = 255


def _is_refusal(pdu: bytes) -> bool:
    return bool(pdu[0] & 0x80) if pdu else True


def _wide_register(
    size: Annotated[
        int, Range(4, 12), "bytes for each register; as many registers are sent as a byte count can announce"
    ] = 4,
) -> Fault:
    def widened(one: Emission) -> Emission:
        registers = [one.pdu[at : at + 2] for at in range(2, len(one.pdu), 2)]
        data = b"".join(register.rjust(size, b"\x00") for register in registers[: _LARGEST_BYTE_COUNT // size])
        return replace(one, pdu=bytes((one.pdu[0], len(data))) + data)

    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        if exchange.function not in _READS_REGISTERS:
            return emissions
        return [one if _is_refusal(one.pdu) else widened(one) for one in emissions]

    return Fault(answered=answered)


def _short(
    missing: Annotated[int, Range(1, 252), "bytes that are not sent"] = 1,
    header: Annotated[bool, "the header's length still counts them, so the frame seems unfinished"] = False,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [
            replace(
                one,
                pdu=one.pdu[: max(len(one.pdu) - missing, 1)],
                length=len(one.pdu) + 1 if header else None,
            )
            for one in emissions
        ]

    return Fault(answered=answered)


def _long(
    extra: Annotated[int, Range(1, 1000), "bytes too many"] = 1,
    header: Annotated[bool, "the header's length counts them; otherwise they stand between two frames"] = True,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [
            replace(one, pdu=one.pdu + bytes(extra), length=None if header else len(one.pdu) + 1) for one in emissions
        ]

    return Fault(answered=answered)


def _wrong_echo() -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        if exchange.function not in _ECHOES:
            return emissions
        return [
            one if _is_refusal(one.pdu) else replace(one, pdu=one.pdu[:-1] + bytes((one.pdu[-1] ^ 1,)))
            for one in emissions
        ]

    return Fault(answered=answered)


def _dribble(
    piece: Annotated[int, Range(1, 260), "bytes per segment"] = 1,
    pause: Annotated[float, SECONDS, "seconds between segments"] = 0.001,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [replace(one, piece=piece, pause=pause) for one in emissions]

    return Fault(answered=answered)


def _glue(
    window: Annotated[float, Range(0.001, 60), "seconds; what is due in the same ones leaves in one segment"] = 0.02,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        wait = window - (exchange.now - exchange.contact.opened) % window
        return [replace(one, delay=one.delay + wait, glued=True) for one in emissions]

    return Fault(answered=answered)


WIDE_REGISTER = FaultProfile(
    "wide-register",
    "4 to 12 bytes for one register",
    ("libmodbus#695",),
    "ends with `BadReply`, unless the link is told their width with `register_width`",
    _wide_register,
)
SHORT = FaultProfile(
    "short",
    "a reply with bytes missing",
    ("phpmodbus#14",),
    "ends with `BadReply` and the bytes; where the header promises more, with `NoReply` of the kind partial",
    _short,
)
LONG = FaultProfile(
    "long",
    "a reply with bytes too many",
    ("esphome#2893",),
    "ends with `BadReply` and the bytes; bytes between frames end the connection",
    _long,
)
WRONG_ECHO = FaultProfile(
    "wrong-echo",
    "the reply to a write differs from the request",
    ("libmodbus#868",),
    "ends with `WriteOutcomeUnknown`, caused by a `BadReply` with the bytes",
    _wrong_echo,
)
DRIBBLE = FaultProfile(
    "dribble",
    "one byte at a time",
    ("pymodbus#688",),
    "puts the frame together",
    _dribble,
)
GLUE = FaultProfile(
    "glue",
    "several frames in one segment",
    ("pymodbus#688",),
    "takes the frames apart",
    _glue,
)
