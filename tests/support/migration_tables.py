"""The tables of the migration pages, call by call: both columns, and the device of the page."""

import asyncio
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import busway

PAGES = Path(__file__).resolve().parents[2] / "docs" / "how-to"


def calls_of(name: str) -> list[tuple[str, str]]:
    """The rows of the table below the comment ``<!-- calls -->`` of a page: what is called there, and here."""
    table = (PAGES / name).read_text("utf-8").partition("<!-- calls -->\n\n")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| (?:\w+: )?`(.+?)` \| (?:\w+: )?`(.+?)` \|$", table, re.MULTILINE)
    assert len(rows) == len(table.splitlines()) - 1 > 5, (
        "every row but the rule has two calls; the first is the heading"
    )
    return rows[1:]


@contextmanager
def device_of(name: str) -> Iterator[str]:
    """Serves the device of a page; the endpoint."""
    block = re.findall(r"^```python\n(.*?)^```$", (PAGES / name).read_text("utf-8"), re.DOTALL | re.MULTILINE)[0]
    made: dict[str, Any] = {}
    exec(block.partition("\n\n\ndef started")[0], made)
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: made["device"]}) as server:
        yield server.endpoints[0]


def called(calls: list[str], endpoint: str) -> list[Any]:
    """What the calls of blocking units give, one after the other."""
    with busway.connect(endpoint, timeout=30.0) as link:
        unit = link.unit(1)
        return [eval(call, {"unit": unit}) for call in calls]


async def awaited(calls: list[str], endpoint: str) -> list[Any]:
    """What the calls of asyncio units give, one after the other."""
    async with busway.open(endpoint, timeout=30.0) as link:
        unit = link.unit(1)
        return [await asyncio.wait_for(eval(call.removeprefix("await "), {"unit": unit}), 60) for call in calls]
