"""What a fault can do to a conversation, when it does it, and how it is switched.

Knows requests, replies and ``now``; knows no socket, no clock and no device. The same objects serve tests and the
simulator.

1. A `Fault` is up to four functions: whether a connection is admitted, what is done with a request before the device
   sees it, what becomes of its reply, and when a connection is closed for silence. It strikes only where it can be
   met: one of connections on connections, one of lines on lines.
2. An `AppliedFault` is a fault that somebody has put on: chosen by unit, function, address range, probability and
   schedule, and switched while everything runs, from any thread.
3. Whether a fault is to strike a request is decided once, before any of them acts. It counts as struck when it has made
   a difference: who refuses blocks of more than 50 has not struck a request for 2.
4. Chance comes from the seed alone: the same requests meet the same faults.
"""

import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from random import Random
from typing import Any

from ..codes import Table
from ..errors import ConfigError
from ..pdu.functions import AnyRequest
from ..pdu.message import Request, Span
from ..values.refusal import shown

SILENCE = b""
"""The answer of a fault that keeps the device from answering."""
SAME_MOMENT = 1e-6
"""Seconds. Sums of times that mean the same moment differ in their last bits."""


class Carrier(Enum):
    """Where a fault is met."""

    TCP = "tcp"
    """Frames of Modbus on TCP/IP, whose header has a transaction identifier; over TCP, TLS or UDP."""
    SERIAL = "serial"
    """Frames of serial lines, RTU and ASCII; on a line, or over a network."""
    CONNECTION = "connection"
    """A connection that can be closed: over TCP or TLS, whatever the frames are."""


EVERYWHERE = frozenset(Carrier)


@dataclass(slots=True, eq=False, weakref_slot=True)
class Contact:
    """One connection, as faults see it. Times are seconds in the clock of ``now``.

    Attributes:
        opened: when it was made.
        others: connections that stood when it came.
        last_received, last_sent: when the last request was whole, and when bytes left last; None before the first.
        carriers: what it is.
    """

    opened: float
    others: int = 0
    last_received: float | None = None
    last_sent: float | None = None
    carriers: frozenset[Carrier] = frozenset({Carrier.TCP, Carrier.CONNECTION})


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request, and where and when it came.

    Attributes:
        contact: the connection.
        transaction: identifier, 0…65535.
        unit: unit identifier, 0…255.
        pdu: the request as it came.
        request: the same, decoded.
        now: when it was whole.
        random: where the fault takes chance from.
        adu: the frame of the request.
        is_broadcast: whether it went to all units of a line, so that none may answer.
    """

    contact: Contact
    transaction: int
    unit: int
    pdu: bytes
    request: AnyRequest
    now: float
    random: Random = field(default_factory=Random)
    adu: bytes = b""
    is_broadcast: bool = False

    @property
    def function(self) -> int:
        """Function code as it came, 0…255."""
        return self.pdu[0]

    @property
    def spans(self) -> tuple[Span, ...]:
        """The ranges that the request names; none where it is malformed or unknown."""
        return self.request.spans() if isinstance(self.request, Request) else ()

    @property
    def is_write(self) -> bool:
        """Whether the request may change something."""
        return (isinstance(self.request, Request) and self.request.is_write) or any(one.writes for one in self.spans)


@dataclass(frozen=True, slots=True)
class Emission:
    """A frame on its way to the client.

    Attributes:
        transaction, unit, pdu: what it says. Without a PDU no frame is sent.
        before, after: bytes around the frame, which are in no frame.
        length: length field of the header; None for the true one. Frames of serial lines have none.
        delay: seconds from the request.
        piece: bytes per write; 0 for all at once.
        pause: seconds between pieces.
        glued: whether it leaves in one write with glued frames that are due at the same moment.
        closes: whether the connection is closed after it.
    """

    transaction: int
    unit: int
    pdu: bytes = b""
    before: bytes = b""
    after: bytes = b""
    length: int | None = None
    delay: float = 0.0
    piece: int = 0
    pause: float = 0.0
    glued: bool = False
    closes: bool = False


Admits = Callable[[Contact], bool]
Asked = Callable[[Exchange], bytes | None]
Answered = Callable[[Exchange, list[Emission]], list[Emission]]
ClosesAt = Callable[[Contact], float | None]


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """What somebody does wrong. What it does not say goes its usual way.

    Args:
        name: of the fault profile.
        admits: whether a new connection may stay.
        asked: the PDU that answers a request instead of the device, `SILENCE` for none; None lets the device answer.
        answered: the frames that leave, made from those that would.
        closes_at: when the connection is closed, in the clock of ``now``; None for never.
        carriers: where it is met.
        options: of the fault profile, that it was made with.
    """

    name: str = ""
    admits: Admits | None = None
    asked: Asked | None = None
    answered: Answered | None = None
    closes_at: ClosesAt | None = None
    carriers: frozenset[Carrier] = EVERYWHERE
    options: Mapping[str, Any] = field(default_factory=dict)  # Any: of the types that the fault profile declares

    def is_met(self, contact: Contact) -> bool:
        """Whether a connection is one where it can be met."""
        return not self.carriers.isdisjoint(contact.carriers)


@dataclass(frozen=True, slots=True)
class Schedule:
    """When a fault is on, counted from its being switched on.

    Args:
        after: seconds until it begins.
        lasts: seconds until it ends again; None for never.
        every: seconds after which it begins again; None for once.
        skip: requests, of those it is chosen for, that pass first.
        times: requests that it strikes; None for any number.
    """

    after: float = 0.0
    lasts: float | None = None
    every: float | None = None
    skip: int = 0
    times: int | None = None

    def __post_init__(self) -> None:
        for key in ("after", "lasts", "every", "skip", "times"):
            value = getattr(self, key)
            if value is not None and value < 0:
                raise ConfigError(f"must not be negative, {value:g}", key=key)
        if self.every is not None and (self.lasts is None or self.every < self.lasts):
            raise ConfigError("must be at least as long as lasts, which it needs", key="every")

    def is_time(self, elapsed: float) -> bool:
        """Whether it is on, ``elapsed`` seconds after it was switched on."""
        elapsed -= self.after
        if elapsed < 0:
            return False
        if self.every:
            elapsed %= self.every
        return self.lasts is None or elapsed < self.lasts

    def is_turn(self, chosen: int) -> bool:
        """Whether it strikes after ``chosen`` requests that it was chosen for."""
        return chosen >= self.skip and (self.times is None or chosen < self.skip + self.times)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which requests a fault is for; None stands for all.

    Args:
        units: unit identifiers, 0…255.
        functions: function codes, 1…127.
        addresses: items, 0-based, of every table; a request that touches one of them is meant.
        items: the same by table: ranges of the first item and the one behind the last.
        probability: 0…1, the part of those requests that it strikes.
        schedule: when.
    """

    units: Collection[int] | None = None
    functions: Collection[int] | None = None
    addresses: range | None = None
    probability: float = 1.0
    schedule: Schedule = Schedule()
    items: Mapping[Table, Collection[tuple[int, int]]] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise ConfigError(f"must be 0…1, not {self.probability:g}", key="probability")
        if self.addresses is not None and (self.addresses.step != 1 or not self.addresses):
            raise ConfigError(f"must be a range with items and without a step, not {self.addresses}", key="addresses")
        _refuse_numbers_outside("units", self.units, 0, 255)
        _refuse_numbers_outside("functions", self.functions, 1, 127)

    def means(self, exchange: Exchange) -> bool:
        """Whether a request is one of those, leaving chance and time aside."""
        if self.units is not None and exchange.unit not in self.units:
            return False
        if self.functions is not None and exchange.function not in self.functions:
            return False
        wanted, items = self.addresses, self.items
        if wanted is not None and not any(_touches(span, wanted.start, wanted.stop) for span in exchange.spans):
            return False
        return items is None or any(
            _touches(span, first, end) for span in exchange.spans for first, end in items.get(span.table, ())
        )


