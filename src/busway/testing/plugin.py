"""The pytest plugin of busway: simulated devices, serial lines and a clock as fixtures.

Knows pytest and the names of its fixtures; imports the rest when a test uses a fixture, so that test runs without
Modbus take no longer.

================  ======================================================================================
fixture           gives
================  ======================================================================================
``simulator``     a function that serves a device until the test ends: ``simulator({"4x1": 42})``
``paced_line``    a function that creates a serial line of pseudo-terminals: ``paced_line(ports=2)``
``busway_clock``  a clock that the test moves by hand, for ``simulator(…, clock=busway_clock)``
================  ======================================================================================
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from ..faults.clock import Clock, FakeClock
    from .line import PacedLine
    from .simulated import Content, SimulatedDevice


class Simulator(Protocol):
    """Type of the function that the pytest fixture ``simulator`` returns."""

    def __call__(
        self,
        content: "Content",
        *,
        unit: int | None = None,
        url: str = "tcp://127.0.0.1:0",
        seed: int | None = None,
        speed: float = 1.0,
        clock: "Clock | None" = None,
    ) -> "SimulatedDevice":
        """Serve a simulated device until the test ends.

        The arguments are those of `busway.testing.simulated_device`.
        """


class MakePacedLine(Protocol):
    """Type of the function that the pytest fixture ``paced_line`` returns."""

    def __call__(self, ports: int = 2, baud: int = 9600, parity: str = "even", **options: Any) -> "PacedLine":
        """Create a serial line that exists until the test ends; the arguments are those of `PacedLine`."""


@pytest.fixture
def simulator() -> Iterator[Simulator]:
    """Fixture: a function that serves a device in a thread until the test ends: ``simulator({"4x1": 42})``.

    Its result is a `SimulatedDevice`: it has ``endpoint``, ``host`` and ``port``; values by address or name,
    ``device["4x1"]``; the context manager ``fault(…)``; and ``reads`` and ``writes`` of clients.
    """
    from contextlib import ExitStack

    with ExitStack() as stack:

        def serve(content: "Content", **options: Any) -> "SimulatedDevice":  # Any: as `Simulator` says
            from .simulated import simulated_device

            return stack.enter_context(simulated_device(content, **options))

        yield serve


@pytest.fixture
def paced_line() -> Iterator[MakePacedLine]:
    """Fixture: a function that creates a real-time serial line until the test ends: ``paced_line(ports=2)``.

    Its ``paths`` are the ports, pseudo-terminals: one for the program under test, one for
    ``simulator(…, url=f"rtu://{path}")``.
    """
    from contextlib import ExitStack

    with ExitStack() as stack:

        def make(ports: int = 2, baud: int = 9600, parity: str = "even", **options: Any) -> "PacedLine":
            from .line import PacedLine

            return stack.enter_context(PacedLine(ports, baud, parity, **options))

        yield make


@pytest.fixture
def busway_clock() -> "FakeClock":
    """Fixture: a clock that stands still until the test moves it: ``busway_clock.advance(60.0)``."""
    from ..faults.clock import FakeClock

    return FakeClock()
