"""Runs: wire order in and out, and changes that no reader sees half of."""

import threading

import pytest

from busway.server.memory_runs import BitRun, RegisterBits, RegisterRun, Run, replace_all


def test_registers_are_kept_big_endian() -> None:
    run = RegisterRun(100, bytearray(6), threading.RLock())
    run.put(1, 2, bytes.fromhex("12 34 56 78"))
    assert run.data == bytes.fromhex("00 00 12 34 56 78")
    assert run.get(1, 1) == bytes.fromhex("12 34")
    assert (run.first, run.count) == (100, 3)


@pytest.mark.parametrize("count", [1, 2, 125, 126, 300])
def test_registers_are_put_whatever_their_number_and_the_others_stay(count: int) -> None:
    run = RegisterRun(0, bytearray(b"\xee" * 2 * 302), threading.RLock())
    run.put(1, count, bytes(2 * count))
    assert run.data == b"\xee\xee" + bytes(2 * count) + b"\xee" * 2 * (301 - count)


@pytest.mark.parametrize("count", [1, 2, 123, 125])
def test_an_exchange_gives_the_registers_that_stood_there(count: int) -> None:
    run = RegisterRun(0, bytearray(number & 0xFF for number in range(400)), threading.RLock())
    before = bytes(run.data)
    assert run.exchange(3, count, b"\xee" * 2 * count) == before[6 : 6 + 2 * count]
    assert run.data == before[:6] + b"\xee" * 2 * count + before[6 + 2 * count :]


def test_an_exchange_gives_the_bits_that_stood_there() -> None:
    run = BitRun(0, 20, bytearray(bytes.fromhex("F5 FF 0F")), threading.RLock())
    assert run.exchange(1, 3, b"\x05") == b"\x02"
    assert run.exchange(6, 5, b"\x00") == b"\x1f"
    assert run.data == bytes.fromhex("3B F8 0F")


def test_bits_are_packed_from_the_lowest_and_neighbours_stay() -> None:
    run = BitRun(0, 20, bytearray(bytes.fromhex("FF FF 0F")), threading.RLock())
    run.put(6, 5, b"\x00")
    assert run.data == bytes.fromhex("3F F8 0F")
    assert run.get(5, 7) == bytes((0b1000001,))
    assert run.count == 20


def test_bit_n_of_registers_is_bit_n_modulo_16_of_register_n_divided_by_16() -> None:
    lock = threading.RLock()
    memory = RegisterRun(0, bytearray(8), lock)
    bits = RegisterBits(memory, 1, 40, lock)
    bits.put(0, 1, b"\x01")  # the least significant bit of register 1
    bits.put(15, 2, b"\x03")  # the most significant of register 1, the least of register 2
    assert memory.data == bytes.fromhex("00 00 80 01 00 01 00 00")
    memory.put(3, 1, bytes.fromhex("00 80"))
    assert bits.get(39, 1) == b"\x01"
    assert bits.get(14, 4) == bytes((0b0110,))


@pytest.mark.parametrize("first", range(0, 34, 3))
@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 15, 16, 17, 30])
def test_bits_of_registers_give_back_what_was_put_and_touch_nothing_else(first: int, count: int) -> None:
    lock = threading.RLock()
    memory = RegisterRun(0, bytearray(b"\xff" * 8), lock)
    bits = RegisterBits(memory, 0, 64, lock)
    bits.put(first, count, bytes((count + 7) // 8))
    states = [bits.get(position, 1) == b"\x01" for position in range(64)]
    assert states == [not first <= position < first + count for position in range(64)]


def test_several_runs_get_their_new_bytes_together() -> None:
    lock = threading.RLock()
    registers, bits = RegisterRun(0, bytearray(4), lock), BitRun(0, 8, bytearray(1), lock)
    replace_all({registers: bytearray(b"\x00\x01\x00\x02"), bits: bytearray(b"\x81")})
    assert registers.get(0, 2) == b"\x00\x01\x00\x02"
    assert bits.get(0, 8) == b"\x81"


def test_every_kind_of_run_changes_a_copy_as_it_changes_itself() -> None:
    lock = threading.RLock()
    words = RegisterRun(0, bytearray(4), lock)
    runs: list[Run] = [words, BitRun(0, 8, bytearray(1), lock), RegisterBits(words, 0, 32, lock)]
    for run in runs:
        copy = bytearray(run.memory.data)
        run.patch(copy, 1, 1, b"\x01\x00"[: 2 if run is words else 1])
        assert run.memory.data != copy
        assert run.fetch(copy, 1, 1) != run.get(1, 1)
        run.put(1, 1, run.fetch(copy, 1, 1))
        assert run.memory.data == copy