def _refuse_numbers_outside(key: str, numbers: object, low: int, high: int) -> None:
    if numbers is None:
        return
    if not isinstance(numbers, Collection) or not all(isinstance(one, int) and low <= one <= high for one in numbers):
        raise ConfigError(f"must be several of {low}…{high}, such as {{{low + 1}}}, not {numbers!r}", key=key)


def _touches(span: Span, first: int, end: int) -> bool:
    return span.address < end and first < span.address + span.count


class AppliedFault:
    """A fault that was put on: its choice, its switch and its count.

    Attributes:
        label: what it is called among the others.
        fault: what it does.
        selection: which requests it is for.
        enabled: the switch, as it stands.
        struck: requests that went otherwise because of it, connections that it has refused or closed.
    """

    __slots__ = ("_changed", "_chosen", "_random", "_since", "enabled", "fault", "label", "selection", "struck")

    def __init__(
        self,
        label: str,
        fault: Fault,
        selection: Selection,
        random: Random,
        changed: Callable[[], None],
        *,
        enabled: bool,
    ) -> None:
        self.label = label
        self.fault = fault
        self.selection = selection
        self.enabled = enabled
        self.struck = 0
        self._changed = changed
        self._chosen = 0
        self._since: float | None = None
        self._random = random

    @property
    def name(self) -> str:
        """The fault profile."""
        return self.fault.name

    def on(self) -> None:
        """Switch it on; its schedule begins anew."""
        self._since = None
        self._chosen = 0
        self.enabled = True
        self._changed()

    def off(self) -> None:
        """Switch it off. What it holds back or has delayed already stays so."""
        self.enabled = False
        self._changed()

    def is_on(self, now: float) -> bool:
        """Whether the switch and the schedule let it act now."""
        if not self.enabled:
            return False
        if self._since is None:
            self._since = now
        return self.selection.schedule.is_time(now - self._since)

    def strikes(self, exchange: Exchange) -> Exchange | None:
        """The exchange as this fault is to see it, if it is to strike."""
        if not self.is_on(exchange.now) or not self.fault.is_met(exchange.contact):
            return None
        if not self.selection.means(exchange):
            return None
        self._chosen += 1
        if not self.selection.schedule.is_turn(self._chosen - 1):
            return None
        if self.selection.probability < 1 and self._random.random() >= self.selection.probability:
            return None
        return replace(exchange, random=self._random)


