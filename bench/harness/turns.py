"""Many short turns of programs that stay: contenders that follow each other within a fraction of a second.

What disturbs a machine lasts longer than one turn, and then spoils those of all contenders alike, or shorter, and then
spoils one turn of many. So medians of turns, and of ratios of turns that followed each other, stand where single long
measurements swing.

1. The program says `ready 0` once it may be asked, and makes a turn at every SIGUSR1. It waits for it without a timer.
2. A turn ends with one line: `turn took` and the numbers of `Took`, or `turn failed` and why. A failed turn is left
   out; a program that has failed `MOST_FAILED_TURNS` turns in a row, or says nothing, is asked no more. So is one that
   got wrong values (it raises `SystemExit` and says `turn wrong`): what is wrong is not measured.
3. Standard library only: the peers' interpreters run this too.
"""

import itertools
import signal
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from harness.children import ChildFailed, Server

MOST_FAILED_TURNS = 3


@dataclass(frozen=True, slots=True)
class Took:
    """What a turn took: seconds of its middle read, of all its reads, CPU seconds of the program, and the reads."""

    typical: float
    seconds: float
    cpu: float
    reads: int

    @classmethod
    def of(cls, ended: Sequence[float], cpu: float) -> "Took":
        """From the times at which reads ended; the first of them opened what has to be opened, and is not counted."""
        each = [later - earlier for earlier, later in itertools.pairwise(ended)]
        return cls(statistics.median(each), sum(each), cpu, len(each))


def make_turns(turn: Callable[[], Took]) -> NoReturn:
    """In the program that is measured: make a turn whenever one is asked for."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    print("ready 0", flush=True)
    while True:
        signal.sigwait({signal.SIGUSR1})
        try:
            took = turn()
        except SystemExit as wrong:
            print("turn wrong", *str(wrong).split(), flush=True)
        except Exception as error:  # the peers' are of many kinds
            print("turn failed", type(error).__name__, *str(error).split(), flush=True)
        else:
            print(f"turn took {took.typical:.9f} {took.seconds:.9f} {took.cpu:.9f} {took.reads}", flush=True)


@dataclass(slots=True)
class Contender:
    """A program that makes turns, by number of the round, or why it does not.

    Attributes:
        missing: why it is asked no more; empty while it is asked.
    """

    program: Server | None = None
    turns: dict[int, Took] = field(default_factory=dict)
    failed: int = 0
    missing: str = ""
    _in_row: int = 0

    def turn(self, number: int) -> str:
        """Make one; gives why it failed, empty if it did not."""
        if self.program is None or self.missing:
            return ""
        try:
            verdict, *words = self.program.answer(signal.SIGUSR1, "turn") or ["failed"]
        except ChildFailed as failure:
            self.missing = str(failure)
            return self.missing
        if verdict == "took":
            typical, seconds, cpu = map(float, words[:3])
            self.turns[number] = Took(typical, seconds, cpu, int(words[3]))
            self._in_row = 0
            return ""
        self.failed += 1
        self._in_row += 1
        why = " ".join(words)
        if verdict == "wrong":
            self.missing = why
        elif self._in_row >= MOST_FAILED_TURNS:
            self.missing = f"{MOST_FAILED_TURNS} turns in a row failed, the last with {why}"
        return why

    def values(self, quantity: Callable[[Took], float]) -> list[float]:
        """One number of each turn."""
        return [quantity(took) for took in self.turns.values()]

    @property
    def typical(self) -> float | None:
        """Seconds of the middle read of the middle turn; None where there is no turn."""
        return statistics.median(self.values(lambda took: took.typical)) if self.turns else None

    @property
    def swing(self) -> float:
        """Half the distance between the quartiles of the turns, in per cent of the middle."""
        each = self.values(lambda took: took.typical)
        if len(each) < 2:
            return 0.0
        low, middle, high = statistics.quantiles(each, n=4, method="inclusive")
        return (high - low) / 2 / middle * 100

    @property
    def cpu(self) -> float:
        """CPU seconds of a read."""
        return statistics.median(self.values(lambda took: took.cpu / took.reads)) if self.turns else 0.0

    def above(self, other: "Contender") -> float | None:
        """How much more a read takes than the other's, in per cent: the middle of all pairs of one round."""
        pairs = [
            took.typical / other.turns[number].typical - 1
            for number, took in self.turns.items()
            if number in other.turns
        ]
        return statistics.median(pairs) * 100 if pairs else None
