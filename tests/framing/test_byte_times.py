"""Times of bytes, from the reads that brought them."""

import pytest

from busway.framing.byte_times import NEVER, ByteTimes


def bursts() -> ByteTimes:
    """Four bytes from 1.0 on, a tenth of a second each; two more from 2.0 on."""
    made = ByteTimes()
    made.add(0, 1.0, 0.1)
    made.add(4, 2.0, 0.2)
    return made


def test_each_byte_began_and_ended_where_its_burst_says() -> None:
    one = bursts()
    assert [one.began(place) for place in range(6)] == pytest.approx([1.0, 1.1, 1.2, 1.3, 2.0, 2.2])
    assert [one.ended(place) for place in range(1, 7)] == pytest.approx([1.1, 1.2, 1.3, 1.4, 2.2, 2.4])
    assert one.latest == 2.0


@pytest.mark.parametrize("count", [1, 3, 4, 5])
def test_places_count_from_what_is_not_forgotten(count: int) -> None:
    whole, left = bursts(), bursts()
    left.forget(count)
    for place in range(6 - count):
        assert left.began(place) == pytest.approx(whole.began(place + count))
        assert left.ended(place + 1) == pytest.approx(whole.ended(place + count + 1))


def test_many_reads_are_forgotten_with_their_bytes() -> None:
    one = ByteTimes()
    for second in range(1000):
        one.add(1, float(second), 1.0)
        one.forget(1)
    assert len(one._bursts) <= 2


def test_nothing_was_read_before_the_first_read() -> None:
    assert ByteTimes().latest == NEVER
