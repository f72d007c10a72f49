"""Fault profiles of devices that reply too late, out of order, or not for a while."""

from collections import deque
from dataclasses import replace
from math import inf
from typing import Annotated
from weakref import WeakKeyDictionary

from ...options.declaration import Range
from ..fault import SILENCE, Contact, Emission, Exchange, Fault
from ..profile import SECONDS, FaultProfile


def _late(delay: Annotated[float, SECONDS, "seconds from request to reply"] = 1.5) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [replace(one, delay=one.delay + delay) for one in emissions]

    return Fault(answered=answered)


def _queue_lag(
    behind: Annotated[int, Range(0, 1000), "requests that replies lag"] = 1,
    stamped: Annotated[bool, "replies carry the identifier of the request they meet"] = False,
    connections: Annotated[
        int | None, Range(0, inf), "how many connections lag, from the first on; nothing for all"
    ] = None,
) -> Fault:
    held: WeakKeyDictionary[Contact, deque[Emission]] = WeakKeyDictionary()
    met: list[None] = []

    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        waiting = held.get(exchange.contact)
        if waiting is None:
            if connections is not None and len(met) >= connections:
                return emissions
            met.append(None)
            waiting = held[exchange.contact] = deque()
        waiting.extend(emissions)
        leaving = [waiting.popleft() for _ in range(len(waiting) - behind)]
        return [replace(one, transaction=exchange.transaction) for one in leaving] if stamped else leaving

    return Fault(answered=answered)


def _mute_after_connect(
    seconds: Annotated[float, SECONDS, "seconds after the connection was made in which nothing is heard"] = 2.0,
) -> Fault:
    def asked(exchange: Exchange) -> bytes | None:
        return SILENCE if exchange.now - exchange.contact.opened < seconds else None

    return Fault(asked=asked)


def _wedged() -> Fault:
    return Fault(asked=lambda exchange: SILENCE)


def _min_gap(seconds: Annotated[float, SECONDS, "seconds after a reply in which nothing is heard"] = 0.1) -> Fault:
    def asked(exchange: Exchange) -> bytes | None:
        sent = exchange.contact.last_sent
        return SILENCE if sent is not None and exchange.now - sent < seconds else None

    return Fault(asked=asked)


def _unit_switch() -> Fault:
    last: list[int] = []

    def asked(exchange: Exchange) -> bytes | None:
        switched = bool(last) and last[0] != exchange.unit
        last[:] = [exchange.unit]
        return SILENCE if switched else None

    return Fault(asked=asked)


LATE = FaultProfile(
    "late",
    "replies arrive after the timeout, in order, for ever",
    ("tmodbus#88", "goburrow/modbus#64"),
    "ends with an error that names the slow device and the observed delay; no wrong data; back in step alone",
    _late,
)
QUEUE_LAG = FaultProfile(
    "queue-lag",
    "replies run some requests behind",
    ("Growatt_ModbusTCP#317",),
    "never delivers them, and makes the connection anew; on a line, the same question twice cannot be told apart",
    _queue_lag,
)
MUTE_AFTER_CONNECT = FaultProfile(
    "mute-after-connect",
    "ignores everything for some seconds after a connection was made",
    ("telegraf#11919",),
    "waits for `connect_delay` before its first request",
    _mute_after_connect,
)
WEDGED = FaultProfile(
    "wedged",
    "the socket is up and Modbus is dead",
    ("saj-r5-modbus#267",),
    "makes the connection anew after `recycle_after_timeouts` timeouts in a row",
    _wedged,
)
MIN_GAP = FaultProfile(
    "min-gap",
    "ignores requests that come too soon after its last reply",
    ("modbus_exporter#83", "core#50245"),
    "keeps `request_gap`, measured from the end of the reply",
    _min_gap,
)
UNIT_SWITCH = FaultProfile(
    "unit-switch",
    "misses the first request after another unit was asked",
    ("mqmgateway#40",),
    "asks again; on a serial line it keeps a gap between units",
    _unit_switch,
)
