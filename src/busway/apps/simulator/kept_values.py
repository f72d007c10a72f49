"""The values that a simulation keeps over restarts: which are saved, and which saved ones its points take up again.

Knows points, the engine and the state file; knows no clock, because times are seconds of the simulation.

1. Saved are the values of points that were set by hand or written by Modbus: those held against a behaviour, and those
   of points without one. Of the other points, what their behaviour needs to continue, if it needs anything.
2. A saved value that fits no point any more is forgotten, with a warning. A state that cannot be read begins anew; a
   file that is no state ends the start.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress

from ...errors import ConfigError, InvalidRequest, ModbusError
from ...values.unfit_values import shown
from .engine import Engine
from .simulated import SIMULATION, SimulatedPoint
from .state_file import KeptPoint, KeptState, check_state, load_state, save_state

_log = logging.getLogger("busway.apps.simulator")


class KeptValues:
    """The values of a simulation's points over restarts.

    Args:
        path: path of the state file; None if nothing is kept.
        points: all points of the simulation by ``UNIT/NAME``.
        engine: the engine that drives them.

    Attributes:
        warnings: a sentence for each saved value that could not be restored.
    """

    def __init__(self, path: str | None, points: Mapping[str, SimulatedPoint], engine: Engine) -> None:
        self._path = path
        self._points = points
        self._engine = engine
        self.warnings: list[str] = []

    def begin(self) -> float:
        """Give all points their first values, or their saved values if there is a state file, and return the time.

        The time is 0.0 without saved values. Values, or a state file, that cannot be restored become warnings.

        Raises:
            ConfigError: the file is no state of a simulation, or is reached by a link of another user.
        """
        kept = self._load()
        if kept is None:
            self._engine.run(0.0)
            return 0.0
        behaviours = {key: each.behaviour for key, each in kept.points.items() if each.behaviour is not None}
        self._engine.begin(kept.time, behaviours)
        for key, each in kept.points.items():
            if each.value is not None:
                self._take_up(key, each, kept.time)
        self._engine.run(kept.time)
        return kept.time

    def save(self, time: float) -> None:
        """Save the values now, if there is a state file; ``time`` is that of the simulation. Failures are logged."""
        if self._path is not None:
            self._save(self._path, self._snapshot(time))

    async def save_every(self, seconds: float, time: Callable[[], float], ended: asyncio.Event) -> None:
        """Save the values every so many seconds until ``ended`` is set; does nothing without a state file.

        Failures are logged. ``time`` returns the time of the simulation.
        """
        if self._path is None:
            return
        while True:
            with suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), seconds)
            if ended.is_set():
                return
            await asyncio.to_thread(self._save, self._path, self._snapshot(time()))

    def _load(self) -> KeptState | None:
        if self._path is None:
            return None
        check_state(self._path)  # what is no state ends the start: it would never be written
        try:
            return load_state(self._path)
        except ConfigError as error:
            self._warn(f"{error}; it begins anew")
            return None

    def _take_up(self, key: str, kept: KeptPoint, time: float) -> None:
        point = self._points.get(key)
        if point is None:
            self._warn(f"there is no point {shown(key)} any more; its value is forgotten")
            return
        try:
            point.put(kept.value)
        except InvalidRequest as error:
            self._warn(f"the value that was kept is forgotten: {error}")
            return
        point.last_writer = kept.writer
        if kept.is_held:
            self._engine.hold(point, time)

    def _save(self, path: str, state: KeptState) -> None:
        try:
            save_state(path, state)
        except ModbusError as error:
            _log.warning("%s", error)

    def _snapshot(self, time: float) -> KeptState:
        points = {}
        for key, point in self._points.items():
            was_set = not self._engine.drives(point) and point.last_writer != SIMULATION
            if point.held or was_set:
                points[key] = KeptPoint(point.value, point.is_held, writer=point.last_writer)
            elif (state := self._engine.state_of(point, time)) is not None:
                points[key] = KeptPoint(behaviour=state)
        return KeptState(time, points)

    def _warn(self, sentence: str) -> None:
        self.warnings.append(sentence)
        _log.warning("%s", sentence)