class Faults:
    """All faults of one server, in the order in which they act. Changed from any thread.

    Args:
        seed: what chance is made from.

    Attributes:
        generation: changes whenever a fault is put on, taken off or switched.
        is_any_on: whether one is switched on; if not, nobody needs to ask anything else.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._made = 0
        self._applied: tuple[AppliedFault, ...] = ()
        self._lock = threading.Lock()
        self._watchers: tuple[Callable[[], None], ...] = ()
        self.generation = 0
        self.is_any_on = False

    def __iter__(self) -> Iterator[AppliedFault]:
        return iter(self._applied)

    def add(
        self, fault: Fault, selection: Selection | None = None, *, enabled: bool = True, label: str = ""
    ) -> AppliedFault:
        """Put a fault on, behind the others.

        Args:
            fault: what happens.
            selection: to which requests; None for all.
            enabled: whether it is switched on.
            label: what it is called; by default its fault profile's name, with a number where that is taken.

        Raises:
            ConfigError: there is one of this label.
        """
        with self._lock:
            taken = {one.label for one in self._applied}
            if label in taken:
                raise ConfigError(f"there is a fault {shown(label)} already", key="name")
            self._made += 1
            random = Random(f"{self._seed}/{self._made}/{fault.name}")
            applied = AppliedFault(
                label or _unused(fault.name or "fault", taken),
                fault,
                selection or Selection(),
                random,
                self._changed,
                enabled=enabled,
            )
            self._applied = (*self._applied, applied)
        self._changed()
        return applied

    def remove(self, applied: AppliedFault) -> None:
        """Take a fault off. One that is not there is nothing to complain of."""
        with self._lock:
            self._applied = tuple(one for one in self._applied if one is not applied)
        self._changed()

    def watch(self, changed: Callable[[], None]) -> None:
        """Have ``changed`` called, in whatever thread, after a fault was put on, taken off or switched."""
        with self._lock:
            self._watchers = (*self._watchers, changed)

    def unwatch(self, changed: Callable[[], None]) -> None:
        """Call it no more."""
        with self._lock:
            self._watchers = tuple(one for one in self._watchers if one != changed)

    def _changed(self) -> None:
        with self._lock:
            self.generation += 1
            self.is_any_on = any(one.enabled for one in self._applied)
        for changed in self._watchers:
            changed()

    @contextmanager
    def during(self, fault: Fault, selection: Selection | None = None) -> Iterator[AppliedFault]:
        """A fault that is on while the block runs: ``with server.faults.during(BUSY()): …``."""
        applied = self.add(fault, selection)
        try:
            yield applied
        finally:
            self.remove(applied)

    def find(self, label: str) -> AppliedFault:
        """The fault of a label. Raises `ConfigError` that lists those there are."""
        for one in self._applied:
            if one.label == label:
                return one
        there_are = ", ".join(one.label for one in self._applied) or "none"
        raise ConfigError(f"there is no fault {shown(label)}; there are: {there_are}", key="name")

    # What a conversation asks.

    def admit(self, contact: Contact) -> bool:
        """Whether a new connection may stay."""
        for one in self._applied:
            if one.fault.admits is None or not one.fault.is_met(contact) or not one.is_on(contact.opened):
                continue
            if not one.fault.admits(contact):
                one.struck += 1
                return False
        return True

    def strike(self, exchange: Exchange) -> list[tuple[AppliedFault, Exchange]]:
        """The faults that are to strike a request, each with what it is to see."""
        found = []
        for one in self._applied:
            seen = one.strikes(exchange)
            if seen is not None:
                found.append((one, seen))
        return found

    def closes_at(self, contact: Contact, now: float) -> float | None:
        """When a connection is to be closed for silence."""
        return min((when for when, _ in self._closing(contact, now)), default=None)

    def closes(self, contact: Contact, now: float) -> bool:
        """Whether a connection is to be closed for silence by now; that counts as struck."""
        due = [one for when, one in self._closing(contact, now) if when <= now + SAME_MOMENT]
        for one in due[:1]:
            one.struck += 1
        return bool(due)

    def _closing(self, contact: Contact, now: float) -> Iterator[tuple[float, AppliedFault]]:
        for one in self._applied:
            if one.fault.closes_at is None or not one.fault.is_met(contact) or not one.is_on(now):
                continue
            when = one.fault.closes_at(contact)
            if when is not None:
                yield when, one


def _unused(name: str, taken: Collection[str]) -> str:
    number, found = 1, name
    while found in taken:
        number += 1
        found = f"{name}-{number}"
    return found
