"""How many values a second become of the bytes of replies: ``python bench/decode_points.py``.

One core, reads of 120 registers, the best of five rounds. What it prints is for reading; nothing is asserted.
"""

import time
from collections.abc import Callable
from typing import Final

from busway.codes import Table
from busway.points import Conversion, Point
from busway.points.decoder import ReadDecoder
from busway.values import value_type

REGISTERS: Final = 120
ROUND: Final = 0.3


def main() -> None:
    """Print a line for each kind of read."""
    kinds = {
        "uint16": lambda at: _point(at, "uint16"),
        "uint16, scale 0.1": lambda at: _point(at, "uint16", conversion=Conversion(0.1)),
        "int16, scale, invalid, valid": lambda at: _point(
            at, "int16", conversion=Conversion(0.1, invalid=(0x8000,), valid=(-4000.0, 4000.0))
        ),
        "float32": lambda at: _point(at, "float32"),
        "float32 CDAB": lambda at: _point(at, "float32", "CDAB"),
        "bits of registers": lambda at: _point(at, f"bit:{at % 16}"),
        "string:8": lambda at: _point(at, "string:8"),
    }
    for name, make in kinds.items():
        print(f"{name:32} {values_per_second(make) / 1e6:6.1f} M values/s")


def values_per_second(make: Callable[[int], Point]) -> float:
    """Values of a read full of such points, per second."""
    points, at = [], 0
    while at + (width := make(at).width) <= REGISTERS:
        points.append(make(at))
        at += width
    decoder, data = ReadDecoder(points, Table.HOLDING_REGISTERS, 0, REGISTERS), bytes(range(2 * REGISTERS))
    decoder.decode(data)
    best = 0.0
    for _ in range(5):
        rounds, began = 0, time.perf_counter()
        while (passed := time.perf_counter() - began) < ROUND:
            for _ in range(100):
                decoder.decode(data)
            rounds += 100
        best = max(best, rounds * len(points) / passed)
    return best


def _point(at: int, type: str, order: str = "ABCD", conversion: Conversion | None = None) -> Point:
    return Point(f"p{at}", Table.HOLDING_REGISTERS, at, value_type(type, order), conversion or Conversion())


if __name__ == "__main__":
    main()
