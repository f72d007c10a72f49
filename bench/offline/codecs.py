"""Times every message, numbers, CRC and LRC; prints JSON: ``{group: {name: {step: nanoseconds}}}``.

Run from `bench/`: python -m offline.codecs SECONDS

Requests and replies are the examples of the specification (`busway.testing.golden`); of functions that have none, of
which there are several sub-functions, the shortest request that is one.
"""

import json
import struct
import sys
from collections.abc import Callable
from functools import partial

from busway import STANDARD
from busway.framing.crc import crc16
from busway.framing.lrc import lrc
from busway.pdu.message import Request
from busway.testing.golden import GOLDEN_EXCHANGES
from busway.values import decode, encode
from offline.timing import quickest

Steps = dict[tuple[str, str, str], Callable[[], object]]
MESSAGES, NUMBERS, CHECKS = "messages", "values", "checks"
REGISTERS = 120
TYPES = (("uint16", "ABCD"), ("int16", "ABCD"), ("uint32", "ABCD"), ("float32", "CDAB"), ("int64", "ABCD"),
         ("float64", "DCBA"))  # fmt: skip


def messages() -> Steps:
    """Encoding and decoding of requests and replies."""
    pairs = [(one.request, one.reply) for one in GOLDEN_EXCHANGES]
    shown = {type(STANDARD.decode_request(request)) for request, _ in pairs}
    pairs += [(pdu, b"") for kind in STANDARD if kind not in shown and (pdu := _shortest(kind))]
    steps: Steps = {}
    for pdu, answer in pairs:
        request = STANDARD.decode_request(pdu)
        name = f"{pdu[0]:02X} {type(request).__name__}"
        steps[MESSAGES, name, "encode request"] = request.encode
        steps[MESSAGES, name, "decode request"] = partial(STANDARD.decode_request, pdu)
        if answer:
            steps[MESSAGES, name, "encode reply"] = STANDARD.decode_reply(answer).encode
            steps[MESSAGES, name, "decode reply"] = partial(STANDARD.decode_reply, answer)
    floor = struct.Struct(">BB10H")
    packed = floor.pack(3, 20, *range(10))
    for step in ("request", "reply"):
        steps[MESSAGES, "floor: struct, 10 registers", f"encode {step}"] = partial(floor.pack, 3, 20, *range(10))
        steps[MESSAGES, "floor: struct, 10 registers", f"decode {step}"] = partial(floor.unpack, packed)
    return steps


def _shortest(kind: type[Request]) -> bytes:
    """The shortest request of a function; empty where guessing finds none."""
    head = bytes([kind.code])
    if kind.sub_code is not None:
        head += kind.sub_code.to_bytes(kind.sub_width, "big")
    for more in range(12):
        pdu = head + bytes(more)
        if type(STANDARD.decode_request(pdu)) is kind:
            return pdu
    return b""


def numbers() -> Steps:
    """So many registers into numbers, and back."""
    steps: Steps = {}
    for name, order in TYPES:
        values = decode(bytes(2 * REGISTERS), name, order)
        data = encode(values, name, order)
        label = f"{name} {order}, {len(values)} values"
        steps[NUMBERS, label, "encode"] = partial(encode, values, name, order)
        steps[NUMBERS, label, "decode"] = partial(decode, data, name, order)
    floor = struct.Struct(f">{REGISTERS}H")
    steps[NUMBERS, f"floor: struct, {REGISTERS} values", "encode"] = partial(floor.pack, *range(REGISTERS))
    steps[NUMBERS, f"floor: struct, {REGISTERS} values", "decode"] = partial(floor.unpack, bytes(2 * REGISTERS))
    return steps


def checks() -> Steps:
    """Check sums of a short and of the longest frame."""
    steps: Steps = {}
    for size in (6, 254):
        data = bytes(number * 7 & 0xFF for number in range(size))
        steps[CHECKS, f"CRC, {size} bytes", "check"] = partial(crc16, data)
        steps[CHECKS, f"LRC, {size} bytes", "check"] = partial(lrc, data)
        steps[CHECKS, f"floor: sum, {size} bytes", "check"] = partial(sum, data)
    return steps


def main(seconds: float) -> None:
    steps = {"/".join(key): step for key, step in (messages() | numbers() | checks()).items()}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for key, nanoseconds in quickest(steps, seconds).items():
        group, name, step = key.split("/")
        found.setdefault(group, {}).setdefault(name, {})[step] = nanoseconds
    print(json.dumps(found))


main(float(sys.argv[1]))
