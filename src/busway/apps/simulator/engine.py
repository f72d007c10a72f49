"""The engine of a simulation: which points change at each moment, in which order, and to which values.

Knows points, behaviours and the memory of devices; knows no clock: times are arguments, in seconds of the simulation.

1. A point changes at whole multiples of its ``every``: the number of the step times ``every``, so delays do not add up.
2. At one moment a formula is computed after the points that it needs, also points of other units. Behaviours that
   observe other points over time (`Observer`) read them after that.
3. The points of a unit that change at one moment become visible to clients together.
4. A point that was set by hand keeps its value until it is released.
5. After each unit the engine asks its caller whether to stop for now, so that requests can be answered meanwhile.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

from ...server.device import Device
from ...server.memory_runs import BitRun, RegisterRun, replace_all
from .behaviours.behaviour import Behaviour, Observer
from .simulated import SIMULATION, SimulatedPoint

_LAST: Final = 1 << 30
"""The rank of observers, which are called after all points have their values of a moment."""


@dataclass(slots=True, eq=False)
class Driven:
    """A simulated point together with its behaviour, as the engine runs it.

    Attributes:
        point: the point.
        behaviour: the behaviour that the point follows.
        every: seconds between two changes.
        rank: largest number of changes of unit along a chain of formulas that ends with this point's formula; 0 if
            there is none. Lower ranks are computed first.
        order: position among all points with behaviours; after the points that this point's formula needs.
    """

    point: SimulatedPoint
    behaviour: Behaviour
    every: float
    rank: int
    order: int


@dataclass(slots=True, eq=False)
class _Group:
    """Points of one unit that are handled at the same moments: to get new values, or to observe other points.

    Attributes:
        device: the device that has the points.
        every: seconds between two moments.
        driven: the points of the group.
        step: number of the next moment, which comes at ``step`` × ``every`` seconds of the simulation.
    """

    device: Device
    every: float
    driven: list[Driven]
    step: int = 0

    def due(self) -> float:
        return self.step * self.every


@dataclass(slots=True, eq=False)
class _Release:
    """An entry of the engine's schedule: a point that was set by hand follows its behaviour again.

    Attributes:
        point: the point.
        held: value of ``point.held`` at the setting by hand that ends; if the point was set again since then, this
            entry has no effect.
    """

    point: SimulatedPoint
    held: int


class _Batch:
    """The points of one unit that change at the same moment, prepared so that new values are written fast.

    Args:
        groups: the groups of points, all of one unit.
    """

    __slots__ = ("device", "entries", "memories")

    def __init__(self, groups: Iterable[_Group]) -> None:
        groups = list(groups)
        self.device = groups[0].device
        self.memories: dict[RegisterRun | BitRun, list[SimulatedPoint]] = {}
        driven = sorted((each for group in groups for each in group.driven), key=lambda each: each.order)
        self.entries = [
            (
                each.point,
                each.behaviour.value,
                each.point.form.quantise,
                *each.point.form.factors,
                self.memories.setdefault(each.point.memory, []).append,
            )
            for each in driven
        ]

    def run(self, time: float) -> list[SimulatedPoint]:
        """Give the points the values of their behaviours at a time, and return the points whose value has changed.

        Points that were set by hand keep their values; so do points of other types than floats if the behaviour returns
        NaN.
        """
        changed: list[SimulatedPoint] = []
        changes = changed.append
        with self.device.lock:
            for point, value, quantise, scale, offset, fresh in self.entries:
                if point.held:
                    continue
                stored = quantise(value(time))
                if stored is None or stored == point.stored:
                    continue
                point.stored = stored
                point.number = stored * scale + offset
                point.changed_at = time
                point.last_writer = SIMULATION
                fresh(point)
                changes(point)
            if changed:
                self._store()
        return changed

    def _store(self) -> None:
        """Write the new values into the memory of the unit, so that clients see all of them at once or none."""
        shown: dict[RegisterRun | BitRun, bytearray] = {}
        for memory, points in self.memories.items():
            if points:
                data = shown[memory] = bytearray(memory.data)
                for point in points:
                    point.form.put(data, point.offset, point.stored)
                points.clear()
        replace_all(shown)


class Engine:
    """Gives all simulated points with behaviours new values, each at its own moments.

    All times are seconds of the simulation since its beginning. A point counts as set by hand if the program, a person
    or a Modbus client has set it.

    Args:
        driven: the points with their behaviours.
        changed: called with the points of a unit that have got a new value at a moment, and the time of the moment.

    Attributes:
        changes: number of new values that points have got so far.
        left_out: number of moments left out so far because the program could not keep up; each group of points of one
            unit with the same ``every`` and ``rank`` counts for itself.
    """

    def __init__(self, driven: Iterable[Driven], changed: Callable[[list[SimulatedPoint], float], None]) -> None:
        self.changes: int = 0
        self.left_out: int = 0
        self._changed = changed
        self._driven = {each.point: each for each in driven}
        self._heap: list[tuple[float, int, int, int, _Group | _Release]] = []
        # Counted in one step each, so that points can be held and released from any thread.
        self._sequence = itertools.count()
        self._holds = itertools.count(1)
        self._batches: dict[tuple[_Group, ...], _Batch] = {}
        units: dict[int, int] = {}
        for group, rank in _groups(self._driven.values()):
            self._push(group.due(), rank, units.setdefault(id(group.device), len(units)), group)

    def deadline(self) -> float | None:
        """Return when `run` is to be called next, in seconds of the simulation; None if no point has a behaviour.

        This is when the next points change or a setting by hand ends.
        """
        return self._heap[0][0] if self._heap else None

    def drives(self, point: SimulatedPoint) -> bool:
        """Whether a simulated point has a behaviour that changes it over time."""
        return point in self._driven

    def state_of(self, point: SimulatedPoint, time: float) -> float | None:
        """Return the value from which a point's behaviour would continue after a restart.

        None if the point has no behaviour, or one that keeps no state: all but counters, lags and random walks.

        Args:
            point: the point.
            time: seconds of the simulation.
        """
        driven = self._driven.get(point)
        if driven is None:
            return None
        return driven.behaviour.state(math.floor(time / driven.every + _ROUNDING) * driven.every)

    def run(self, until: float, *, skip: bool = False, pause: Callable[[], bool] = lambda: False) -> bool:
        """Give the points their new values at all moments up to a time, that time included.

        Args:
            until: the time, in seconds of the simulation.
            skip: whether points that have missed several moments get the value of the last of these only: for a program
                that was stopped for a while, or cannot keep up.
            pause: called after each unit; returns True to leave the rest for a later call.

        Returns:
            True if all moments up to ``until`` are done; False if ``pause`` has left some.
        """
        if skip:
            self._leave_out(until)
        while self._heap and self._heap[0][0] <= until:
            due, rank, unit, _, task = heapq.heappop(self._heap)
            if isinstance(task, _Release):
                self._released(task, due)
                continue
            groups = [task]
            while self._heap and self._heap[0][:3] == (due, rank, unit):
                other = heapq.heappop(self._heap)[4]
                assert isinstance(other, _Group)  # releases have a rank of their own
                groups.append(other)
            self._run(groups, rank, due)
            for group in groups:
                group.step += 1
                self._push(group.due(), rank, unit, group)
            if pause():
                break
        return not self._heap or self._heap[0][0] > until

    def _leave_out(self, until: float) -> None:
        """Skip the moments before ``until`` that were missed, and count them.

        Each group of points goes on with its last moment that is not after ``until``. Does nothing if the next entry of
        the schedule is a release, or a group that has missed no moment.
        """
        first = self._heap[0][4] if self._heap else None
        if not isinstance(first, _Group) or (first.step + 1) * first.every > until:
            return
        old, self._heap = self._heap, []
        for due, rank, unit, _, task in old:
            if isinstance(task, _Group):
                last = max(task.step, math.floor(until / task.every + _ROUNDING))
                self.left_out += last - task.step if rank != _LAST else 0
                task.step = last
                due = task.due()
            self._push(due, rank, unit, task)

    def _run(self, groups: list[_Group], rank: int, time: float) -> None:
        """Give points of one unit their new values at a moment, or let their behaviours observe other points.

        Args:
            groups: the groups of points, all of one unit and of this rank.
            rank: the rank; `_LAST` for observers.
            time: seconds of the simulation.
        """
        if rank == _LAST:
            for group in groups:
                for driven in group.driven:
                    assert is_observer(driven.behaviour)
                    driven.behaviour.observe(time)
            return
        key = tuple(groups)
        batch = self._batches.get(key)
        if batch is None:
            batch = self._batches[key] = _Batch(groups)
        changed = batch.run(time)
        if changed:
            self.changes += len(changed)
            self._changed(changed, time)

    def hold(self, point: SimulatedPoint, time: float) -> None:
        """Keep a point at a value set by hand, until `release` or for its behaviour's ``resume_after`` seconds.

        With ``resume_after`` 0 the point is not kept; with None only `release` ends it. A behaviour that depends on its
        last value continues from this one. Does nothing for a point without a behaviour. May be called in any thread.

        Args:
            point: the point, which has the new value already.
            time: seconds of the simulation.
        """
        driven = self._driven.get(point)
        if driven is None:
            return
        section = point.section.behaviour
        assert section is not None  # it is driven by it
        _go_on(driven.behaviour, point, time)
        if section.resume_after == 0:
            return
        point.held = next(self._holds)
        if section.resume_after is not None:
            self._push(time + section.resume_after, -1, 0, _Release(point, point.held))

    def release(self, point: SimulatedPoint, time: float) -> None:
        """Let a point that was set by hand follow its behaviour again, from its next moment on.

        A behaviour that depends on its last value continues from the present value of the point. Does nothing for a
        point that was not set by hand or has no behaviour. May be called in any thread.

        Args:
            point: the point.
            time: seconds of the simulation.
        """
        driven = self._driven.get(point)
        if driven is not None and point.held:
            _go_on(driven.behaviour, point, time)
            point.held = 0

    def begin(self, time: float, kept: Mapping[str, float]) -> None:
        """Set the engine to a time other than 0, to continue a saved simulation. Call this before the first `run`.

        The next `run` gives each point the value of its last moment up to that time.

        Args:
            time: seconds of the simulation.
            kept: the saved states of behaviours, each by the key of its point, ``UNIT/NAME``.
        """
        self._heap, old = [], self._heap
        for _, rank, unit, _, task in old:
            if isinstance(task, _Group):
                task.step = math.floor(time / task.every + _ROUNDING)
                self._push(task.due(), rank, unit, task)
        for point, driven in self._driven.items():
            if point.key in kept:
                step = math.floor(time / driven.every + _ROUNDING)
                driven.behaviour.resume(step * driven.every, kept[point.key])

    def _released(self, release: _Release, time: float) -> None:
        if release.point.held == release.held:
            self.release(release.point, time)

    def _push(self, due: float, rank: int, unit: int, task: "_Group | _Release") -> None:
        heapq.heappush(self._heap, (due, rank, unit, next(self._sequence), task))


_ROUNDING: Final = 1e-9
"""Added to a quotient of two times before it is rounded down, as its error is smaller."""


def _go_on(behaviour: Behaviour, point: SimulatedPoint, time: float) -> None:
    """Let a behaviour continue from the current value of its point, if that value is a finite number."""
    if math.isfinite(point.number):
        behaviour.resume(time, point.number)


def is_observer(behaviour: Any) -> TypeGuard[Observer]:  # of any class
    """Whether a behaviour reads and remembers values of other points after each moment (`Observer`)."""
    return hasattr(behaviour, "observe")


def _groups(driven: Iterable[Driven]) -> list[tuple[_Group, int]]:
    """Return the points in groups, each with its rank; the points of a group have the same unit, ``every`` and rank.

    Points whose behaviours observe others are also in a group with the rank `_LAST`.
    """
    found: dict[tuple[int, float, int], _Group] = {}
    for each in driven:
        device = each.point.device
        found.setdefault((id(device), each.every, each.rank), _Group(device, each.every, [])).driven.append(each)
        if is_observer(each.behaviour):
            found.setdefault((id(device), each.every, _LAST), _Group(device, each.every, [])).driven.append(each)
    return [(group, rank) for (_, _, rank), group in found.items()]
