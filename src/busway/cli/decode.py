"""``busway decode``: explains frames from a log, a manual or a capture file, field by field.

1. Each argument is a frame; bytes and 16-bit groups that the shell has split (``01 03 00 6b …``, ``0103 006b …``) are
   joined to one.
2. Frames that follow each other are one conversation: a reply is compared with the request before it.
3. If the only argument names a capture file, the frames in this file are explained (`decode_capture`).
4. A frame that is wrong is explained as far as it goes; the exit code is then 6.
"""

import os
import re
import sys
from collections.abc import Iterable

import typer

from ..errors import ConfigError
from ..observe.dissect import Dissector, Framing, MessageDirection
from .arguments import JSON
from .captures import PORT, names_capture
from .dissection import dissection_json, show_dissection
from .exits import ExitCode
from .output import print_json

EXAMPLES = """\b
Examples:
  busway decode 000100000006ff03006b0003
  busway decode 01 03 00 6b 00 03 74 17
  busway decode 0103 006b 0003 7417
  busway decode 03006b0003 0306022b00000064
  busway decode ':0103006B00038E'
  grep RX plant.log | cut -d' ' -f4- | busway decode -
  busway decode site.pcapng --port 502,5020

Spaces, commas, 0x, \\x and colons between bytes do not matter. Groups of one or two bytes
are one frame; write frames that are so short one per line. - reads one frame per line
from standard input. Of a capture file (pcap, pcapng) all Modbus frames are explained.
"""

_ASCII_FRAME = re.compile(r":[^:]+", re.DOTALL)
_SEPARATORS = re.compile(r"0[xX]|\\x|[\s,;:\-_\[\]()']+")


def decode(
    frames: list[str] = typer.Argument(
        ..., metavar="HEX...|CAPTURE", help="Frames in hexadecimal, ASCII frames with colon, or a capture file."
    ),
    framing: str | None = typer.Option(None, "--framing", metavar="NAME", help="mbap, rtu, ascii or pdu, if known."),
    direction: str | None = typer.Option(None, "--direction", metavar="NAME", help="request or reply, if known."),
    port: str | None = PORT,
    as_json: bool = JSON,
) -> int:
    """Explain frames, field by field."""
    if len(frames) == 1 and names_capture(frames[0]):
        from .decode_capture import decode_capture

        if direction is not None:
            raise ConfigError("is for frames without addresses; a capture has them", key="--direction")
        return decode_capture(frames[0], ports=port, framing=framing, as_json=as_json)
    if port is not None:
        raise ConfigError("goes with a capture file only", key="--port")
    dissector = Dissector(
        framing=None if framing is None else Framing(_one_of(framing, "--framing", [each.value for each in Framing])),
        direction=None
        if direction is None
        else MessageDirection(_one_of(direction, "--direction", ["request", "reply"])),
    )
    code = ExitCode.DONE
    if frames == ["-"]:
        # A long log is decoded as it comes.
        all_bytes: Iterable[bytes] = (_bytes_of(line.strip()) for line in sys.stdin if line.strip())
    else:
        all_bytes = [_bytes_of(text) for text in _joined(frames)]
    is_first = True
    for data in all_bytes:
        for dissection in dissector.dissections(data):
            if dissection.problems:
                code = ExitCode.BROKEN
            if as_json:
                print_json(dissection_json(dissection))
                continue
            if not is_first:
                print()
            show_dissection(dissection)
            is_first = False
    return code


def _one_of(text: str, name: str, allowed: list[str]) -> str:
    if text not in allowed:
        raise ConfigError(f"one of {', '.join(allowed)} is needed, not {text!r}", key=name)
    return text


def _joined(texts: list[str]) -> list[str]:
    """Return the frames to decode; if all arguments are groups of one or two bytes, they are one frame."""
    if len(texts) > 1 and all(len(_SEPARATORS.sub("", text)) in (2, 4) and text[0] != ":" for text in texts):
        return [" ".join(texts)]
    return texts


def _bytes_of(text: str) -> bytes:
    """Return the bytes of a frame from hexadecimal text; of an ASCII frame (it begins with a colon) the characters.

    Raises:
        ConfigError: the text has other characters than digits and separators, no digits, or half a byte.
    """
    if _ASCII_FRAME.fullmatch(text) and not text[1:].isspace():
        return text.replace("\\r", "\r").replace("\\n", "\n").encode("ascii", errors="replace")
    digits = _SEPARATORS.sub("", text)
    wrong = next((each for each in digits if each not in "0123456789abcdefABCDEF"), None)
    if wrong is not None:
        what = "there is no file of that name"
        if os.path.lexists(text):
            is_empty = os.path.isfile(text) and not os.path.getsize(text)
            what = "the file is empty" if is_empty else "it is no capture file (pcap, pcapng)"
        raise ConfigError(
            f"{what}, and {wrong!r} is no hexadecimal digit; "
            "what goes here: frames in hexadecimal, a capture file, or - for standard input",
            key=_cut(text),
        )
    if not digits:
        raise ConfigError("there are no bytes", key=repr(text))
    if len(digits) % 2:
        raise ConfigError(f"{len(digits)} hexadecimal digits are no whole number of bytes", key=_cut(text))
    return bytes.fromhex(digits)


def _cut(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:40]}…"
