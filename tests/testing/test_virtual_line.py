"""The bus as pure simulation."""

import pytest

from busway.errors import ConfigError
from busway.testing.virtual_line import NOISE, VirtualLine
from busway.transport.serial.marks import UnmarkedBytes

REQUEST = bytes.fromhex("01 03 00 00 00 0A C5 CD")  # read 10 holding registers of unit 1


def test_a_character_is_heard_when_its_last_bit_has_passed() -> None:
    line = VirtualLine(3, 9600, "even")
    end = line.ports[0].write(REQUEST, now=10.0)
    assert line.character_time == 11 / 9600
    assert end == pytest.approx(10.0 + 8 * 11 / 9600)
    assert line.deadline() == pytest.approx(10.0 + 11 / 9600)
    assert line.pause_at() == line.quiet_at() == end
    assert line.advance(10.0 + 0.9 * line.character_time) == []
    passed = line.advance(10.0 + 3.1 * line.character_time)
    assert [byte.value for byte in passed] == list(REQUEST[:3])
    assert [byte.time for byte in passed] == pytest.approx([10.0 + n * line.character_time for n in (1, 2, 3)])
    line.advance(end)
    assert line.deadline() is None
    assert line.ports[1].read() == line.ports[2].read() == UnmarkedBytes(REQUEST, 0)
    assert line.ports[0].read() == UnmarkedBytes(b"", 0)  # no echo


@pytest.mark.parametrize(("parity", "data_bits", "stop_bits", "bits"), [("none", 8, None, 11), ("even", 7, None, 10)])
def test_the_settings_give_a_character_its_length(
    parity: str, data_bits: int, stop_bits: int | None, bits: int
) -> None:
    line = VirtualLine(2, 19_200, parity, data_bits=data_bits, stop_bits=stop_bits)
    assert line.ports[0].write(b"x", now=0.0) == pytest.approx(bits / 19_200)


def test_what_is_written_while_talking_follows_without_a_gap() -> None:
    line = VirtualLine(2)
    line.ports[0].write(b"ab", now=0.0)
    line.ports[0].write(b"cd", now=0.0001)
    line.advance(1.0)
    assert [(part.data, part.begin) for part in line.transmissions()] == [(b"abcd", pytest.approx(0.0))]


def test_a_port_with_an_echo_hears_itself() -> None:
    line = VirtualLine(3, echo={1})
    line.ports[1].write(b"one", now=0.0)
    line.ports[2].write(b"two", now=1.0)
    line.advance(2.0)
    assert line.ports[0].read().data == b"onetwo"
    assert line.ports[1].read().data == b"onetwo"
    assert line.ports[2].read().data == b"one"


def test_two_talkers_at_once_spoil_what_overlaps_and_are_counted() -> None:
    line = VirtualLine(3)
    line.ports[0].write(b"abcd", now=0.0)
    line.ports[1].write(b"xy", now=2.5 * line.character_time)  # over c and d
    line.advance(1.0)
    assert line.collisions == 4
    spoilt = {(byte.port, byte.damaged) for byte in line.tap}
    assert spoilt == {(0, False), (0, True), (1, True)}
    heard = line.ports[2].read()
    assert heard.data[:2] == b"ab"
    assert len(heard.data) == 6
    assert heard.errors == 4
    assert line.ports[0].read().data == b""  # its receiver was off
    assert line.ports[1].read().data == b"ab"  # before it began to talk


def test_one_who_begins_when_the_other_has_ended_does_not_collide() -> None:
    line = VirtualLine(2)
    end = line.ports[0].write(b"ab", now=0.0)
    line.ports[1].write(b"cd", now=end)
    line.advance(1.0)
    assert line.collisions == 0
    assert line.ports[0].read().data == b"cd"


