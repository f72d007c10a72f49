"""Fault profiles of devices that close or refuse connections."""

from typing import Annotated
from weakref import WeakSet

from ..fault import SILENCE, Contact, Emission, Exchange, Fault
from ..profile import SECONDS, Carrier, FaultProfile

_CONNECTIONS = frozenset({Carrier.CONNECTION})


def _close_if_silent(
    seconds: Annotated[float, SECONDS, "seconds within which the first request must come"] = 1.0,
) -> Fault:
    def closes_at(contact: Contact) -> float | None:
        return contact.opened + seconds if contact.last_received is None else None

    return Fault(closes_at=closes_at)


def _single_client(
    starve: Annotated[bool, "the second connection is taken and never answered, instead of being closed"] = False,
) -> Fault:
    starved: WeakSet[Contact] = WeakSet()

    def admits(contact: Contact) -> bool:
        if contact.others and starve:
            starved.add(contact)
        return starve or not contact.others

    def asked(exchange: Exchange) -> bytes | None:
        return SILENCE if exchange.contact in starved else None

    return Fault(admits=admits, asked=asked)


def _idle_close(
    seconds: Annotated[float, SECONDS, "seconds without a request, after which the connection is closed"] = 30.0,
) -> Fault:
    def closes_at(contact: Contact) -> float | None:
        return (contact.opened if contact.last_received is None else contact.last_received) + seconds

    return Fault(closes_at=closes_at)


def _execute_then_drop() -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        if not exchange.is_write:
            return emissions
        return [Emission(exchange.transaction, exchange.unit, closes=True)]

    return Fault(answered=answered)


CLOSE_IF_SILENT = FaultProfile(
    "close-if-silent",
    "closes a connection on which nothing is sent soon",
    ("huawei_solar#1436",),
    "connects at the first need and sends at once",
    _close_if_silent,
    _CONNECTIONS,
)
SINGLE_CLIENT = FaultProfile(
    "single-client",
    "refuses or starves the second connection",
    ("home-assistant/core#149494",),
    "shares one link per endpoint",
    _single_client,
    _CONNECTIONS,
)
IDLE_CLOSE = FaultProfile(
    "idle-close",
    "closes a connection that was idle for a while",
    ("core#101982",),
    "opens it again in silence at the next need",
    _idle_close,
    _CONNECTIONS,
)
EXECUTE_THEN_DROP = FaultProfile(
    "execute-then-drop",
    "performs a write and closes the connection before the reply",
    ("grid-x/modbus#133",),
    "ends with `WriteOutcomeUnknown` and does not write twice",
    _execute_then_drop,
    _CONNECTIONS,
)
