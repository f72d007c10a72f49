"""Interrupts a function at its n-th point at which CPython may do so, as a signal handler that raises does.

The points are those at which signals are handled, and no others: the begin of a function, after a call, and the end of
a loop's turn. Only points in code of busway count.
"""

import contextlib
import dis
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import busway

HOUSE = f"{Path(busway.__file__).parent}/"
AFTER = {code for name, code in dis.opmap.items() if name.startswith(("CALL", "JUMP_BACKWARD", "RESUME"))}
"""Instructions after which signals are handled."""

TOOL = 4
"""The tool identifier for ``sys.monitoring``; debuggers and coverage use other ones."""


class Interrupt(KeyboardInterrupt):
    """What the signal handler raises."""


def interrupted(function: Callable[[], object], at: int) -> str:
    """Call a function and interrupt it at its n-th point; return the place, or an empty text if it ended before."""
    points = _Points(at)
    with contextlib.suppress(Interrupt), points.watched():
        function()
    return points.place


class _Points:
    """Counts the points that the present thread passes, and interrupts it at the last one."""

    def __init__(self, left: int) -> None:
        self.place = ""
        self._left = left
        self._thread = threading.get_ident()
        self._last: dict[tuple[int, CodeType], int] = {}  # by frame, where its last instruction stands

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Watch each instruction of the thread: since Python 3.12 by ``sys.monitoring``, before it by tracing."""
        if sys.version_info < (3, 12):
            before = sys.gettrace()
            sys.settrace(self._enter)
            try:
                yield
            finally:
                sys.settrace(before)
            return
        watch = sys.monitoring
        watch.use_tool_id(TOOL, "interrupting")
        watch.register_callback(TOOL, watch.events.INSTRUCTION, self._instruction)
        watch.set_events(TOOL, watch.events.INSTRUCTION)
        try:
            yield
        finally:
            watch.set_events(TOOL, 0)
            watch.free_tool_id(TOOL)

    def _enter(self, frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(HOUSE):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return self._step

    def _step(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "opcode":
            self._passed(frame, frame.f_lasti)
        return self._step

    def _instruction(self, code: CodeType, offset: int) -> Any:
        if not code.co_filename.startswith(HOUSE):
            return sys.monitoring.DISABLE  # type: ignore[attr-defined,unused-ignore]  # of Python 3.12
        if threading.get_ident() == self._thread:
            self._passed(sys._getframe(1), offset)
        return None

    def _passed(self, frame: FrameType, at: int) -> None:
        code = frame.f_code
        before = self._last.get((id(frame), code), at)
        self._last[id(frame), code] = at
        if code.co_code[before] in AFTER:
            self._left -= 1
            if not self._left:
                self.place = f"{code.co_qualname}:{frame.f_lineno}"
                raise Interrupt
