"""A repeated message is logged at first, and then with the number that was left out."""

from busway.log_limiter import LogLimiter, suppressed_note


def test_the_first_is_said_and_those_after_it_are_counted_until_the_pause_is_over() -> None:
    limiter = LogLimiter(60.0)
    assert [limiter.admit("a", now) for now in (0.0, 1.0, 59.0)] == [0, None, None]
    assert limiter.admit("b", 1.0) == 0
    assert limiter.admit("a", 60.0) == 2
    assert limiter.admit("a", 61.0) is None
    assert limiter.admit("a", 500.0) == 1


def test_names_are_bounded() -> None:
    limiter = LogLimiter(60.0)
    for number in range(5000):
        limiter.admit(str(number), 0.0)
    assert limiter.admit("0", 1.0) == 0
    assert limiter.admit("4999", 1.0) is None


def test_the_end_of_a_line_tells_how_often() -> None:
    assert suppressed_note(0) == ""
    assert suppressed_note(7) == " (7 more since the last line)"
