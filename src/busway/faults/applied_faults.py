"""Faults that were added to a server: which requests they apply to, when they are active, how often they applied.

Knows faults, requests and ``now``, the time in seconds of the driver's clock; knows no socket, no clock and no device.
Tests and the simulator use these objects.

1. An `AppliedFault` is a fault added to a server: it applies to requests selected by unit, function, address range,
   probability and schedule, and can be switched at any time from any thread.
2. Which faults apply to a request is decided once, before any of them acts. A fault counts a request as struck only if
   it has changed the answer: the fault "at most 50 registers" does not count a request for 2.
3. Random choices depend only on the seed, on the order in which faults were added, and on the requests before: the same
   sequence of requests meets the same faults.
"""

import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from random import Random

from ..codes import Table
from ..errors import ConfigError
from ..pdu.message import Span
from ..values.unfit_values import shown
from .fault import Contact, Exchange, Fault

SAME_MOMENT = 1e-6
"""Times that differ by at most so many seconds count as equal: sums of floats differ in their last bits."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """When a fault is active: by seconds and numbers of requests since it was switched on.

    Args:
        after: seconds until it becomes active.
        lasts: seconds for which it is active; None for ever.
        every: seconds from one activation to the next, at least ``lasts``; None or 0 for one activation.
        skip: number of selected requests that are answered normally first. Requests outside the active time are not
            counted.
        times: number of selected requests after these to which it can apply, those included that the probability of
            the selection spares; None for any number.

    Raises:
        ConfigError: a negative value, or ``every`` without ``lasts`` or below it.
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
        """Whether a fault with this schedule is active ``elapsed`` seconds after it was switched on.

        The numbers of requests, ``skip`` and ``times``, are not looked at: `is_turn` does that.
        """
        elapsed -= self.after
        if elapsed < 0:
            return False
        if self.every:
            elapsed %= self.every
        return self.lasts is None or elapsed < self.lasts

    @property
    def is_timed(self) -> bool:
        """Whether time alone starts or ends the fault: ``after`` is above 0, or ``lasts`` is given."""
        return self.after > 0 or self.lasts is not None

    def next_change(self, elapsed: float) -> float | None:
        """Return when the fault becomes active or inactive next; None if it never changes again by time.

        ``elapsed``, the time now, and the result are seconds since the fault was switched on.
        """
        if elapsed < self.after:
            return self.after
        if self.lasts is None:
            return None
        if not self.every:
            end = self.after + self.lasts
            return end if elapsed < end else None
        begun = self.after + (elapsed - self.after) // self.every * self.every
        return begun + self.lasts if elapsed < begun + self.lasts else begun + self.every

    def is_turn(self, chosen: int) -> bool:
        """Return True if ``skip`` and ``times`` let a fault apply to a selected request, else False.

        ``chosen`` is the number of earlier requests that were selected since the fault was switched on.
        """
        return chosen >= self.skip and (self.times is None or chosen < self.skip + self.times)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which requests a fault applies to. A request must fit all arguments that are given; None fits every request.

    Args:
        units: unit identifiers, 0…255.
        functions: function codes, 1…127.
        addresses: range of items, 0-based, in every table; a request that reads or writes one of them fits.
        probability: share of the selected requests that the fault applies to, 0…1; chosen at random.
        schedule: when the fault is active.
        items: items by table, as pairs: the first item, 0-based, and the item after the last. A request that reads or
            writes one of them fits.

    Raises:
        ConfigError: a value is out of its range, or ``addresses`` is empty or has a step.
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
        """Whether a request fits by unit, function and items; ``probability`` and ``schedule`` are not checked."""
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
    """A fault that was added to a server: the requests it applies to, whether it is on, and how often it applied.

    `Faults.add` creates it.

    Attributes:
        label: its name, unique in the server.
        fault: how it changes the device's behaviour.
        selection: which requests it applies to.
        enabled: whether it is switched on; set by `on` and `off`. Its schedule can keep it inactive nevertheless.
        struck: number of requests it has changed and of connections it has refused or closed.
    """

    __slots__ = (
        "_changed",
        "_chosen",
        "_counted",
        "_random",
        "_since",
        "enabled",
        "fault",
        "label",
        "selection",
        "struck",
    )

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
        self.label: str = label
        self.fault: Fault = fault
        self.selection: Selection = selection
        self.enabled: bool = enabled
        self.struck: int = 0
        self._changed = changed
        self._chosen = 0
        self._counted: Exchange | None = None
        self._since: float | None = None
        self._random = random

    @property
    def name(self) -> str:
        """Name of the fault profile that the fault was created from; empty for a fault without a profile."""
        return self.fault.name

    def on(self) -> None:
        """Switch the fault on; its schedule starts again, also if it was on already."""
        self._since = None
        self._chosen = 0
        self.enabled = True
        self._changed()

    def off(self) -> None:
        """Switch the fault off. Replies that it has suppressed stay suppressed, delayed ones stay delayed."""
        self.enabled = False
        self._changed()

    def is_on(self, now: float) -> bool:
        """Whether the fault is switched on and its schedule is active at ``now`` (seconds).

        The schedule's numbers of requests, ``skip`` and ``times``, are not looked at.
        The schedule of a fault that was just switched on starts at the first call.
        """
        if not self.enabled:
            return False
        if self._since is None:
            self._since = now
        return self.selection.schedule.is_time(now - self._since)

    def next_change(self, now: float) -> float | None:
        """Return the time at which the schedule makes the fault active or inactive next, in seconds of ``now``.

        None if the fault is switched off, or its schedule changes nothing any more. The schedule of a fault that was
        just switched on starts at the first call of this method or of `is_on`.
        """
        if not self.enabled:
            return None
        if self._since is None:
            self._since = now
        change = self.selection.schedule.next_change(now - self._since)
        return None if change is None else self._since + change

    def strikes(self, exchange: Exchange) -> Exchange | None:
        """Decide whether the fault applies to a request; call it once for each request, because it counts them.

        Each selected request counts for ``skip`` and ``times`` of the schedule, also if ``skip``, ``times`` or
        ``probability`` then spare it.

        Returns:
            A copy of the request with the fault's own random number generator; None if the fault does not apply.
        """
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

    def count(self, seen: Exchange) -> None:
        """Add 1 to ``struck`` for a request, once even if several functions of the fault have changed its answer.

        Args:
            seen: the request, as `strikes` returned it.
        """
        if self._counted is not seen:
            self._counted = seen
            self.struck += 1


