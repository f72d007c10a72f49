"""A capture file taken apart into its blocks."""

import struct


def blocks(data: bytes) -> list[tuple[int, bytes]]:
    """Kinds and bodies of the blocks of a file, both of their lengths checked."""
    found = []
    while data:
        kind, size = struct.unpack_from("<II", data)
        assert size % 4 == 0
        assert struct.unpack_from("<I", data, size - 4) == (size,)
        found.append((kind, data[8 : size - 4]))
        data = data[size:]
    return found


def options(data: bytes) -> dict[int, bytes]:
    """Options by code; what follows the end is an error."""
    found = {}
    while True:
        code, size = struct.unpack_from("<HH", data)
        data = data[4:]
        if not code:
            assert not data
            return found
        found[code] = data[:size]
        data = data[size + -size % 4 :]
