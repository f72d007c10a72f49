"""The payload builder and decoder that pymodbus had until 3.9: values ⇄ bytes ⇄ registers, one value after the other.

Knows numbers, texts and bytes; knows no client. With ``byteorder`` little the bytes of each register are swapped, with
``wordorder`` little the registers of a value are reversed; both as in pymodbus, values of one byte included.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import Any, Self

from ...pdu.bits import pack_bits, unpack_bits
from .constants import Endian
from .exceptions import ParameterException

BITS_OF_BYTE = 8


def ordered(data: bytes, byteorder: str, wordorder: str) -> bytes:
    """Convert the bytes of one value between big-endian order and the order of a payload, in either direction."""
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if byteorder == Endian.LITTLE:
        words = [word[::-1] for word in words]
    if wordorder == Endian.LITTLE:
        words.reverse()
    return b"".join(words)


class BinaryPayloadBuilder:
    """Collects values, and returns them as registers, coils or bytes.

    A method ``add_…`` raises ``struct.error`` for a number that does not fit.

    Args:
        payload: a list of ``bytes`` objects to begin with.
        byteorder: order of the bytes of each register.
        wordorder: order of the registers of each value.
        repack: whether `to_registers` applies ``byteorder`` to the registers once more.
    """

    def __init__(
        self,
        payload: Iterable[bytes] | None = None,
        byteorder: str = Endian.LITTLE,
        wordorder: str = Endian.BIG,
        repack: bool = False,
    ) -> None:
        self._payload = list(payload or [])
        self._byteorder = byteorder
        self._wordorder = wordorder
        self._repack = repack

    def encode(self) -> bytes:
        """Return all bytes collected so far."""
        return b"".join(self._payload)

    def __str__(self) -> str:
        return self.encode().decode("utf-8")

    def reset(self) -> None:
        """Remove all collected values."""
        self._payload = []

    def build(self) -> list[bytes]:
        """Return the collected bytes in pairs, for ``write_registers``; a zero byte follows an odd number."""
        data = self.encode()
        data += bytes(len(data) % 2)
        return [data[at : at + 2] for at in range(0, len(data), 2)]

    def to_registers(self) -> list[int]:
        """Return the collected bytes as registers, 0…65535, for ``write_registers``."""
        order: str = self._byteorder if self._repack else ">"
        return [_unpacked(f"{_sign(order)}H", pair) for pair in self.build()]

    def to_coils(self) -> list[bool]:
        """Return the bits of the registers, the highest bit of each register first, for ``write_coils``."""
        return [bool(register >> bit & 1) for register in self.to_registers() for bit in reversed(range(16))]

    def add_bits(self, values: Sequence[bool]) -> None:
        """Add bits, the first as the lowest bit of the first byte; missing bits of the last byte are 0."""
        self._payload.append(pack_bits([bool(value) for value in values]))

    def _add_small(self, kind: str, value: int) -> None:
        self._payload.append(struct.pack(f"{_sign(self._byteorder)}{kind}", value))

    def _add_wide(self, kind: str, value: float) -> None:
        self._payload.append(ordered(struct.pack(f">{kind}", value), self._byteorder, self._wordorder))

    def add_8bit_uint(self, value: int) -> None:
        """Add one byte, 0…255."""
        self._add_small("B", value)

    def add_8bit_int(self, value: int) -> None:
        """Add one byte, -128…127."""
        self._add_small("b", value)

    def add_16bit_uint(self, value: int) -> None:
        """Add a number of 16 bits, 0…65535."""
        self._add_small("H", value)

    def add_16bit_int(self, value: int) -> None:
        """Add a number of 16 bits, -32768…32767."""
        self._add_small("h", value)

    def add_32bit_uint(self, value: int) -> None:
        """Add a number of 32 bits, not negative."""
        self._add_wide("I", value)

    def add_32bit_int(self, value: int) -> None:
        """Add a number of 32 bits, which may be negative."""
        self._add_wide("i", value)

    def add_64bit_uint(self, value: int) -> None:
        """Add a number of 64 bits, not negative."""
        self._add_wide("Q", value)

    def add_64bit_int(self, value: int) -> None:
        """Add a number of 64 bits, which may be negative."""
        self._add_wide("q", value)

    def add_16bit_float(self, value: float) -> None:
        """Add a float of 16 bits."""
        self._add_wide("e", value)

    def add_32bit_float(self, value: float) -> None:
        """Add a float of 32 bits."""
        self._add_wide("f", value)

    def add_64bit_float(self, value: float) -> None:
        """Add a float of 64 bits."""
        self._add_wide("d", value)

    def add_string(self, value: str) -> None:
        """Add a text in UTF-8, cut off after as many bytes as it has characters: ASCII texts are added whole."""
        self._payload.append(struct.pack(f"{len(value)}s", value.encode()))


class BinaryPayloadDecoder:
    """Decodes the values in registers or coils one after the other: each call of a ``decode_…`` method the next bytes.

    If there are fewer bytes than a number has, the method raises ``struct.error``.

    Args:
        payload: the bytes of the values.
        byteorder: order of the bytes of each register.
        wordorder: order of the registers of each value.
    """

    def __init__(self, payload: bytes, byteorder: str = Endian.LITTLE, wordorder: str = Endian.BIG) -> None:
        self._payload = payload
        self._pointer = 0
        self._byteorder = byteorder
        self._wordorder = wordorder

    @classmethod
    def fromRegisters(
        cls, registers: Sequence[int], byteorder: str = Endian.LITTLE, wordorder: str = Endian.BIG
    ) -> Self:
        """Return a decoder of a list of registers.

        Raises:
            ParameterException: ``registers`` is no list.
        """
        if not isinstance(registers, list):
            raise ParameterException("Invalid collection of registers supplied")
        return cls(struct.pack(f">{len(registers)}H", *registers), byteorder, wordorder)

    @classmethod
    def bit_chunks(cls, coils: Sequence[bool], size: int = BITS_OF_BYTE) -> list[Sequence[bool]]:
        """Return bits in groups of ``size``, in order; the last group may be shorter."""
        return [coils[at : at + size] for at in range(0, len(coils), size)]

    @classmethod
    def fromCoils(cls, coils: Sequence[bool], byteorder: str = Endian.LITTLE, _wordorder: str = Endian.BIG) -> Self:
        """Return a decoder of a list of bits, the first as the highest bit of the first byte.

        If the number of bits is no multiple of 8, as many zero bits as the remainder are put before them, as in
        pymodbus: 10 bits become 12, in two bytes. ``_wordorder`` has no effect.

        Raises:
            ParameterException: ``coils`` is no list.
        """
        if not isinstance(coils, list):
            raise ParameterException("Invalid collection of coils supplied")
        # pymodbus puts as many zeros before them as are left over, and not as many as are missing.
        padded = [False] * (len(coils) % BITS_OF_BYTE) + coils
        return cls(b"".join(pack_bits(list(chunk)[::-1]) for chunk in cls.bit_chunks(padded)), byteorder)

    def reset(self) -> None:
        """Go back to the first byte."""
        self._pointer = 0

    def skip_bytes(self, nbytes: int) -> None:
        """Skip the next ``nbytes`` bytes."""
        self._pointer += nbytes

    def _next(self, size: int) -> bytes:
        self._pointer += size
        return self._payload[self._pointer - size : self._pointer]

    def _small(self, kind: str, size: int) -> Any:  # the type of the value follows from `kind`
        return _unpacked(f"{_sign(self._byteorder)}{kind}", self._next(size))

    def _wide(self, kind: str, size: int) -> Any:  # likewise
        return _unpacked(f">{kind}", ordered(self._next(size), self._byteorder, self._wordorder))

    def decode_bits(self, package_len: int = 1) -> list[bool]:
        """Skip ``package_len`` - 1 bytes, and return the eight bits of the next byte, the lowest first.

        An empty list at the end of the payload.
        """
        self._pointer += package_len
        byte = self._payload[self._pointer - 1 : self._pointer]
        return unpack_bits(byte, BITS_OF_BYTE * len(byte))

    def decode_8bit_uint(self) -> int:
        """Return the next byte as a number, 0…255."""
        return int(self._small("B", 1))

    def decode_8bit_int(self) -> int:
        """Return the next byte as a number, -128…127."""
        return int(self._small("b", 1))

    def decode_16bit_uint(self) -> int:
        """Return the next 16 bits as a number, 0…65535."""
        return int(self._small("H", 2))

    def decode_16bit_int(self) -> int:
        """Return the next 16 bits as a number, -32768…32767."""
        return int(self._small("h", 2))

    def decode_32bit_uint(self) -> int:
        """Return the next 32 bits as a number that is not negative."""
        return int(self._wide("I", 4))

    def decode_32bit_int(self) -> int:
        """Return the next 32 bits as a number that may be negative."""
        return int(self._wide("i", 4))

    def decode_64bit_uint(self) -> int:
        """Return the next 64 bits as a number that is not negative."""
        return int(self._wide("Q", 8))

    def decode_64bit_int(self) -> int:
        """Return the next 64 bits as a number that may be negative."""
        return int(self._wide("q", 8))

    def decode_16bit_float(self) -> float:
        """Return the next 16 bits as a float."""
        return float(self._wide("e", 2))

    def decode_32bit_float(self) -> float:
        """Return the next 32 bits as a float."""
        return float(self._wide("f", 4))

    def decode_64bit_float(self) -> float:
        """Return the next 64 bits as a float."""
        return float(self._wide("d", 8))

    def decode_string(self, size: int = 1) -> bytes:
        """Return the next ``size`` bytes as they are; fewer at the end of the payload."""
        return self._next(size)


def _sign(order: str) -> str:
    return Endian(order).value


def _unpacked(form: str, data: bytes) -> Any:  # the type of the value follows from `form`
    (value,) = struct.unpack(form, data)
    return value
