"""LRC of ASCII frames (Serial Line V1.02 §2.5.2.2, §6.2.1).

Knows bytes; knows no characters. The LRC is the two's complement of the sum of all bytes: with it, their sum is 0.
"""


def lrc(data: bytes | bytearray) -> int:
    """Return the LRC of binary data, 0…255; 0 for data that end with their own LRC."""
    return -sum(data) & 0xFF
