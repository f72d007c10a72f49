"""Timeouts that adapt where replies are numbered, and stay as configured on lines."""

from busway.apps.collector.adaptive_timeout import SHORTEST, AdaptiveTimeout


def test_it_is_as_configured_until_something_is_known() -> None:
    assert AdaptiveTimeout(3.0, numbered=True).seconds == 3.0


def test_on_a_line_it_is_never_shortened() -> None:
    timeout = AdaptiveTimeout(1.0, numbered=False)
    for _ in range(100):
        timeout.answered(0.02)
    assert timeout.seconds == 1.0


def test_it_falls_to_several_times_the_usual_reply_time_but_not_below_the_least() -> None:
    timeout = AdaptiveTimeout(3.0, numbered=True)
    for _ in range(100):
        timeout.answered(0.4)
    assert 0.4 <= timeout.seconds < 0.5
    for _ in range(100):
        timeout.answered(0.001)
    assert timeout.seconds == SHORTEST


def test_replies_that_vary_keep_it_longer() -> None:
    timeout = AdaptiveTimeout(3.0, numbered=True)
    for elapsed in (0.1, 0.5) * 50:
        timeout.answered(elapsed)
    assert timeout.seconds > 0.8


def test_each_silence_doubles_it_up_to_the_configured_time() -> None:
    timeout = AdaptiveTimeout(3.0, numbered=True)
    for _ in range(100):
        timeout.answered(0.5)
    before = timeout.seconds
    timeout.silent()
    assert timeout.seconds == 2 * before
    for _ in range(10):
        timeout.silent()
    assert timeout.seconds == 3.0
