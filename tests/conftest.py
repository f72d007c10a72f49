"""What every test may rely on.

1. A test function that is a coroutine runs in an event loop of its own, made for it and closed after it.
   Its fixtures are ordinary ones; whatever must live inside the loop is opened in the test with ``async with``.
2. It has `LIMIT` seconds; a test that hangs fails where it hangs, instead of stopping the run.
3. It must leave no task behind: a task that outlives its test is a leak of the code under test.
4. Any other test has the seconds of ``timeout`` in pyproject.toml, and a hang shows the stack of each thread.
5. A test that depends on the clock or the load of the machine is marked ``real_time``, by itself or by its folder:
   three others run beside it, in other processes. One that measures delays is marked ``alone``. No test is repeated.
6. No example of a property has a time limit: what a machine that pauses takes longer is not wrong.
7. The examples of a property are the same in each run, so that a change is judged by what it changes. With
   BUSWAY_NEW_EXAMPLES in the environment they are drawn anew: `make explore` looks for what no run has seen yet.
   On the second and third Python a property gets a tenth of its examples (`support.examples`).
8. The clock of the machine is trusted, here and in the programs that tests start: samples of a machine that was just
   started would be uncertain.
"""

import asyncio
import inspect
import os
import signal
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# A shell that starts the tests in the background makes them, and the programs that they start, deaf to interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


os.environ["BUSWAY_CLOCK"] = "trusted"

LIMIT = 100.0
"""Seconds for one coroutine test: far above what any needs, so that only a hang reaches it."""

TURNS_TO_END = 3
"""Turns of the loop that a cancelled or finishing task gets: its last step, its callbacks, and one to spare."""

TESTS = Path(__file__).parent
REAL_TIME_FOLDERS = tuple(f"{TESTS / name}{os.sep}" for name in ("browser", "interop/serial", "network"))
"""Where every test is about time, load or the system."""
ALONE_FOLDERS = (f"{TESTS / 'load'}{os.sep}",)
"""Where every test loads the machine itself."""

settings.register_profile(
    "of the tests",
    deadline=None,
    max_examples=10 if "BUSWAY_FEW_EXAMPLES" in os.environ else 100,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="BUSWAY_NEW_EXAMPLES" not in os.environ,
)
settings.load_profile("of the tests")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the folders in real time, and let soak tests take minutes."""
    for item in items:
        path = str(item.path)
        if path.startswith(ALONE_FOLDERS):
            item.add_marker(pytest.mark.alone)
        if path.startswith(REAL_TIME_FOLDERS) or item.get_closest_marker("alone"):
            item.add_marker(pytest.mark.real_time)
        if item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.timeout(0))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test; leave every other test to pytest."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    arguments = {name: pyfuncitem.funcargs[name] for name in names}
    with asyncio.Runner(debug=False) as runner:
        runner.run(_within_limit(pyfuncitem.obj(**arguments)))
    return True


async def _within_limit(test: Awaitable[Any]) -> None:
    async with asyncio.timeout(LIMIT):
        await test
    for _ in range(TURNS_TO_END):
        await asyncio.sleep(0)
    left = asyncio.all_tasks() - {asyncio.current_task()}
    assert not left, f"the test left tasks behind: {left}"
