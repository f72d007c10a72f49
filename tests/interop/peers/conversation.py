"""What the Python peers share: the known content of a server, and a client's conversation over standard input.

It runs in the peers' own environment, beside the script that imports it, and knows none of the Modbus libraries.
The C peers keep the same conventions.
"""

import json
import sys
from collections.abc import Callable, Iterable
from typing import Any

ITEMS = 1000

HOLDING_REGISTERS = [(address * 7 + 3) & 0xFFFF for address in range(ITEMS)]
INPUT_REGISTERS = [(address * 11 + 5) & 0xFFFF for address in range(ITEMS)]
COILS = [address % 3 == 0 for address in range(ITEMS)]
DISCRETE_INPUTS = [address % 5 == 0 for address in range(ITEMS)]

IDENTITY = {
    0x00: "Acme",
    0x01: "PX-1",
    0x02: "2.5",
    0x03: "https://acme.example",
    0x04: "Pump",
    0x05: "P",
    0x06: "Hall 3",
}


class Refused(Exception):
    """The server answered with an exception code; 0 for every other failure."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


def say(line: str) -> None:
    """One line to the process that started this program, at once."""
    print(line, flush=True)


def converse(commands: dict[str, Callable[..., dict[str, Any]]], lines: Iterable[str] = sys.stdin) -> None:
    """Answer each line ``name number…`` with one line of JSON, until the input ends.

    Numbers are decimal, or hexadecimal with ``0x``. A command gives its result as fields, or raises `Refused`.
    """
    say("ready")
    for line in lines:
        name, *words = line.split()
        try:
            result = {"ok": True, **commands[name](*(int(word, 0) for word in words))}
        except Refused as refusal:
            result = {"ok": False, "exception": refusal.code, "error": str(refusal)}
        except Exception as error:  # whatever its type, a peer's own error is a result
            result = {"ok": False, "exception": 0, "error": f"{type(error).__name__}: {error}"}
        say(json.dumps(result))
