"""Programs that stay take turns: what a noisy moment, a failed turn and a wrong value do to the figures."""

import signal
import sys
from dataclasses import dataclass, field

import pytest
from harness import children
from harness.children import ChildFailed
from harness.turns import MOST_FAILED_TURNS, Contender, Took


@dataclass
class Program:
    """Says what it was told to, turn by turn; then nothing."""

    lines: list[str]
    asked: list[int] = field(default_factory=list)

    def answer(self, number: signal.Signals, word: str) -> list[str]:
        self.asked.append(number)
        line = self.lines.pop(0) if self.lines else ""
        if not line.startswith(word):
            raise ChildFailed(f"said {line!r}")
        return line.split()[1:]


def after(*lines: str) -> Contender:
    """A contender whose program has said these lines, one per round."""
    contender = Contender(program=Program(list(lines)))  # type: ignore[arg-type]
    for number in range(len(lines)):
        contender.turn(number)
    return contender


def took(typical: float) -> str:
    return f"turn took {typical} {typical * 10} {typical * 2} 10"


def test_typical_read_of_a_turn_leaves_out_the_one_that_opened_the_port() -> None:
    assert Took.of([5.0, 6.0, 7.0, 11.0], 0.5) == Took(typical=1.0, seconds=6.0, cpu=0.5, reads=3)


def test_one_noisy_turn_of_many_changes_no_figure() -> None:
    quiet, noisy = after(*[took(2.0)] * 5), after(took(2.0), took(2.0), took(9.0), took(2.0), took(2.0))
    assert noisy.typical == quiet.typical == 2.0
    assert noisy.swing == quiet.swing == 0.0
    assert noisy.cpu == quiet.cpu == pytest.approx(0.4)


def test_what_a_gateway_adds_is_the_middle_of_pairs_so_a_noisy_minute_that_hits_both_adds_nothing() -> None:
    master = after(took(2.0), took(2.0), took(6.0), took(6.0), took(6.0))
    gateway = after(took(2.2), took(2.2), took(6.6), took(6.6), took(6.6))
    assert gateway.above(master) == pytest.approx(10.0)


def test_failed_turn_is_left_out_with_its_pair() -> None:
    master = after(took(2.0), took(2.0), took(2.0))
    gateway = after(took(2.0), "turn failed NoReply no reply within 1 s", took(2.0))
    assert (gateway.failed, gateway.missing, sorted(gateway.turns)) == (1, "", [0, 2])
    assert gateway.above(master) == 0.0
    assert master.above(after("turn failed it")) is None


def test_program_that_fails_again_and_again_is_asked_no_more() -> None:
    contender = after(*["turn failed NoReply nothing came"] * (MOST_FAILED_TURNS + 2))
    assert contender.failed == MOST_FAILED_TURNS
    assert "nothing came" in contender.missing
    assert contender.typical is None


def test_program_that_got_wrong_values_or_has_ended_is_asked_no_more() -> None:
    wrong = after(took(1.0), "turn wrong wrong values: [7]", took(1.0))
    assert (wrong.missing, sorted(wrong.turns)) == ("wrong values: [7]", [0])
    ended = after(took(1.0), "", took(1.0))
    assert ended.missing == "said ''"


PROGRAM = """
from harness.turns import Took, make_turns
turns = iter([Took.of([1.0, 2.0, 4.0, 5.0], 0.25), ValueError("no  reply"), SystemExit("wrong values")])

def turn():
    one = next(turns)
    if isinstance(one, Took):
        return one
    raise one

make_turns(turn)
"""


def test_program_makes_a_turn_when_it_is_asked_and_says_what_became_of_it() -> None:
    with children.server([sys.executable, "-c", PROGRAM], None, "ready") as program:
        contender = Contender(program=program)
        assert [contender.turn(number) for number in range(3)] == ["", "ValueError no reply", "wrong values"]
        assert contender.turns == {0: Took(typical=1.0, seconds=4.0, cpu=0.25, reads=3)}
        assert contender.missing == "wrong values"
