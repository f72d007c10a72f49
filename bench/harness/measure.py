"""Samples, and how several contenders are measured side by side.

Rules:
1. Contenders take turns: every round measures each of them once, so that a noisy minute hits all alike.
2. A figure is the median of its rounds; its spread is half the distance between the extremes, in per cent of it.
3. A ratio is built round by round and then its median taken, never from two medians.
4. Where a few per cent between two contenders are asked for, they follow each other in many short turns: in pairs, each
   of which begins with the one that ended the pair before.
"""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Sample:
    """One round of one contender; what was not measured is None."""

    rate: float  # transactions per second
    cpu: float | None = None  # µs of CPU time of the measured program per transaction
    p50: float | None = None  # µs
    p99: float | None = None  # µs
    p999: float | None = None  # µs

    @classmethod
    def of(cls, result: Mapping[str, float], cpu_seconds: float) -> "Sample":
        """From the JSON of a client or load generator and the CPU time that the measured program used meanwhile."""
        return cls(
            rate=result["rate"],
            cpu=cpu_seconds / result["all_transactions"] * 1e6,
            p50=result.get("p50"),
            p99=result.get("p99"),
            p999=result.get("p99.9"),
        )


@dataclass(slots=True)
class Series:
    """The rounds of one contender, or the reason why there are none."""

    name: str
    samples: list[Sample] = field(default_factory=list)
    missing: str | None = None

    def values(self, quantity: str) -> list[float]:
        return [value for sample in self.samples if (value := getattr(sample, quantity)) is not None]

    def median(self, quantity: str) -> float | None:
        return median(self.values(quantity))


def median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def spread(values: Sequence[float]) -> float | None:
    """Half the distance between the extremes, in per cent of the median."""
    middle = median(values)
    return (max(values) - min(values)) / 2 / middle * 100 if middle else None


def ratio(mine: Series | None, theirs: Series | None, quantity: str) -> float | None:
    """Median of the rounds' ratios mine / theirs; None where one of them was not measured."""
    if mine is None or theirs is None:
        return None
    return median([a / b for a, b in zip(mine.values(quantity), theirs.values(quantity), strict=False) if b])


def alternate(
    contenders: Mapping[str, Callable[[], Sample]],
    rounds: int,
    failures: tuple[type[Exception], ...],
    say: Callable[[str], None],
) -> dict[str, Series]:
    """Measures all contenders in turn, `rounds` times; one that fails is left out from then on, with its reason."""
    series = {name: Series(name) for name in contenders}
    for number in range(1, rounds + 1):
        for name, measure in contenders.items():
            one = series[name]
            if one.missing is not None:
                continue
            try:
                sample = measure()
            except failures as failure:
                one.missing = str(failure)
                one.samples.clear()
                say(f"{name}: left out. {failure}")
                continue
            one.samples.append(sample)
            say(f"round {number}/{rounds}  {name:<42} {sample.rate:>12,.0f}/s")
    return series


def in_pairs(
    contenders: Mapping[str, Callable[[], Sample]],
    pairs: int,
    failures: tuple[type[Exception], ...],
    say: Callable[[str], None],
) -> dict[str, Series]:
    """Measures two contenders `pairs` times, one right after the other, in front by turns; both end when one fails."""
    series = {name: Series(name) for name in contenders}
    order = list(contenders)
    for _ in range(pairs):
        found = alternate({name: contenders[name] for name in order}, 1, failures, lambda text: None)
        for name, one in found.items():
            series[name].missing = one.missing
        failed = [one for one in found.values() if one.missing is not None]
        if failed:
            for one in failed:
                series[one.name].samples.clear()
                say(f"{one.name}: left out. {one.missing}")
            break
        for name, one in found.items():
            series[name].samples += one.samples
        order.reverse()
    return series
