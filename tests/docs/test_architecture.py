"""The architecture page names files and functions that exist, and parts that are those of the package."""

import ast
import asyncio
import re
import sys
import tomllib
from pathlib import Path
from types import FrameType
from typing import TypeAlias

import pytest
from waiting import until

import busway

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "src" / "busway"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
STEPS = re.findall(r"^\| \d+ \| `([\w/.]+)` \| `([\w.]+)` \|", PAGE, re.MULTILINE)


ELSEWHERE = {"6", "7", "8", "11"}
"""Steps of the first journey that a read of an idle link does not take: it need not wait, and its reply is not odd."""


def defined_in(file: Path) -> set[str]:
    """The functions and classes of a file, those of a class as ``Class.method``."""
    found = set()

    def look(nodes: list[ast.stmt], prefix: str) -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                look(node.body, f"{prefix}{node.name}.")

    look(ast.parse(file.read_text(encoding="utf-8")).body, "")
    return found


def test_the_journeys_have_steps() -> None:
    assert len(STEPS) > 25


@pytest.mark.parametrize(("file", "function"), STEPS, ids=lambda text: text)
def test_each_step_of_a_journey_names_a_function_that_is_there(file: str, function: str) -> None:
    assert function in defined_in(SOURCES / file)


def test_every_file_that_is_named_is_there() -> None:
    named = set(re.findall(r"`((?:\w+/)+\w+\.py)`", PAGE))
    assert [name for name in named if not (SOURCES / name).exists() and not (ROOT / name).exists()] == []


def test_every_part_of_the_package_is_named() -> None:
    parts = {one.stem for one in SOURCES.iterdir() if not one.name.startswith("_") and one.suffix in ("", ".py")}
    parts -= {"version", "py"}
    assert [part for part in parts if not re.search(rf"\b{part}\b", PAGE)] == []


@pytest.mark.parametrize(
    "name",
    [
        "AsyncLinkDriver._on_timer",
        "AsyncLinkDriver.lost",
        "TcpClientSession.tick",
        "CallTracker.failed",
        "TcpClientSession.disconnected",
        "TcpServerSession._finish",
        "ServerConnection.pause_writing",
    ],
)
def test_methods_named_in_sentences_are_there(name: str) -> None:
    assert f"`{name}`" in PAGE
    assert any(name in defined_in(file) for file in SOURCES.rglob("*.py"))


def test_the_rooms_are_drawn_in_the_order_that_the_contract_holds() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    layers = [re.findall(r"busway\.(\w+)", layer) for layer in contracts[0]["layers"]]
    rank = {room: number for number, layer in enumerate(layers) for room in layer}
    picture = re.search(r"## The rooms\n\n```\n(.*?)```", PAGE, re.DOTALL)
    assert picture is not None
    drawn = [
        room
        for line in picture[1].splitlines()
        for room in line[:41].replace("/", "").split()
        if room in rank and line.startswith(" ") and not line.startswith("  ")
    ]
    ranks = [rank[room] for room in drawn if room not in ("web", "gateway", "simulator", "tls", "epoll")]
    assert ranks == sorted(ranks), drawn
    assert {room for room in rank if (SOURCES / room).is_dir()} <= set(drawn)


async def test_a_read_takes_the_steps_of_the_first_journey_in_their_order() -> None:
    journey = PAGE.partition("## Journey 1")[2].partition("execute_many")[0]
    steps = re.findall(r"^\| (\d+) \| `([\w/.]+)` \| `([\w.]+)` \|", journey, re.MULTILINE)
    expected = [(file, name) for number, file, name in steps if number not in ELSEWHERE]
    taken: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(SOURCES)):
            taken.append((Path(code.co_filename).relative_to(SOURCES).as_posix(), code.co_qualname))

    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)}) as server:
        async with busway.open(server.endpoints[0]) as link:
            unit = link.unit(1)
            await unit.read_holding_registers(0, count=10)
            sys.setprofile(note)
            try:
                await unit.read_holding_registers(0, count=10)
            finally:
                sys.setprofile(None)
    passed = iter(taken)
    missing = [step for step in expected if step not in passed]
    assert not missing, taken
    named = {file for file, _ in expected} | set(re.findall(r"`((?:\w+/)+\w+\.py)`", journey))
    assert {file for file, _ in taken} <= named | {"transport/epoll/watcher.py"}
    assert len({file for file, _ in taken}) <= 9


Taken: TypeAlias = list[tuple[str, str]]


async def steps_taken(policy: busway.Policy | None, device: busway.Device, *pdus: str) -> list[Taken]:
    """The functions of busway that are called while a client connects, and then for each of its requests."""
    taken: Taken = []
    found = []

    def note(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(SOURCES)):
            taken.append((Path(code.co_filename).relative_to(SOURCES).as_posix(), code.co_qualname))

    async with busway.serve("tcp://127.0.0.1:0", units={1: device}, policy=policy) as server:
        port = int(server.endpoints[0].rpartition(":")[2])
        sys.setprofile(note)
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            await until(lambda: server.status().connections)
            found.append(taken[:])
            for pdu in pdus:
                taken.clear()
                body = b"\x01" + bytes.fromhex(pdu)
                writer.write(b"\x00\x07\x00\x00" + len(body).to_bytes(2, "big") + body)
                header = await reader.readexactly(6)
                await reader.readexactly(int.from_bytes(header[4:], "big"))
                found.append(taken[:])
        finally:
            sys.setprofile(None)
        writer.close()
        await writer.wait_closed()
    return found


async def test_requests_take_the_steps_of_the_second_journey_in_their_order() -> None:
    journey = PAGE.partition("## Journey 2")[2].partition("## Journey 3")[0]
    steps = re.findall(r"^\| \d+ \| `([\w/.]+)` \| `([\w.]+)` \|", journey, re.MULTILINE)
    hooked, plain = busway.Device(holding_registers=10), busway.Device(holding_registers=10)
    hooked.on_read("holding_registers", lambda *_: None)
    read = "03 0000 000A"
    opened, *asked = [
        *await steps_taken(None, plain, read, "07"),
        *(await steps_taken(busway.Policy(), plain, read))[1:],
        *(await steps_taken(None, hooked, read))[1:],
    ]
    assert [step for step in steps[:4] if step not in opened] == []
    for taken in (opened, *asked):
        met = [step for step in (steps[:4] if taken is opened else steps[4:]) if step in taken]
        assert met == sorted(met, key=taken.index)
    assert [step for step in steps[4:] if not any(step in taken for taken in asked)] == []
