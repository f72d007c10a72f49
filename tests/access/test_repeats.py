"""What comes again and again is said at first, and then how often."""

from busway.access.repeats import Repeats, so_often


def test_the_first_is_said_and_those_after_it_are_counted_until_the_pause_is_over() -> None:
    repeats = Repeats(60.0)
    assert [repeats.again("a", now) for now in (0.0, 1.0, 59.0)] == [0, None, None]
    assert repeats.again("b", 1.0) == 0
    assert repeats.again("a", 60.0) == 2
    assert repeats.again("a", 61.0) is None
    assert repeats.again("a", 500.0) == 1


def test_names_are_bounded() -> None:
    repeats = Repeats(60.0)
    for number in range(5000):
        repeats.again(str(number), 0.0)
    assert repeats.again("0", 1.0) == 0
    assert repeats.again("4999", 1.0) is None


def test_the_end_of_a_line_tells_how_often() -> None:
    assert so_often(0) == ""
    assert so_often(7) == " (7 more since the last line)"
