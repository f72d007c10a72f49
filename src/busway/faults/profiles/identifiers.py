"""Fault profiles of devices that answer with a wrong transaction identifier or unit."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

from ...options.declaration import Range
from ..fault import Emission, Exchange, Fault
from ..profile import Carrier, FaultProfile

_TCP = frozenset({Carrier.TCP})


def _foreign_transaction(
    instead: Annotated[bool, "the own reply does not come"] = False,
    distance: Annotated[int, Range(1, 0xFFFF), "from the own identifier to the foreign one"] = 0x4000,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        foreign = [replace(one, transaction=(one.transaction + distance) & 0xFFFF) for one in emissions]
        return foreign if instead else foreign + emissions

    return Fault(answered=answered)


def _transaction(identifier: Callable[[Exchange], int]) -> Callable[[], Fault]:
    def make() -> Fault:
        def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
            return [replace(one, transaction=identifier(exchange) & 0xFFFF) for one in emissions]

        return Fault(answered=answered)

    return make


def _unit(number: int) -> Callable[[], Fault]:
    def make() -> Fault:
        def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
            return [replace(one, unit=number) for one in emissions]

        return Fault(answered=answered)

    return make


_POLICY = (
    "drops it, or takes it by `transaction_policy`: automatic only with one request in flight and all else fitting"
)
_UNIT_POLICY = (
    "ends with `BadReply` (on a line, where others talk too, with `NoReply`), or takes it by `unit_policy`: automatic "
    "only with one request in flight"
)

FOREIGN_TRANSACTION = FaultProfile(
    "foreign-transaction",
    "replies that are meant for another client",
    ("tmodbus#88",),
    "drops and counts them, and makes the connection anew after `recycle_after_foreign` in a row",
    _foreign_transaction,
    _TCP,
)
TRANSACTION_PLUS_ONE = FaultProfile(
    "transaction+1",
    "the identifier of the reply is one more than that of the request",
    ("sunsynk#680",),
    _POLICY,
    _transaction(lambda exchange: exchange.transaction + 1),
    _TCP,
)
TRANSACTION_ZERO = FaultProfile(
    "transaction=0",
    "the identifier of the reply is 0",
    ("Modbus#18",),
    _POLICY,
    _transaction(lambda exchange: 0),
    _TCP,
)
TRANSACTION_RANDOM = FaultProfile(
    "transaction=random",
    "the identifier of the reply is any number",
    ("sunsynk#532",),
    _POLICY,
    _transaction(lambda exchange: exchange.random.getrandbits(16)),
    _TCP,
)
UNIT_255 = FaultProfile("unit=255", "answers as unit 255", ("sunsynk#532",), _UNIT_POLICY, _unit(255))
UNIT_0 = FaultProfile("unit=0", "answers as unit 0", ("pymodbus#2571",), _UNIT_POLICY, _unit(0))
UNIT_1 = FaultProfile("unit=1", "answers as unit 1", ("sunsynk#532",), _UNIT_POLICY, _unit(1))
