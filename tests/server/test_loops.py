"""Programs that the library starts run on uvloop where it is installed."""

import asyncio
import sys

import pytest

from busway.server import loops
from busway.server.device import Device
from busway.server.serving import serve_in_thread


async def the_loop() -> type[asyncio.AbstractEventLoop]:
    return type(asyncio.get_running_loop())


@pytest.mark.skipif(sys.platform == "win32", reason="uvloop does not exist there")
def test_uvloop_is_used_where_it_is_installed() -> None:
    assert loops.run(the_loop()).__module__.startswith("uvloop")


def test_without_uvloop_the_loop_is_that_of_asyncio(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)
    assert loops.run(the_loop()).__module__.startswith("asyncio")


def test_a_server_in_a_thread_stops_on_either_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    for hidden in (False, True):
        if hidden:
            monkeypatch.setitem(sys.modules, "uvloop", None)
        with serve_in_thread("tcp://127.0.0.1:0", units={1: Device(coils=8)}) as server:
            assert server.status().running
