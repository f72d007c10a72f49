"""A busway client on a host of the network tests, told by lines of JSON.

Use: python client.py blocking|asyncio ENDPOINT OPTIONS, with OPTIONS as JSON. Questions: ``connect``, ``read`` (an
``address``, and options of the call), ``write`` (the same), ``state``. Outcomes: ``value`` or ``error`` (the class,
with its cause, if it has one), ``seconds``, ``state``.
"""

import asyncio
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import busway


def call(link: Any, asked: dict[str, Any]) -> Any:
    """The call that a question stands for, of either client."""
    options = {name: value for name, value in asked.items() if name not in ("do", "address")}
    if asked["do"] == "connect":
        return link.connect()
    if asked["do"] == "read":
        return link.unit(1).read_holding_registers(asked["address"], count=1, **options)
    return link.unit(1).write_single_register(asked["address"], 7, **options)


def outcome(began: float, link: Any, result: Any) -> dict[str, Any]:
    """What came of it."""
    told = {"seconds": time.monotonic() - began, "state": link.state}
    if isinstance(result, busway.ModbusError):
        cause = result.__cause__
        return {**told, "error": type(result).__name__, "cause": type(cause).__name__, "message": str(result)}
    return {**told, "value": result}


def run_blocking(endpoint: str, options: dict[str, Any]) -> None:
    """Ask with the blocking client, in this thread."""
    with busway.connect(endpoint, **options) as link:
        print("ready", flush=True)
        for line in sys.stdin:
            asked, began = json.loads(line), time.monotonic()
            try:
                result = None if asked["do"] == "state" else call(link, asked)
            except busway.ModbusError as error:
                result = error
            print(json.dumps(outcome(began, link, result)), flush=True)


async def run_asyncio(endpoint: str, options: dict[str, Any]) -> None:
    """Ask with the asyncio client, whose loop runs all the time."""
    loop = asyncio.get_running_loop()
    async with busway.open(endpoint, **options) as link:
        print("ready", flush=True)
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            asked, began = json.loads(line), time.monotonic()
            try:
                result = None if asked["do"] == "state" else await call(link, asked)
            except busway.ModbusError as error:
                result = error
            print(json.dumps(outcome(began, link, result)), flush=True)


def main(via: str, endpoint: str, options: dict[str, Any]) -> None:
    """Ask until the input ends."""
    run: dict[str, Callable[[], None]] = {
        "blocking": lambda: run_blocking(endpoint, options),
        "asyncio": lambda: asyncio.run(run_asyncio(endpoint, options)),
    }
    run[via]()


main(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))
