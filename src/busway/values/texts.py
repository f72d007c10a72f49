"""Conversion between registers and character strings.

Knows encodings, padding and the two orders of characters in a register. Two characters lie in a register, the first in
the high byte unless the order is ``BA``; or one in each, in its low or its high byte.

Rules:

1. A text is never cut: one that is too long is refused. The length is counted in bytes of its encoding.
2. A text that is read ends at the first NUL; bytes after it are ignored. With space padding, trailing spaces are
   padding too, so a text that ends in spaces comes back without them.
3. The last byte of an odd length only fills the register: written as padding, not looked at when read.
"""

from typing import Any

from ..errors import BadReply, InvalidRequest
from .orders import ByteOrder, BytesLike, swapped
from .unfit_values import shown, unfit


class StringCodec:
    """Converts registers to texts, and back; every text takes the same number of registers.

    Args:
        name: name of the value type, for errors.
        length: most bytes of a text.
        encoding: ``ascii``, ``latin-1`` or ``utf-8``.
        padding: ``nul`` or ``space``, which fills the rest of the registers.
        order: order of the bytes of a register.
        half: ``low`` or ``high`` if each register has one character, in this byte; empty if it has two.
        upper: whether small letters become capitals, both in texts that are read and in texts that are written.

    Attributes:
        expects: which texts the registers can hold, in words.
    """

    def __init__(
        self,
        name: str,
        length: int,
        encoding: str,
        padding: str,
        order: ByteOrder,
        *,
        half: str = "",
        upper: bool = False,
    ) -> None:
        self._name = name
        self._length = length
        self._half = half
        self._upper = upper
        self._size = length if half else (length + 1) // 2 * 2
        self._encoding = encoding
        self._fill = b" " if padding == "space" else b"\0"
        self._swaps = order.swaps
        self.expects: str = f"text of at most {length} {'byte' if length == 1 else 'bytes'} in {encoding}"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the texts that registers in wire order hold. A text ends at the first NUL; padding is removed.

        Raises:
            BadReply: the bytes are not text in this encoding; ``raw`` holds the bytes of all values.
        """
        whole = swapped(data, self._swaps)
        if self._half:
            whole = whole[1::2] if self._half == "low" else whole[::2]
        return [self._text(whole[start : start + self._length], data) for start in range(0, len(whole), self._size)]

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these texts, each padded to the full number of registers.

        Raises:
            InvalidRequest: a value is no text, is too long, does not fit the encoding, or contains a NUL. Nothing was
                sent.
        """
        block = b"".join(self._field(values, index) for index in range(len(values)))
        if self._half:
            block = b"".join(b"\0%c" % each if self._half == "low" else b"%c\0" % each for each in block)
        return swapped(block, self._swaps)

    def parse(self, text: str) -> str:
        """Return the text unchanged if a value of this type can hold it. Raises `InvalidRequest` if not."""
        self.encode([text])
        return text

    def _text(self, field: bytes, block: BytesLike) -> str:
        content = field.partition(b"\0")[0]
        if self._fill == b" ":
            content = content.rstrip(b" ")
        try:
            text = content.decode(self._encoding)
            return text.upper() if self._upper else text
        except UnicodeDecodeError as error:
            raise BadReply(
                f"{shown(content)} is not {self._encoding} text, as {self._name} expects; latin-1 takes every byte",
                kind="value",
                raw=bytes(block),
            ) from error

    def _field(self, values: list[object], index: int) -> bytes:
        value = values[index]
        if not isinstance(value, str):
            raise unfit(values, index, self._name, self.expects)
        try:
            content = (value.upper() if self._upper else value).encode(self._encoding)
        except UnicodeEncodeError as error:
            raise unfit(values, index, self._name, self.expects) from error
        if len(content) > self._length:
            raise unfit(values, index, self._name, self.expects, f"; this is {len(content)}")
        if b"\0" in content:
            raise InvalidRequest(f"{shown(value)} holds a NUL, at which {self._name} ends when it is read")
        return content.ljust(self._size, self._fill)
