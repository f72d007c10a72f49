"""A served device that writes down each write that it executes, and a collector file for it: for tests of commands."""

from collections.abc import Callable
from pathlib import Path

import busway
from busway.server.hooks import Change
from busway.server.server import Server

VALVE = """\
[[unit]]
unit = 1
coils = 10
holding_registers = 40

[[unit.point]]
name = "setpoint"
address = "4x1"
type = "int16"
scale = 0.1
minimum = 0
maximum = 100
unit_of_measure = "°C"
write = { verify = "read-back", step = 0.5 }

[[unit.point]]
name = "mode"
address = "4x2"
enumeration = { off = 0, auto = 1, hand = 2 }

[[unit.point]]
name = "pump"
address = "4x3"
write = { on = 170, off = 85 }

[[unit.point]]
name = "door"
address = "4x4.3"

[[unit.point]]
name = "valve"
address = "0x1"
write = { verify = "4x5" }

[[unit.point]]
name = "level"
address = "4x6"
access = "read"

[[unit.point]]
name = "shown"
address = "4x5"
access = "read"

[[unit.point]]
name = "text"
address = "4x10"
type = "string:8"

[[unit.point]]
name = "heat"
address = "4x20"
type = "float32"
write = { verify = "4x22" }
"""


class RecordedDevice:
    """Unit 1 of a server, and the writes that it has executed: table, first address and items."""

    def __init__(self) -> None:
        self.device = busway.Device(holding_registers=40, coils=10)
        self.writes: list[tuple[str, int, list[int]]] = []
        self.before: list[Callable[[Change], None]] = []
        for table in ("coils", "holding_registers"):
            self.device.on_write(table, self._note)

    def _note(self, change: Change) -> None:
        self.writes.append((change.table.value, change.address, [int(each) for each in change.new]))
        for told in self.before:
            told(change)

    def server(self, url: str = "tcp://127.0.0.1:0") -> Server:
        """A server with it as unit 1."""
        return busway.serve(url, units={1: self.device})


def commanded_plant(folder: Path, url: str, *, period: float = 0.1, link: str = "", more: str = "") -> Path:
    """The file of a collector that polls one device, ``boiler``; ``link`` are further keys of its link."""
    (folder / "valve.toml").write_text(VALVE, encoding="utf-8")
    file = folder / "plant.toml"
    file.write_text(
        f'[collector]\nstore = "data"\npage = "off"\n[poll_class]\nall.period = {period}\n'
        f'[[link]]\nname = "hall"\nurl = "{url}"\n{link}\n'
        f'[[device]]\nname = "boiler"\nlink = "hall"\nunit = 1\nprofile = "valve.toml"\n{more}',
        encoding="utf-8",
    )
    return file
