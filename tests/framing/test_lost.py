"""A disturbance: one report, bounded bytes, the reason that was known best."""

from busway.framing.lost import LostBytes
from busway.framing.received import Damage, Damaged


def test_it_keeps_the_first_256_bytes_and_counts_all() -> None:
    lost = LostBytes()
    lost.add(bytes(200), 1.0, 1.1)
    lost.add(b"\x01" * 200, 1.2, 1.4)
    assert lost.report() == Damaged(bytes(200) + b"\x01" * 56, Damage.TOO_LONG, 400, 1.0, 1.4)


def test_few_bytes_are_too_few_and_others_fail_the_check() -> None:
    for size, reason in ((3, Damage.TOO_SHORT), (4, Damage.CHECKSUM)):
        lost = LostBytes()
        lost.add(bytes(size), 1.0, 1.0)
        assert lost.report().reason is reason


def test_a_mark_of_the_port_is_the_reason_and_overrun_is_never_forgotten() -> None:
    lost = LostBytes()
    lost.mark(Damage.OVERRUN, 1.0)
    lost.add(b"\x01", 1.0, 1.1)
    lost.mark(Damage.CHARACTER, 1.2)
    assert lost.report() == Damaged(b"\x01", Damage.CHARACTER, 1, 1.0, 1.2, overrun=True)