class Faults:
    """All faults of one server, in the order in which they act. All methods may be called from any thread.

    Args:
        seed: seed of random choices; with an equal seed, and equal faults added in the same order, an equal sequence of
            requests meets the same faults.

    Attributes:
        generation: a number that grows whenever a fault is added, removed or switched.
        is_any_on: whether any fault is switched on, whatever its schedule.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._made = 0
        self._applied: tuple[AppliedFault, ...] = ()
        self._lock = threading.Lock()
        self._watchers: tuple[Callable[[], None], ...] = ()
        self.generation: int = 0
        self.is_any_on: bool = False

    def __iter__(self) -> Iterator[AppliedFault]:
        return iter(self._applied)

    def add(
        self, fault: Fault, selection: Selection | None = None, *, enabled: bool = True, label: str = ""
    ) -> AppliedFault:
        """Add a fault to the server, after the existing ones; returns the added fault, which can be switched.

        Args:
            fault: the fault.
            selection: the requests it applies to; None for all.
            enabled: whether it is switched on.
            label: its name; empty for that of its fault profile, with a number if that is taken: ``late-2``.

        Raises:
            ConfigError: the label is taken.
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
        """Remove a fault from the server; nothing happens to the others, also if it was removed before."""
        with self._lock:
            self._applied = tuple(one for one in self._applied if one is not applied)
        self._changed()

    def watch(self, changed: Callable[[], None]) -> None:
        """Register a function that is called after each change: a fault was added, removed or switched.

        The call is made in the thread that made the change.
        """
        with self._lock:
            self._watchers = (*self._watchers, changed)

    def unwatch(self, changed: Callable[[], None]) -> None:
        """Unregister a function that was registered with `watch`."""
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
        """Add a fault for the duration of a ``with`` block: ``with server.faults.during(BUSY()): …``.

        Yields the added fault.
        """
        applied = self.add(fault, selection)
        try:
            yield applied
        finally:
            self.remove(applied)

    def find(self, label: str) -> AppliedFault:
        """Return the fault with this label. Raises `ConfigError`, which lists the known labels, if there is none."""
        for one in self._applied:
            if one.label == label:
                return one
        there_are = ", ".join(one.label for one in self._applied) or "none"
        raise ConfigError(f"there is no fault {shown(label)}; there are: {there_are}", key="name")

    # What a conversation asks.

    def admit(self, contact: Contact) -> bool:
        """Return whether a new connection may stay open; False if a fault refuses it.

        ``struck`` of the first such fault then grows by 1. Of a fault's selection only the active time of its schedule
        counts here.
        """
        for one in self._applied:
            if one.fault.admits is None or not one.fault.is_met(contact) or not one.is_on(contact.opened):
                continue
            if not one.fault.admits(contact):
                one.struck += 1
                return False
        return True

    def strike(self, exchange: Exchange) -> list[tuple[AppliedFault, Exchange]]:
        """Return the faults that apply to a request, in the order in which they act; call it once for each request.

        Each fault comes with a copy of the request that holds the fault's own random number generator.
        """
        found = []
        for one in self._applied:
            seen = one.strikes(exchange)
            if seen is not None:
                found.append((one, seen))
        return found

    def closes_at(self, contact: Contact, now: float) -> float | None:
        """Return the earliest time, in seconds, at which a fault can close an idle connection; None for never.

        Faults that are on at ``now`` count, with a time that can be before ``now``; and those that their schedule makes
        active later, with the time at which they become active.
        """
        begins = (one.next_change(now) for one in self._that_close(contact) if not one.is_on(now))
        times = [*(when for when, _ in self._closing(contact, now)), *(each for each in begins if each is not None)]
        return min(times, default=None)

    def closes(self, contact: Contact, now: float) -> bool:
        """Return whether a fault closes an idle connection at ``now``; ``struck`` of the first one then grows by 1."""
        due = [one for when, one in self._closing(contact, now) if when <= now + SAME_MOMENT]
        for one in due[:1]:
            one.struck += 1
        return bool(due)

    def _closing(self, contact: Contact, now: float) -> Iterator[tuple[float, AppliedFault]]:
        for one in self._that_close(contact):
            when = one.fault.closes_at(contact) if one.fault.closes_at is not None and one.is_on(now) else None
            if when is not None:
                yield when, one

    def _that_close(self, contact: Contact) -> Iterator[AppliedFault]:
        for one in self._applied:
            if one.fault.closes_at is not None and one.fault.is_met(contact):
                yield one


def _unused(name: str, taken: Collection[str]) -> str:
    number, found = 1, name
    while found in taken:
        number += 1
        found = f"{name}-{number}"
    return found