def test_noise_damages_as_many_as_it_says_and_the_same_ones_for_the_same_seed() -> None:
    def heard(seed: int) -> UnmarkedBytes:
        line = VirtualLine(2, noise=0.1, seed=seed)
        line.ports[0].write(bytes(1000), now=0.0)
        line.advance(10.0)
        return line.ports[1].read()

    first = heard(1)
    assert 60 < first.errors < 140
    assert len(first.data) == 1000
    assert sum(value != 0 for value in first.data) == first.errors
    assert heard(1) == first
    assert heard(2) != first


def test_without_a_parity_bit_damage_does_not_show() -> None:
    line = VirtualLine(2, parity="none", noise=1.0)
    line.ports[0].write(b"\0", now=0.0)
    line.advance(1.0)
    received = line.ports[1].read()
    assert received.data != b"\0"
    assert received.errors == 0


def test_a_cut_wire_loses_what_passes_and_a_mended_one_does_not() -> None:
    line = VirtualLine(3, echo={0})
    line.cut(2)
    line.ports[0].write(b"a", now=0.0)
    line.advance(0.1)
    line.mend(2)
    line.cut()
    line.ports[0].write(b"b", now=0.1)
    line.advance(0.2)
    line.mend()
    line.ports[0].write(b"c", now=0.2)
    line.advance(0.3)
    assert line.ports[2].read().data == b"c"
    assert line.ports[1].read().data == b"ac"
    assert line.ports[0].read().data == b"abc"  # the echo is on this side of the cut


def test_those_behind_a_cut_collide_with_no_other() -> None:
    line = VirtualLine(3)
    line.cut(0)
    line.ports[0].write(b"lost", now=0.0)
    line.ports[1].write(b"good", now=0.0)
    line.advance(1.0)
    assert line.collisions == 0
    assert line.ports[2].read() == UnmarkedBytes(b"good", 0)


def test_characters_out_of_nowhere_are_heard_by_all_and_collide() -> None:
    line = VirtualLine(2)
    line.inject(b"\x00\xff", now=0.0)
    line.advance(0.5)
    assert line.ports[0].read().data == line.ports[1].read().data == b"\x00\xff"
    line.ports[0].write(b"ab", now=1.0)
    line.inject(b"z", now=1.0)
    line.advance(2.0)
    assert line.collisions == 2  # a and z
    assert {byte.port for byte in line.tap} == {NOISE, 0}


def test_the_tap_groups_what_one_port_says_without_silence() -> None:
    line = VirtualLine(2)
    end = line.ports[0].write(b"ab", now=0.0)
    line.ports[1].write(b"cd", now=end)
    line.ports[1].write(b"e", now=end + 4 * line.character_time)
    line.advance(1.0)
    assert [(part.port, part.data) for part in line.transmissions()] == [(0, b"ab"), (1, b"cd"), (1, b"e")]
    assert [part.data for part in line.transmissions(silence=0.1)] == [b"ab", b"cde"]
    first = line.transmissions()[0]
    assert (first.begin, first.end, first.damaged) == (pytest.approx(0.0), pytest.approx(end), 0)


def test_a_quiet_line_has_no_transmissions_and_no_deadline() -> None:
    line = VirtualLine(2)
    assert line.transmissions() == []
    assert line.deadline() is line.pause_at() is line.quiet_at() is None
    assert line.advance(5.0) == []


def test_an_hour_at_115200_passes_without_drift() -> None:
    line = VirtualLine(2, 115_200, tap_size=10)
    now = 0.0
    for hour_part in range(360):
        now = hour_part * 10.0
        line.ports[0].write(bytes(100), now)
        line.advance(now + 9.0)
    assert line.tap[-1].time == pytest.approx(now + 100 * line.character_time, abs=1e-9)
    assert len(line.tap) == 10


def test_the_past_cannot_be_written_to() -> None:
    line = VirtualLine(2)
    line.advance(10.0)
    with pytest.raises(ValueError, match="already"):
        line.ports[0].write(b"x", now=9.0)


def test_an_impossible_line_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one port"):
        VirtualLine(0)
    with pytest.raises(ConfigError):
        VirtualLine(2, baud=0)
    with pytest.raises(ValueError, match="mark"):
        VirtualLine(2, parity="mark")
